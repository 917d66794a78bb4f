"""Protocol of loggers that also take configurations, pictures and videos; `figures.loggers` implements them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from torchrl.record.loggers import Logger

from dreamer_racing.training.directory import RunDirectory


@runtime_checkable
class MediaLogger(Protocol):
    """Methods of a logger that takes more than scalars."""

    def log_configuration(self, settings: Mapping[str, Any], text: str) -> None:
        """Log a run's settings by dotted name, and the same as YAML text."""
        ...

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Log a PNG file."""
        ...

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Log an mp4 file."""
        ...


def log_evaluation(loggers: Sequence[Logger], directory: RunDirectory, env_steps: int) -> None:
    """Log the plots and videos of the evaluations at ``env_steps``.

    Args:
        loggers: Loggers; those that are not a `MediaLogger` are skipped.
        directory: Run directory.
        env_steps: env_steps of the evaluation.
    """
    stem = f"{env_steps:09d}"
    for sink in loggers:
        if isinstance(sink, MediaLogger):
            for file in sorted(directory.plots.glob(f"{stem}*.png")):
                sink.log_picture(f"evaluation{file.stem.removeprefix(stem)}/plot", file, env_steps)
            for file in sorted(directory.videos.glob(f"{stem}*.mp4")):
                sink.log_film(f"evaluation{file.stem.removeprefix(stem)}/film", file, env_steps)
