"""Runs on disk: finding their folders, reading their metrics, and grouping them by curve."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from dreamer_racing.envs.drone.parameters import name_of_preset
from dreamer_racing.envs.tracks.loading import BUILTIN_TRACKS
from dreamer_racing.settings import check_choice
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.metrics import CPU_CLOCK, WALL_CLOCK, MetricsTable, read_metrics

DEFAULT_ALGORITHM = "dreamer_v3"  # for configurations without `algorithm`
LOGGED_BY = (
    ("imagined_reward", "dreamer_v3"), ("loss_dynamics", "latent_ppo"), ("alpha", "sac"), ("clip_fraction", "ppo"),
)  # fmt: skip
"""Columns of `metrics.csv` that identify the algorithm: the first one that exists decides."""
REFERENCE = "default"  # name of the variant that others are compared with, as is a variant without a name
SAME_CURVE = (
    "seed", "run_dir", "resume", "device", "logger.", "checkpoint.", "replay.storage",
    "replay.device", "evaluation.every", "evaluation.first", "evaluation.stochastic", "evaluation.video_steps",
    "model.cuda_graph",
)  # fmt: skip
"""Names or prefixes of settings in which the runs of one curve may differ, because they do not affect learning."""
LENGTH = "total_env_steps"  # affects learning only through schedules
IN_KEY = ("algorithm", "track", "task")  # settings that every key contains


class Axis(NamedTuple):
    """The axis along which curves are drawn and runs compared."""

    label: str
    clock: str | None  # column of `metrics.csv` with the clock in s since the run began; None for env_steps
    form: str  # format of numbers on the axis
    smallest_window: float


AXES = {
    "env_steps": Axis("env_steps", None, ",.0f", 1.0),
    "hours": Axis("hours", WALL_CLOCK, ".2f", 1e-6),
    "core_hours": Axis("hours of one core", CPU_CLOCK, ".2f", 1e-6),
}


def axis_of(name: str) -> Axis:
    """Return the axis of a name; raise ValueError if it is unknown."""
    check_choice("axis", name, AXES)
    return AXES[name]


class CurveKey(NamedTuple):
    """Key that the runs of one curve share."""

    track: str  # or the task of the Control Suite
    algorithm: str
    variant: str
    """From the run folder's name ``<algorithm>_<track>_<variant>_seed<k>``, extended by `group_runs`; may be empty."""

    @property
    def is_reference(self) -> bool:
        """Whether this is the variant that others are compared with."""
        return self.variant in ("", REFERENCE)

    def __str__(self) -> str:
        """Return the non-empty parts, separated by spaces."""
        return " ".join(filter(None, (self.algorithm, self.track, self.variant)))


@dataclass(frozen=True)
class RunData:
    """Content of a run directory, or of a metrics table that was kept without one."""

    directory: Path  # or the file of the metrics table
    config: dict[str, Any]  # settings of `config.yaml` by dotted name; empty for a metrics table
    metrics: MetricsTable
    overrides: dict[str, str] = field(default_factory=dict)  # settings of the command line, if they were stored

    @property
    def name(self) -> str:
        """Name of the folder or file, for messages."""
        return self.directory.name

    @property
    def seed(self) -> int:
        """Seed of the run, or for a metrics table the seed in its name."""
        if "seed" in self.config:
            return int(self.config["seed"])
        named = re.search(r"_seed(\d+)", self.directory.stem)
        return int(named[1]) if named and not self.config else 0

    @property
    def key(self) -> CurveKey:
        """Key of the run's curve by its configuration and folder name; `group_runs` also compares settings."""
        if not self.config:
            return _key_of_table(self.directory)
        algorithm = str(self.config.get("algorithm", DEFAULT_ALGORITHM))
        scene = "task" if self.config.get("env.suite") == "dmc" else "track"
        track = Path(str(self.config.get(scene, "unknown"))).stem
        named = re.fullmatch(rf"{re.escape(f'{algorithm}_{track}')}(?:_(?P<variant>.+))?_seed\d+", self.name)
        return CurveKey(track, algorithm, (named and named["variant"]) or "")


def is_metrics(path: Path) -> bool:
    """Return whether a path is a metrics table: an existing file `metrics.csv` or `metrics_<name>.csv`."""
    return re.fullmatch(r"metrics(_.+)?\.csv", path.name) is not None and path.is_file()


def _key_of_table(path: Path) -> CurveKey:
    """Return the key of a metrics table `metrics_<track>_<variant>_seed<k>.csv`, with the algorithm by its columns."""
    words = re.sub(r"^metrics_?|(?:^|_)seed\d+", "", path.stem)
    track = next(
        (name for name in sorted(BUILTIN_TRACKS, key=len, reverse=True) if re.search(rf"(?:^|_){name}(?:_|$)", words)),
        "unknown",
    )
    with path.open(encoding="utf-8", errors="replace") as file:
        columns = file.readline().strip().split(",")
    algorithm = next((name for column, name in LOGGED_BY if column in columns), "")
    named = "|".join(filter(None, (track, algorithm)))
    rest = re.sub(rf"(?:^|_)(?:{named})(?=_|$)", "", words).strip("_")
    folder = path.absolute().parent.name
    return CurveKey(track, algorithm, " ".join(filter(None, ("" if folder == algorithm else folder, rest))))


def find_runs(places: Sequence[str | Path]) -> list[Path]:
    """Find run directories (folders with `config.yaml` or `metrics.csv`) and metrics tables `metrics_<name>.csv`.

    Places are run directories, tables, folders that contain them at any depth, or glob patterns of these. What is found
    is sorted, without duplicates. Folders inside a run (`best`, `evaluation`) are no runs.

    Raises:
        ValueError: one of the places has no run.
    """
    found = set()
    for place in places:
        folders = sorted(glob.glob(os.path.expanduser(str(place)), recursive=True))
        inside = {run for folder in folders for run in runs_below(Path(folder))}
        if not inside:
            raise ValueError(
                f"runs={place}: there is no run directory (a folder with config.yaml or metrics.csv) "
                "and no table metrics*.csv."
            )
        found |= inside
    return sorted(found)


def runs_below(folder: Path) -> Iterator[Path]:
    """Yield the run directories and metrics tables below a folder, at any depth."""
    if is_metrics(folder):
        yield folder
    for path, folders, files in os.walk(folder):
        if RunDirectory(Path(path)).config.name in files or RunDirectory(Path(path)).metrics.name in files:
            folders.clear()
            yield Path(path)
        else:
            yield from (table for name in files if is_metrics(table := Path(path, name)))
        folders.sort()


def read_runs(directories: Sequence[Path], wanted: Collection[str] | None = None) -> tuple[list[RunData], list[str]]:
    """Read runs, and return them with a line for everything left out; of `metrics.csv` read the ``wanted`` columns.

    Unreadable runs are left out; of runs with the same settings and seed, the one with most env_steps is kept.
    """
    runs, problems = [], []
    for directory in directories:
        try:
            if directory.is_file():
                run, changes = RunData(directory, {}, read_metrics(directory, wanted)), []
            else:
                metrics = read_metrics(RunDirectory(directory).metrics, wanted)
                run = RunData(directory, _read_config(directory), metrics, _read_overrides(directory))
                changes = _changes(directory)
        except FileNotFoundError as error:
            problems.append(f"{directory.name} left out: it has no {Path(error.filename).name}")
        except (ValueError, OSError) as error:
            reason = str(error).replace(f"{directory}{os.sep}", "").rstrip(".")
            problems.append(f"{directory.name} left out: {reason}")
        else:
            runs.append(run)
            problems += [f"{directory.name}: {problem}" for problem in (*run.metrics.problems, *changes)]
    return _one_run_per_seed(runs, problems), problems


def _changes(directory: Path) -> list[str]:
    """Return a line for every start of a run, but the first, that changed settings which affect learning."""
    try:
        noted = [
            (start["env_steps"], _relevant(_as_settings(start["overrides"])))
            for start in RunDirectory(directory).read_starts()
        ]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{RunDirectory(directory).starts} is damaged: {error!r}") from error
    lines = []
    for (_, before), (env_steps, now) in pairwise(noted):
        names = (before.keys() | now.keys()) - {LENGTH}
        if changed := sorted(name for name in names if before.get(name) != now.get(name)):
            words = f"with other {', '.join(changed)}; drawn with its last settings"
            lines.append(f"resumed at {env_steps:,} env_steps {words}")
    return lines


def _one_run_per_seed(runs: Sequence[RunData], problems: list[str]) -> list[RunData]:
    """Keep one run per seed of each curve, because a repetition is not an independent sample."""
    kept = []
    for group in _by_curve(runs).values():
        for _, repeated in groupby(group, key=lambda run: run.seed):
            *others, best = sorted(repeated, key=lambda run: run.metrics.env_steps.max(initial=0))
            kept.append(best)
            problems += [
                f"{run.name} left out: same settings and seed as {best.name}, which has at least as many env_steps"
                for run in others
            ]
    return kept


def _read_config(directory: Path) -> dict[str, Any]:
    path = RunDirectory(directory).config
    try:
        config = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML") from error
    if not isinstance(config, dict):
        raise ValueError(f"{path} holds no settings")
    flat = dict(flatten(config))
    if described := flat.get("track_description"):  # long; a hash suffices to compare tracks
        flat["track_description"] = hashlib.sha256(str(described).encode()).hexdigest()[:8]
    if "env.preset" in flat:
        flat["env.preset"] = name_of_preset(RunDirectory(directory).kept_preset(str(flat["env.preset"])))
    return flat


def _read_overrides(directory: Path) -> dict[str, str]:
    """Read the settings of the command line; they only name curves, so that they may be missing."""
    try:
        overrides = yaml.safe_load(RunDirectory(directory).overrides.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return {}
    return _as_settings(overrides if isinstance(overrides, list) else ())


def _as_settings(overrides: Iterable[Any]) -> dict[str, str]:
    """Return the values of overrides by name."""
    return {name: value for name, _, value in (str(item).lstrip("+~").partition("=") for item in overrides)}


def flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of nested settings with its dotted name."""
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def group_runs(runs: Sequence[RunData]) -> dict[CurveKey, list[RunData]]:
    """Group runs by curve, sorted by seed.

    Runs of one algorithm, track and named variant whose settings differ in more than `SAME_CURVE` form separate curves,
    whose variants name the overrides that differ, or else the settings. What a run lacks is not a difference.

    Raises:
        ValueError: two runs of one curve have the same seed.
    """
    groups = _by_curve(runs)
    for group in groups.values():
        for first, second in pairwise(group):
            if first.seed == second.seed:
                raise ValueError(
                    f"{first.directory} and {second.directory} are the same run twice: the same settings, and "
                    f"seed: {first.seed} in both. Plot one of them."
                )
    return groups


def along(runs: Sequence[RunData], axis: str) -> tuple[list[RunData], list[str]]:
    """Replace env_steps in the tables of runs by positions on another axis; return a line for each run without it."""
    clock = axis_of(axis).clock
    if clock is None:
        return list(runs), []
    kept, problems = [], []
    for run in runs:
        if clock not in run.metrics.columns:
            problems.append(f"{run.name} left out: it has no {clock}, which axis={axis} needs")
            continue
        clock_steps, seconds = run.metrics.columns[clock]
        if clock_steps[-1] < run.metrics.env_steps[-1]:  # resumed where it is not known, on Ray or by several processes
            problems.append(f"{run.name} left out: its {clock} ends at {clock_steps[-1]:,.0f} env_steps")
            continue
        hours: Callable[..., Any] = partial(np.interp, xp=clock_steps, fp=seconds / 3600.0)
        columns = {name: (hours(steps), values) for name, (steps, values) in run.metrics.columns.items()}
        kept.append(replace(run, metrics=replace(run.metrics, columns=columns, env_steps=hours(run.metrics.env_steps))))
    return kept, problems


def first_of_each_curve(runs: Sequence[RunData]) -> list[RunData]:
    """Return the run with the lowest seed of each curve."""
    return [group[0] for group in _by_curve(runs).values()]


def _by_curve(runs: Sequence[RunData]) -> dict[CurveKey, list[RunData]]:
    named: dict[CurveKey, list[RunData]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: (run.key, run.seed, str(run.directory))):
        named[run.key].append(run)
    groups = {}
    for key, group in named.items():
        parts = _split_by_settings(group)
        for label, part in zip(_difference_labels(parts), parts, strict=True):
            groups[key._replace(variant=" ".join(filter(None, (key.variant, label))))] = part
    return dict(sorted(groups.items()))


def _split_by_settings(runs: Sequence[RunData]) -> list[list[RunData]]:
    """Split runs into parts with equal settings: each run joins the first part that it equals."""
    parts: list[list[RunData]] = []
    for run in runs:
        for part in parts:
            if not any(_differing_settings(run.config, other.config) for other in part):
                part.append(run)
                break
        else:
            parts.append([run])
    return parts


def _differing_settings(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Return the names of settings that affect learning and differ between two configurations that both have them."""
    common = first.keys() & second.keys()
    if not (_has_ramp_by_length(first) or _has_ramp_by_length(second)):
        common -= {LENGTH}
    return sorted(name for name in common if not name.startswith(SAME_CURVE) and first[name] != second[name])


def _has_ramp_by_length(config: Mapping[str, Any]) -> bool:
    """Return whether a schedule depends on the run's length, so that runs of other lengths learn differently."""
    ends = [name for name, value in config.items() if re.fullmatch(r"schedule\..+\.to", name) and value is not None]
    return any(config.get(f"{name.removesuffix('to')}by") != "passes" for name in ends)


def _difference_labels(parts: Sequence[Sequence[RunData]]) -> list[str]:
    """Return a label per part that names its differing settings; empty for a single part."""
    if len(parts) == 1:
        return [""]
    overrides = [_relevant(part[0].overrides) for part in parts]
    if not any(_has_ramp_by_length(run.config) for part in parts for run in part):
        overrides = [{name: value for name, value in each.items() if name != LENGTH} for each in overrides]
    names = {name for one in overrides for name in one if any(other.get(name) != one[name] for other in overrides)}
    labels = _name_by(overrides, sorted(names))
    if len(set(labels)) == len(labels):
        return labels
    # The overrides do not differ (for instance between versions): use the settings of all runs of a part.
    configs = [_relevant({name: value for run in part for name, value in run.config.items()}) for part in parts]
    pairs = combinations(configs, 2)
    different = sorted({name for first, second in pairs for name in _differing_settings(first, second)})
    for enough in range(1, len(different) + 1):
        labels = _name_by(configs, different[:enough])
        if len(set(labels)) == len(labels):
            return [f"{label}, …" for label in labels] if enough < len(different) else labels
    return [f"({number})" for number in range(1, len(parts) + 1)]  # they differ only in settings of every key


def _relevant(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in IN_KEY and not name.startswith(SAME_CURVE)}


def _name_by(settings: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[str]:
    return [", ".join(f"{name}={one[name]}" for name in names if name in one) for one in settings]
