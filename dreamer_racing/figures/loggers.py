"""Loggers beside `metrics.csv`: TorchRL's own, that also take a run's configuration, pictures and films.

Each is a `torchrl.record.loggers.Logger` and a `training.media.MediaLogger`; `make_loggers` chooses them by name.
Nothing leaves the machine unless ``wandb="online"``.
"""

from __future__ import annotations

import importlib.util
import json
import secrets
from collections.abc import Mapping
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

GIF_FRAMES = 100  # of a film in TensorBoard, at most
GIF_WIDTH = 320  # pixels, at most
OUTCOMES = ("evaluation/success_rate", "evaluation/gates_per_episode", "evaluation/return_mean", "episode/return")
"""Metrics by which TensorBoard's table of hyperparameters compares runs."""


class Wandb(Enum):
    """Where what Weights & Biases gets goes."""

    none = "none"
    offline = "offline"
    online = "online"


@dataclass
class LoggerConfig:
    """Where metrics go besides metrics.csv."""

    tensorboard: bool = True
    wandb: Wandb = Wandb.none  # Weights & Biases; online alone sends anything
    project: str = "dreamer_racing"  # of W&B
    media: bool = True  # whether TensorBoard and W&B get plots and films of evaluations
    every: int = setting(2_000, NOT_NEGATIVE)  # env_steps between rows

    def check(self) -> None:
        """Refuse W&B where it is not installed.

        Raises:
            ValueError: so it is.
        """
        if self.wandb is not Wandb.none and importlib.util.find_spec("wandb") is None:
            raise ValueError(
                f"logger.wandb={self.wandb.value} needs the package wandb: {install_extra('wandb')}, or "
                "logger.wandb=none."
            )


def make_loggers(run_dir: str | Path, config: LoggerConfig, resume_env_steps: int | None = None) -> list[RunLogger]:
    """Make the loggers of a run.

    Args:
        run_dir: of the run; whatever is written lies in it, in ``tensorboard`` and in ``wandb``.
        config: says which.
        resume_env_steps: those of the checkpoint this run continues; None if it is new.

    Raises:
        ValueError: W&B is not installed.
    """
    config.check()
    loggers: list[RunLogger] = [TensorboardRunLogger(run_dir, resume_env_steps)] if config.tensorboard else []
    if config.wandb is not Wandb.none:
        offline, resumed = config.wandb is Wandb.offline, resume_env_steps is not None
        loggers.append(WandbRunLogger(run_dir, config.project, offline, resumed=resumed))
    return loggers


class TensorboardRunLogger(TensorboardLogger):
    """TensorBoard files of a run; what they hold beyond a run's resumption is not shown any more.

    Args:
        run_dir: of the run.
        resume_env_steps: those of the checkpoint this run continues; None if it is new.
    """

    def __init__(self, run_dir: str | Path, resume_env_steps: int | None = None) -> None:
        self._resume_env_steps = resume_env_steps
        super().__init__(exp_name="tensorboard", log_dir=str(run_dir))

    def _create_experiment(self) -> SummaryWriter:
        purge_step = None if self._resume_env_steps is None else self._resume_env_steps + 1
        return SummaryWriter(log_dir=str(Path(self.log_dir) / self.exp_name), purge_step=purge_step)

    def renew(self) -> None:
        """Go on in another file, after a write that failed: what comes behind it in this one is not read."""
        self.experiment: Any = SummaryWriter(log_dir=self.log_dir)

    def log_configuration(self, settings: Mapping[str, Any], text: str) -> None:
        """Show the configuration as text, and the settings in the table of hyperparameters."""
        self.experiment.add_text("configuration", f"```yaml\n{text}\n```", self._resume_env_steps or 0)
        self.log_hparams(dict(settings))

    def log_hparams(self, cfg: Any) -> None:
        """Enter the settings of this run; `SummaryWriter.add_hparams` would make a run of its own of each start."""
        from torch.utils.tensorboard.summary import hparams

        plain = (int, float, str)  # of a bool, TensorBoard would make a number
        known = {name: value if type(value) in plain else json.dumps(value, default=str) for name, value in cfg.items()}
        for summary in hparams(known, dict.fromkeys(OUTCOMES, 0.0)):
            self.experiment.file_writer.add_summary(summary)

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Show a PNG file as it is."""
        self._log_encoded(name, file.read_bytes(), env_steps)

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Show a film as a GIF, of no more frames and pixels than one looks at."""
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
    """A run of Weights & Biases, which a resumed run continues.

    Args:
        run_dir: of the run; its files and its id lie in ``run_dir/wandb``.
        project: of W&B.
        offline: whether nothing goes to the server; `wandb sync` sends it later.
        resumed: whether the run continues: then it has the id that it began with, if it had one.
    """

    def __init__(self, run_dir: str | Path, project: str, offline: bool, resumed: bool = False) -> None:
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
        """Take the settings."""
        self.log_hparams(dict(settings))

    def log_picture(self, name: str, file: Path, env_steps: int) -> None:
        """Take a PNG file as it is."""
        import wandb

        self.log_metrics({name: wandb.Image(str(file))}, step=env_steps)

    def log_film(self, name: str, file: Path, env_steps: int) -> None:
        """Take an mp4 file as it is."""
        import wandb

        self.log_metrics({name: wandb.Video(str(file), format="mp4")}, step=env_steps)


RunLogger = TensorboardRunLogger | WandbRunLogger


def read_film(file: Path, max_frames: int, max_width: int) -> tuple[np.ndarray, float]:
    """Read a film, leaving out frames and pixels.

    Args:
        file: mp4.
        max_frames: T at most: every second is kept, or every third, and so on.
        max_width: pixels at most, likewise.

    Returns:
        (T, H, W, 3) uint8, and the frames per second at which it plays as fast as the film.
    """
    reader: Any = imageio.get_reader(file, format="FFMPEG")
    with reader:
        fps = float(reader.get_meta_data()["fps"])
        frames = [np.asarray(frame) for frame in reader]
    every, coarser = -(-len(frames) // max_frames), -(-frames[0].shape[1] // max_width)
    return np.stack([frame[::coarser, ::coarser] for frame in frames[::every]]), fps / every
