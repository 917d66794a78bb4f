"""What loggers that can show more than scalars are given to show of a run.

`figures.loggers` has those that there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torchrl.record.loggers import Logger

from dreamer_racing.training.directory import RunDirectory


@runtime_checkable
class MediaLogger(Protocol):
    """What a run asks of a logger beside scalars."""

    def log_configuration(self, settings: Mapping[str, Any], text: str) -> None:
        """Take a run's settings by dotted name, and the same as YAML."""
        ...

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Take a PNG file."""
        ...

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Take an mp4 file."""
        ...


def log_evaluation(loggers: Sequence[Logger], directory: RunDirectory, env_steps: int) -> None:
    """Give loggers what evaluations at these env_steps have left to look at.

    Args:
        loggers: those among them that are no `MediaLogger` are left out.
        directory: of the run.
        env_steps: of the evaluation.
    """
    stem = f"{env_steps:09d}"
    for sink in loggers:
        if isinstance(sink, MediaLogger):
            for file in sorted(directory.plots.glob(f"{stem}*.png")):
                sink.log_picture(f"evaluation{file.stem.removeprefix(stem)}/plot", file, env_steps)
            for file in sorted(directory.videos.glob(f"{stem}*.mp4")):
                sink.log_film(f"evaluation{file.stem.removeprefix(stem)}/film", file, env_steps)
