"""What recipes that fly a trained policy share: the checkpoint brought back, and what is written beside its numbers."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from arena import is_race, restore_learner, trained_config
from command_line import choose_device
from schema import EvaluateConfig, PerceptionConfig, RunConfig

from dreamer_racing.checkpoint import ensure_writable, latest_checkpoint
from dreamer_racing.learner import Learner
from dreamer_racing.provenance import command_line, provenance


@dataclass
class Restored:
    """A trained agent, and the race that it is to fly."""

    checkpoint: Path
    trained: RunConfig  # configuration of its run, with the race asked for in place of the one trained on
    trained_on: str  # track
    learner: Learner
    counters: dict[str, int]
    machine: dict[str, Any]  # versions and commit too, as they were at the start

    @property
    def run_dir(self) -> Path:
        """Of the run that left the checkpoint."""
        return self.checkpoint.parent.parent

    def provenance(self, config: EvaluateConfig | PerceptionConfig, seconds: float) -> dict[str, Any]:
        """Say how the numbers of an evaluation of so many seconds came about."""
        return {
            "command": command_line(),
            "checkpoint": config.checkpoint,
            "algorithm": self.trained.algorithm,
            "env_steps": self.counters["env_steps"],
            "trained_on": self.trained_on,
            "track": self.trained.track,
            "decoys": self.trained.decoys,
            "preset": self.trained.env.preset,
            "control_rate": self.trained.env.control_rate,
            "episodes": config.episodes,
            "seed": config.seed,
            "wall_clock_seconds": round(seconds, 1),
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            **self.machine,
        }


def restore(config: EvaluateConfig | PerceptionConfig) -> Restored:
    """Bring back the policy of a checkpoint, for the race that the configuration names.

    Raises:
        ValueError: it was not trained to race, or the device is not there.
        TrackError: there is no such track, or no such decoys on it.
    """
    machine = provenance()
    device = choose_device(config.device)
    checkpoint = latest_checkpoint(config.checkpoint)
    trained = trained_config(checkpoint.parent.parent)
    torch.manual_seed(config.seed)
    if not is_race(trained):
        raise ValueError(f"{checkpoint} was trained on {trained.task}; this recipe evaluates races.")
    trained_on = trained.track
    if config.track:
        trained.track, trained.decoys = config.track, None
    trained.decoys = config.decoys or trained.decoys
    trained.env.preset = config.preset or trained.env.preset
    trained.env.renderer = config.renderer
    learner, counters = restore_learner(trained, checkpoint, device)
    print(
        f"checkpoint: {checkpoint} ({trained.algorithm}, trained on {trained_on}, {counters['env_steps']:,} env_steps)"
    )
    return Restored(checkpoint, trained, trained_on, learner, counters, machine)


def fresh_directory(path: str | Path, result: str) -> Path:
    """Return a folder to write to: the one asked for, or if it holds a result already, the first free `<name>_2`, ...

    Args:
        path: the folder asked for.
        result: name of the file that is written last.
    """
    directory, number = Path(path), 1
    while (directory / result).exists():
        number += 1
        directory = Path(f"{path}_{number}")
    if number > 1:
        print(f"{path} holds an earlier {result}, which is kept: writing to {directory}")
    return ensure_writable(directory)


def heading(title: str, provenance: dict[str, Any]) -> str:
    """Return the head of a Markdown report: the title, the command, and where the numbers come from."""
    facts = {name: value for name, value in provenance.items() if name != "command" and value is not None}
    text = "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items())
    return f"# {title}\n\n```bash\n{provenance['command']}\n```\n\n{text}.\n"
