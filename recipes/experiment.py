"""Many runs: algorithms × tracks × variants × seeds, one process each; what is finished is not run again.

    python recipes/experiment.py --multirun budget=smoke
    python recipes/experiment.py --multirun budget=paper hydra/launcher=slurm
    python recipes/experiment.py --multirun name=states algorithm=ppo variant=state track=circle,kidney,figure8
    python recipes/experiment.py --multirun --config-name ablation budget=cpu

Runs land in <directory>/<name>/<algorithm>_<track>_<variant>_seed<k>; recipes/plot.py makes figures of them. The same
command continues an experiment that was interrupted: finished runs are skipped, others resume from their checkpoints.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import cast

import hydra
from checks import check_variant
from command_line import merge_overrides, override_key, plain_errors
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from schema import ExperimentConfig, RunConfig, register

from dreamer_racing.checkpoint import CHECKPOINTS, latest_checkpoint

RECIPES = Path(__file__).resolve().parent
LOG = "log.txt"
OWN = ("name", "algorithm", "variant", "variants", "overrides", "directory")  # settings that no recipe has

# Launchers send configurations to processes of theirs, which must find the modules of this folder.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(RECIPES), os.environ.get("PYTHONPATH")]))

register()


@hydra.main(version_base="1.3", config_path="config", config_name="experiment")
def main(config: DictConfig) -> None:
    """Run one of the experiment's runs, or what is left of it."""
    with plain_errors():
        settings = cast(ExperimentConfig, config)
        command = next_command(settings, list(HydraConfig.get().overrides.task))
    run_dir = directory_of(settings)
    if command is None:
        print(f"{run_dir}: finished, skipped")
        return
    print(f"{run_dir}: {'resumed' if any('resume=' in word for word in command) else 'started'}", flush=True)
    if status := run(command, run_dir):
        last = "\n".join((run_dir / LOG).read_text(errors="replace").replace("\r", "\n").splitlines()[-5:])
        raise RuntimeError(
            f"{run_dir}: {settings.algorithm} ended with status {status}; {run_dir / LOG} ends with:\n{last}"
        )
    print(f"{run_dir}: done", flush=True)


def directory_of(config: ExperimentConfig) -> Path:
    """The directory of one run."""
    name = f"{config.algorithm}_{Path(config.track).stem}_{config.variant}_seed{config.seed}"
    return Path(config.directory).absolute() / config.name / name


def next_command(config: ExperimentConfig, given: list[str]) -> list[str] | None:
    """The command that brings a run to its end; None if it is there.

    Args:
        config: of the run.
        given: overrides of the experiment, those that are not its own for the recipe.

    Raises:
        ValueError: the algorithm or the variant is unknown, or the directory holds a run with other settings.
    """
    check_variant(config)
    run_dir = directory_of(config)
    chosen = [f"track={config.track}", f"seed={config.seed}", f"budget={config.budget}"]
    overrides = merge_overrides(chosen, [override for override in given if override_key(override) not in OWN])
    overrides += [*config.variants[config.variant], *config.overrides]
    wanted = cast(RunConfig, hydra.compose(config.algorithm, overrides))
    recipe = [sys.executable, str(RECIPES / f"{config.algorithm}.py")]
    try:
        reached = latest_checkpoint(run_dir / CHECKPOINTS)
    except FileNotFoundError:
        return [*recipe, f"run_dir={run_dir}", *overrides]
    refuse_other_settings(run_dir, overrides)
    env_steps = int(reached.name.rpartition("-")[2])
    if env_steps >= wanted.total_env_steps:
        return None
    return [*recipe, f"resume={run_dir}", f"total_env_steps={wanted.total_env_steps}"]


def refuse_other_settings(run_dir: Path, overrides: list[str]) -> None:
    """Refuse to continue a run that was started with other overrides, but for its length.

    Raises:
        ValueError: the message names the overrides that differ.
    """
    saved = {str(override) for override in OmegaConf.load(run_dir / "overrides.yaml")}
    differing = sorted(o for o in saved ^ set(overrides) if override_key(o) not in ("run_dir", "total_env_steps"))
    if differing:
        raise ValueError(
            f"{run_dir} holds a run with other settings; these are in one of the two only: {', '.join(differing)}. "
            "Choose another name=, or take that run away."
        )


def run(command: list[str], run_dir: Path) -> int:
    """Run a recipe in a process of its own, which gets this one's signals; its output goes to a file."""
    run_dir.mkdir(parents=True, exist_ok=True)
    with (
        (run_dir / LOG).open("a", encoding="utf-8") as log,
        subprocess.Popen(command, stdout=log, stderr=log) as process,
    ):
        previous = signal.signal(signal.SIGTERM, lambda number, frame: process.send_signal(number))
        try:
            return process.wait()
        finally:
            signal.signal(signal.SIGTERM, previous)


if __name__ == "__main__":
    main()
