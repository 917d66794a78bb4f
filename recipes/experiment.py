"""Make many runs: algorithms × tracks × variants × seeds, one process each; finished runs are not repeated.

    python recipes/experiment.py --multirun budget=smoke
    python recipes/experiment.py --multirun budget=paper hydra/launcher=slurm
    python recipes/experiment.py --multirun name=states algorithm=ppo variant=state track=circle,kidney,figure8
    python recipes/experiment.py --multirun --config-name ablation budget=cpu

Runs land in <directory>/<name>/<algorithm>_<track>_<variant>_seed<k>; recipes/plot.py makes figures of them. The same
command continues an experiment that was interrupted: finished runs are skipped, others resume from their checkpoints.
"""

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from composing.callbacks import FAILURES
from composing.entry import as_override, in_plain_words, merge_overrides, override_key, recipe
from composing.saved import read_yaml
from composing.schema import RECIPES, RunConfig
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import MISSING, ListConfig
from yaml import YAMLError, safe_load

from dreamer_racing.settings import check_choice, shortened
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.signals import run_passing_signals

FOLDER = Path(__file__).resolve().parent
LOG = "log.txt"
EXPERIMENT_SETTINGS = ("name", "algorithm", "variant", "variants", "overrides", "directory")  # not for recipes

# Launchers start processes that must find the modules of this folder.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(FOLDER), os.environ.get("PYTHONPATH")]))


@dataclass
class ExperimentConfig(RunConfig):
    """Configuration of `recipes/experiment.py`: one run of an experiment; hydra's multirun makes all of them.

    Settings that all recipes share are given as to a recipe: `track=`, `seed=`, `budget=`, `env.from_pixels=` ...
    """

    name: str = MISSING  # of the experiment
    algorithm: str = "dreamer_v3"  # name of a training recipe's file
    variant: str = "default"  # name of one of `variants`
    variants: dict[str, list[str]] = field(default_factory=dict)  # overrides of the recipe, by variant
    overrides: list[str] = field(default_factory=list)  # of every run, e.g. "overrides=['loss.entropy_scale=1e-4']"
    directory: str = "runs"


@recipe("experiment", ExperimentConfig, composed=True)
def main(settings: ExperimentConfig) -> None:
    """Start or resume one run of the experiment; a failure is noted in a file, and the other runs are still made."""
    run_dir = directory_of(settings)
    note = run_dir.parent / FAILURES / f"{run_dir.name}.txt"
    note.unlink(missing_ok=True)
    try:
        complete_run(settings, run_dir, list(HydraConfig.get().overrides.task))
    except (ValueError, OSError, RuntimeError, HydraException) as error:
        if isinstance(error, HydraException):
            error = ValueError(in_plain_words(error, settings.algorithm, settings.overrides))
        print(f"{run_dir}: failed: {error}", file=sys.stderr, flush=True)
        if HydraConfig.get().mode == RunMode.RUN:
            raise SystemExit(1) from None
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(f"{error}\n", encoding="utf-8")


def check(config: ExperimentConfig) -> None:
    """Refuse an unknown algorithm or variant, and what would be the same folder for all runs."""
    for name in ("run_dir", "resume"):
        if (value := getattr(config, name)) is not None:
            raise ValueError(f"{name}={value} is for one run: name a folder for all by directory= and name=.")
    for name, known in (("algorithm", tuple(RECIPES)), ("variant", tuple(config.variants))):
        check_choice(name, getattr(config, name), known)


def directory_of(config: ExperimentConfig) -> Path:
    """Return the directory of one run."""
    name = f"{config.algorithm}_{Path(config.track).stem}_{config.variant}_seed{config.seed}"
    return Path(config.directory).absolute() / config.name / name


def complete_run(config: ExperimentConfig, run_dir: Path, given: list[str]) -> None:
    """Start, resume or skip a run, and print which; raise ``RuntimeError`` if its recipe failed."""
    command = next_command(config, given)
    if command is None:
        print(f"{run_dir}: finished, skipped", flush=True)
        return
    RunDirectory(run_dir).claim().release()  # refuses a live run here, rather than in its log
    began = "resumed" if any("resume=" in word for word in command) else "started"
    print(f"{run_dir}: {began}, budget={config.budget}", flush=True)
    log = run_dir / LOG
    if status := run_passing_signals(command, log):
        last = "\n".join(log.read_text(errors="replace").replace("\r", "\n").splitlines()[-5:])
        raise RuntimeError(f"{config.algorithm} ended with status {status}; {log} ends with:\n{last}")
    print(f"{run_dir}: {'done' if next_command(config, given) is None else 'interrupted'}", flush=True)


def next_command(config: ExperimentConfig, given: list[str]) -> list[str] | None:
    """Return the command that completes a run; None if it is complete.

    Of the given overrides of the experiment, all but its own settings go to the recipe.
    """
    check(config)
    run_dir = directory_of(config)
    chosen = [f"track={config.track}", f"seed={config.seed}", f"budget={config.budget}", *config.overrides]
    of_recipe = [override for override in given if override_key(override).partition(".")[0] not in EXPERIMENT_SETTINGS]
    overrides = merge_overrides(chosen, of_recipe)
    overrides += config.variants[config.variant]
    wanted = cast(RunConfig, compose(config.algorithm, overrides))
    recipe = [sys.executable, str(FOLDER / f"{config.algorithm}.py")]
    try:
        latest_checkpoint(RunDirectory(run_dir).checkpoints)
    except FileNotFoundError:
        return [*recipe, as_override("run_dir", run_dir), *overrides]
    saved, given_now = settings_of(read_yaml(RunDirectory(run_dir).overrides, ListConfig)), settings_of(overrides)
    refuse_other_settings(run_dir, saved, given_now)
    if "tuned" in saved and "tuned" not in given_now:  # chosen for tuned=auto; it changes the run's length
        wanted = cast(RunConfig, compose(config.algorithm, [*overrides, f"tuned={saved['tuned']}"]))
    if RunDirectory(run_dir).finished_env_steps() >= wanted.total_env_steps:
        return None
    return [*recipe, as_override("resume", run_dir), f"total_env_steps={wanted.total_env_steps}"]


def refuse_other_settings(run_dir: Path, saved: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Refuse to resume a run that was started with other overrides, except for its length."""
    saved = {name: value for name, value in saved.items() if name != "tuned" or name in wanted}  # chosen by tuned=auto
    differing = [name for name in sorted(saved.keys() | wanted.keys()) if saved.get(name) != wanted.get(name)]
    if differing:
        values = ", ".join(
            f"{name}: {saved.get(name, 'not given')} and {wanted.get(name, 'not given')}" for name in differing
        )
        raise ValueError(
            f"{run_dir} holds a run with other settings (there, then requested): {values}. Choose another name=, or "
            "move that run away."
        )


def settings_of(overrides: Iterable[str]) -> dict[str, Any]:
    """Return the values of overrides by name, parsed as YAML, without those that may differ when a run is resumed."""
    values = {}
    for override in map(str, overrides):
        if (name := override_key(override)) in ("run_dir", "total_env_steps"):
            continue
        try:
            values[name] = safe_load(override.partition("=")[2])
        except YAMLError as error:
            raise ValueError(f"The override {shortened(override)} has no value that can be read.") from error
    return values


if __name__ == "__main__":
    main()
