"""TensorBoard and Weights & Biases loggers: TorchRL's own, extended to log a run's configuration, images and videos.

No data leaves the machine unless ``wandb="online"``.
"""

from __future__ import annotations

import importlib.util
import json
import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from torch.utils.tensorboard import SummaryWriter
from torchrl.record.loggers.tensorboard import TensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger

from dreamer_racing.commands import install_extra
from dreamer_racing.figures.film import write_gif
from dreamer_racing.settings import NOT_NEGATIVE, setting
from dreamer_racing.training.directory import RunDirectory

GIF_FRAMES = 100  # maximum, of a video in TensorBoard
GIF_WIDTH = 320  # maximum, pixels
OUTCOMES = ("evaluation/success_rate", "evaluation/gates_per_episode", "evaluation/return_mean", "episode/return")
"""Metrics by which TensorBoard's table of hyperparameters compares runs."""


class Wandb(Enum):
    """Mode of Weights & Biases."""

    none = "none"
    offline = "offline"
    online = "online"


@dataclass
class LoggerConfig:
    """Settings of the loggers besides metrics.csv."""

    tensorboard: bool = True
    wandb: Wandb = Wandb.none  # Weights & Biases; only online sends data
    project: str = "dreamer_racing"  # name of the W&B project
    media: bool = True  # whether to log plots and videos of evaluations to TensorBoard and W&B
    every: int = setting(2_000, NOT_NEGATIVE)  # env_steps between rows

    def check(self) -> None:
        """Raise ValueError if W&B is configured but not installed."""
        if self.wandb is not Wandb.none and importlib.util.find_spec("wandb") is None:
            raise ValueError(
                f"logger.wandb={self.wandb.value} needs the package wandb: {install_extra('wandb')}, or "
                "logger.wandb=none."
            )


def make_loggers(run_dir: str | Path, config: LoggerConfig, resume_env_steps: int | None = None) -> list[RunLogger]:
    """Make the loggers of a run, which write to its folders ``tensorboard`` and ``wandb``.

    ``resume_env_steps`` is that of the checkpoint that the run resumes from; None for a new run.

    Raises:
        ValueError: W&B is configured but not installed.
    """
    config.check()
    loggers: list[RunLogger] = [TensorboardRunLogger(run_dir, resume_env_steps)] if config.tensorboard else []
    if config.wandb is not Wandb.none:
        offline, resumed = config.wandb is Wandb.offline, resume_env_steps is not None
        loggers.append(WandbRunLogger(run_dir, config.project, offline, resumed))
    return loggers


class TensorboardRunLogger(TensorboardLogger):
    """TensorBoard files of a run; on resumption, entries after the checkpoint are purged."""

    def __init__(self, run_dir: str | Path, resume_env_steps: int | None = None) -> None:
        self._resume_env_steps = resume_env_steps
        super().__init__(exp_name="tensorboard", log_dir=str(run_dir))

    def _create_experiment(self) -> SummaryWriter:
        purge_step = None if self._resume_env_steps is None else self._resume_env_steps + 1
        return SummaryWriter(log_dir=str(Path(self.log_dir) / self.exp_name), purge_step=purge_step)

    def renew(self) -> None:
        """Continue in a new file after a failed write, because TensorBoard reads nothing behind it in the old one."""
        with suppress(OSError):  # its own `close` would write first, and fail before it ends its thread
            self.experiment.file_writer.event_writer.close()
        self.experiment: Any = SummaryWriter(log_dir=self.log_dir)

    def log_configuration(self, settings: Mapping[str, Any], text: str) -> None:
        """Log the configuration as text, and the settings to the table of hyperparameters."""
        self.experiment.add_text("configuration", f"```yaml\n{text}\n```", self._resume_env_steps or 0)
        self.log_hparams(dict(settings))

    def log_hparams(self, cfg: Any) -> None:
        """Log the settings of this run; `SummaryWriter.add_hparams` would create a separate run at each start."""
        from torch.utils.tensorboard.summary import hparams

        plain = (int, float, str)  # not bool, which TensorBoard would show as a number
        known = {name: value if type(value) in plain else json.dumps(value, default=str) for name, value in cfg.items()}
        for summary in hparams(known, dict.fromkeys(OUTCOMES, 0.0)):
            self.experiment.file_writer.add_summary(summary)

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Log a PNG file unchanged."""
        self._log_encoded(name, file.read_bytes(), env_steps)

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Log a video as a GIF, reduced to `GIF_FRAMES` and `GIF_WIDTH`."""
        frames, fps = read_film(file, GIF_FRAMES, GIF_WIDTH)
        gif = file.with_name(f".{file.stem}.gif")
        write_gif(gif, frames, fps)
        try:
            self._log_encoded(name, gif.read_bytes(), env_steps)
        finally:
            gif.unlink()

    def _log_encoded(self, name: str, image: bytes, env_steps: int) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        shown = Summary.Value(tag=name, image=Summary.Image(colorspace=3, encoded_image_string=image))
        self.experiment.file_writer.add_summary(Summary(value=[shown]), env_steps)


class WandbRunLogger(WandbLogger):
    """A run of Weights & Biases with its files and id in ``run_dir/wandb``, which a resumed run continues.

    If ``offline``, nothing is sent to the server; `wandb sync` sends it later.
    """

    def __init__(self, run_dir: str | Path, project: str, offline: bool, resumed: bool) -> None:
        place = RunDirectory(Path(run_dir)).wandb_run
        place.parent.mkdir(parents=True, exist_ok=True)
        if not (resumed and place.exists()):
            place.write_text(json.dumps({"id": secrets.token_hex(4)}) + "\n", encoding="utf-8")
        super().__init__(
            exp_name=Path(run_dir).resolve().name,
            offline=offline,
            log_dir=str(run_dir),
            id=json.loads(place.read_text(encoding="utf-8"))["id"],
            project=project,
            log_env_packages=False,
            mode="offline" if offline else "online",
        )

    def log_configuration(self, settings: Mapping[str, Any], text: str) -> None:
        """Log the settings."""
        self.log_hparams(dict(settings))

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Log a PNG file."""
        import wandb

        self.log_metrics({name: wandb.Image(str(file))}, step=env_steps)

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Log an mp4 file."""
        import wandb

        self.log_metrics({name: wandb.Video(str(file), format="mp4")}, step=env_steps)


RunLogger = TensorboardRunLogger | WandbRunLogger


def read_film(file: Path, max_frames: int, max_width: int) -> tuple[np.ndarray, float]:
    """Read a video, keeping every second frame and pixel, every third, and so on, to have at most as many.

    Returns:
        (T, H, W, 3) uint8, and the frames per second that preserve the video's speed.
    """
    reader: Any = imageio.get_reader(file, format="FFMPEG")
    with reader:
        fps = float(reader.get_meta_data()["fps"])
        frames = [np.asarray(frame) for frame in reader]
    every, coarser = -(-len(frames) // max_frames), -(-frames[0].shape[1] // max_width)
    return np.stack([frame[::coarser, ::coarser] for frame in frames[::every]]), fps / every
