"""Runs on disk: finding their folders, reading what a figure needs, and putting those together that belong together."""

from __future__ import annotations

import glob
import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from dreamer_racing.envs.tracks.loading import BUILTIN_TRACKS
from dreamer_racing.training.clock import CPU_CLOCK, WALL_CLOCK
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.metrics import MetricsTable, read_metrics

DEFAULT_ALGORITHM = "dreamer_v3"  # of configurations from before there was a choice
PPO_ACTORS = ("flown_ppo", "latent_ppo", "asymmetric_ppo")
"""Values of loss.actor of what is the algorithm latent_ppo, in runs from before it had its name."""
LOGGED_BY = (
    ("imagined_reward", "dreamer_v3"), ("loss_dynamics", "latent_ppo"), ("alpha", "sac"), ("clip_fraction", "ppo"),
)  # fmt: skip
"""Columns of `metrics.csv` that one algorithm alone has, or none before it in this order."""
REFERENCE = "default"  # the variant that others are compared with; so is one without a name
SAME_CURVE = (
    "seed", "run_dir", "resume", "total_env_steps", "device", "logger.", "checkpoint.", "replay.storage",
    "replay.device", "evaluation.every", "evaluation.first", "evaluation.stochastic", "evaluation.video_steps",
    "model.cuda_graph",
)  # fmt: skip
"""Settings, or beginnings of them, in which the runs of one curve may differ: none of them changes what is learned."""
IN_KEY = ("algorithm", "track", "task")  # settings that every key names anyway


class Axis(NamedTuple):
    """Along what curves are drawn and runs compared."""

    label: str
    clock: str | None
    """Column of `metrics.csv`, s since the run began, that hours are read off; None: env_steps."""
    form: str
    """Of numbers on it."""
    smallest_window: float


AXES = {
    "env_steps": Axis("env_steps", None, ",.0f", 1.0),
    "hours": Axis("hours", WALL_CLOCK, ".2f", 1e-6),
    "core_hours": Axis("hours of one core", CPU_CLOCK, ".2f", 1e-6),
}


def axis_of(name: str) -> Axis:
    """Look up an axis.

    Raises:
        ValueError: there is none of that name.
    """
    if name not in AXES:
        raise ValueError(f"axis={name}: there are {', '.join(AXES)}.")
    return AXES[name]


class CurveKey(NamedTuple):
    """What the runs of one curve have in common."""

    track: str  # or the task, of the Control Suite
    algorithm: str
    variant: str
    """Named by the run folder, ``<algorithm>_<track>_<variant>_seed<k>``, and by what `group_runs` adds; or empty."""

    @property
    def is_reference(self) -> bool:
        """Whether the other variants are compared with this one."""
        return self.variant in ("", REFERENCE)

    def __str__(self) -> str:
        """Say it in words."""
        return " ".join(filter(None, (self.algorithm, self.track, self.variant)))


@dataclass(frozen=True)
class RunData:
    """A run directory, read.

    Args:
        directory: of the run; or the file, of a table of metrics that was kept alone.
        config: settings of `config.yaml` by dotted name; empty of a table alone.
        metrics: its `metrics.csv`.
        overrides: what its command line set, by dotted name, as text; empty if that was not stored.
    """

    directory: Path
    config: dict[str, Any]
    metrics: MetricsTable
    overrides: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.directory.name

    @property
    def seed(self) -> int:
        """Of the run, or as the name of a table says."""
        if "seed" in self.config:
            return int(self.config["seed"])
        named = re.search(r"_seed(\d+)", self.directory.stem)
        return int(named[1]) if named and not self.config else 0

    @property
    def key(self) -> CurveKey:
        """Which curve the run belongs to, by its folder's name; `group_runs` looks at the settings, too."""
        if not self.config:
            return _key_of_table(self.directory)
        algorithm = str(self.config.get("algorithm", DEFAULT_ALGORITHM))
        scene = "task" if self.config.get("env.suite") == "dmc" else "track"
        track = Path(str(self.config.get(scene, "unknown"))).stem
        named = re.fullmatch(rf"{re.escape(f'{algorithm}_{track}')}(?:_(?P<variant>.+))?_seed\d+", self.name)
        if algorithm == DEFAULT_ALGORITHM and self.config.get("loss.actor") in PPO_ACTORS:
            algorithm = "latent_ppo"
        return CurveKey(track, algorithm, (named and named["variant"]) or "")


def is_metrics(path: Path) -> bool:
    """Whether a file is a table of metrics by its name: `metrics.csv`, or `metrics_<what>.csv` as results keep them."""
    return re.fullmatch(r"metrics(_.+)?\.csv", path.name) is not None and path.is_file()


def _key_of_table(path: Path) -> CurveKey:
    """Read off the name `metrics_<track>_<variant>_seed<k>.csv` what it says, and off its columns who learned."""
    words = re.sub(r"^metrics_?|(?:^|_)seed\d+", "", path.stem)
    track = next(
        (name for name in sorted(BUILTIN_TRACKS, key=len, reverse=True) if re.search(rf"(?:^|_){name}(?:_|$)", words)),
        "unknown",
    )
    rest = re.sub(rf"(?:^|_){track}(?=_|$)", "", words).strip("_")
    with path.open(encoding="utf-8", errors="replace") as file:
        columns = file.readline().strip().split(",")
    algorithm = next((name for column, name in LOGGED_BY if column in columns), "")
    folder = path.absolute().parent.name
    return CurveKey(track, algorithm, " ".join(filter(None, ("" if folder == algorithm else folder, rest))))


def find_runs(places: Sequence[str | Path]) -> list[Path]:
    """Find run directories: folders with a `config.yaml` or a `metrics.csv`; and tables `metrics_<what>.csv`.

    Args:
        places: run directories, tables, folders that hold some at any depth, or patterns with `*` of either.

    Returns:
        The folders and tables, sorted, each once; what lies inside of a run (`best`, `evaluation`) is no run.

    Raises:
        ValueError: there is none in one of the places.
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
    """Walk through the run directories and tables of a folder, at any depth."""
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
    """Read runs, leaving out those that cannot be read, and of repeated ones all but the one that got furthest.

    Args:
        directories: of the runs.
        wanted: names of the columns of `metrics.csv` to read; None for all.

    Returns:
        The runs, and for everything left out a line that names the run and the reason.
    """
    runs, problems = [], []
    for directory in directories:
        try:
            if directory.is_file():
                run = RunData(directory, {}, read_metrics(directory, wanted))
            else:
                metrics = read_metrics(RunDirectory(directory).metrics, wanted)
                run = RunData(directory, _read_config(directory), metrics, _read_overrides(directory))
        except FileNotFoundError as error:
            problems.append(f"{directory.name} left out: it has no {Path(error.filename).name}")
        except (ValueError, OSError) as error:
            reason = str(error).replace(f"{directory}{os.sep}", "").rstrip(".")
            problems.append(f"{directory.name} left out: {reason}")
        else:
            runs.append(run)
            problems += [f"{directory.name}: {problem}" for problem in run.metrics.problems]
    return _once_each(runs, problems), problems


def _once_each(runs: Sequence[RunData], problems: list[str]) -> list[RunData]:
    """Keep one run of each seed of each curve: a second one is no second sample."""
    kept = []
    for group in _by_curve(runs).values():
        for _, repeated in groupby(group, key=lambda run: run.seed):
            *others, best = sorted(repeated, key=lambda run: run.metrics.env_steps.max(initial=0))
            kept.append(best)
            problems += [
                f"{run.name} left out: it has the settings and the seed of {best.name}, which got as far or further"
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
    if described := flat.get("track_description"):  # long; it need only tell one track from another
        flat["track_description"] = hashlib.sha256(str(described).encode()).hexdigest()[:8]
    return flat


def _read_overrides(directory: Path) -> dict[str, str]:
    """Read what the command line set; it only names curves, so that a run without it is as good."""
    try:
        told = yaml.safe_load(RunDirectory(directory).overrides.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return {}
    pairs = (str(item).lstrip("+~").partition("=") for item in (told if isinstance(told, list) else ()))
    return {name: value for name, _, value in pairs}


def flatten(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of nested settings with its dotted name."""
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def group_runs(runs: Sequence[RunData]) -> dict[CurveKey, list[RunData]]:
    """Put the runs of one curve together, in order of their seeds.

    Runs of one algorithm, track and named variant whose settings differ in more than `SAME_CURVE` are curves of their
    own, and the variant of each says in what: the overrides that not all of them were given, or else the settings. What
    one of them does not have, because it was started by an older version, is no difference.

    Raises:
        ValueError: two runs of one curve do not even differ in the seed.
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
    """Put what runs have measured on another axis than that of env_steps.

    Args:
        runs: with the column of its clock.
        axis: a name in `AXES`.

    Returns:
        The runs, whose tables hold places on that axis where they held env_steps, and a line for each that is left out,
        since it has not recorded the clock.
    """
    clock = axis_of(axis).clock
    if clock is None:
        return list(runs), []
    kept, problems = [], []
    for run in runs:
        if clock not in run.metrics.columns:
            problems.append(f"{run.name} left out: it has no {clock}, which {axis} are read off")
            continue
        hours = _hours(*run.metrics.columns[clock])
        columns = {name: (hours(steps), values) for name, (steps, values) in run.metrics.columns.items()}
        kept.append(replace(run, metrics=replace(run.metrics, columns=columns, env_steps=hours(run.metrics.env_steps))))
    return kept, problems


def _hours(steps: np.ndarray, seconds: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return what turns env_steps into hours, between the readings of a clock."""
    return lambda env_steps: np.interp(env_steps, steps, seconds / 3600.0)


def first_of_each_curve(runs: Sequence[RunData]) -> list[RunData]:
    """Take the run of the lowest seed of each curve."""
    return [group[0] for group in _by_curve(runs).values()]


def _by_curve(runs: Sequence[RunData]) -> dict[CurveKey, list[RunData]]:
    named: dict[CurveKey, list[RunData]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: (run.key, run.seed, str(run.directory))):
        named[run.key].append(run)
    groups = {}
    for key, group in named.items():
        parts = _split_by_settings(group)
        for label, part in zip(_differences(parts), parts, strict=True):
            groups[key._replace(variant=" ".join(filter(None, (key.variant, label))))] = part
    return dict(sorted(groups.items()))


def _split_by_settings(runs: Sequence[RunData]) -> list[list[RunData]]:
    """Put each run to the first others that are all set like it."""
    parts: list[list[RunData]] = []
    for run in runs:
        like = (part for part in parts if not any(_different(run.config, other.config) for other in part))
        if (part := next(like, None)) is None:
            parts.append([run])
        else:
            part.append(run)
    return parts


def _different(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Name the settings that both have, with different values, and that change what is learned."""
    common = first.keys() & second.keys()
    return sorted(name for name in common if not name.startswith(SAME_CURVE) and first[name] != second[name])


def _differences(parts: Sequence[Sequence[RunData]]) -> list[str]:
    """Say of each part in what it differs from the others: nothing of a single one, and of what is as by default."""
    if len(parts) == 1:
        return [""]
    told = [_of_learning(part[0].overrides) for part in parts]
    names = {name for one in told for name in one if any(other.get(name) != one[name] for other in told)}
    labels = _name_by(told, sorted(names))
    if len(set(labels)) == len(labels):
        return labels
    # The command lines do not tell, of two versions say; the settings do, all that runs of a part have between them.
    configs = [_of_learning({name: value for run in part for name, value in run.config.items()}) for part in parts]
    pairs = combinations(configs, 2)
    different = sorted({name for first, second in pairs for name in _different(first, second)})
    counts = range(1, len(different) + 1)
    if (enough := next((n for n in counts if _tells_apart(configs, different[:n])), None)) is None:
        return [f"({number})" for number in range(1, len(parts) + 1)]  # what tells them apart is in every key
    more = ", …" if enough < len(different) else ""
    return [f"{label}{more}" for label in _name_by(configs, different[:enough])]


def _of_learning(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in IN_KEY and not name.startswith(SAME_CURVE)}


def _name_by(settings: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[str]:
    return [", ".join(f"{name}={one[name]}" for name in names if name in one) for one in settings]


def _tells_apart(settings: Sequence[Mapping[str, Any]], names: Sequence[str]) -> bool:
    return len(set(_name_by(settings, names))) == len(settings)
