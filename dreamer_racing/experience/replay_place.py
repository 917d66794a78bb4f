"""Size of a replay, and where its records are stored."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dreamer_racing import parallel
from dreamer_racing.experience.replay import ReplayConfig, Storage
from dreamer_racing.experience.streams import END_KEYS, RACE_REWARD_KEYS
from dreamer_racing.machine import available_memory, check_fits, check_space
from dreamer_racing.modules.rssm import LatentFormat


class ReplayPlace(NamedTuple):
    """Where one process stores a replay of ``capacity`` records, of ``size`` bytes when full.

    Attributes:
        device: Device that stores the records.
        files: Folder of memory-mapped files; None for memory.
    """

    capacity: int
    size: int
    device: str
    files: Path | None

    def __str__(self) -> str:
        where = f"files below {self.files}, until the process ends" if self.files else f"memory of {self.device}"
        return f"replay: {self.capacity:,} records, {self.size / 1e9:.1f} GB when full, in {where}"

    def prepare(self) -> None:
        """Check that the replays of all processes fit, and make the folder of files without a killed run's."""
        asked = f"replay.capacity={self.capacity * parallel.num_processes():,}"
        if self.files is None:
            sharing = parallel.num_local_processes() if self.device == "cpu" else 1
            check_fits(self.size * sharing, self.device, asked)
            return
        shutil.rmtree(self.files, ignore_errors=True)
        check_space(self.size * parallel.num_processes(), self.files, asked)
        self.files.mkdir(parents=True, exist_ok=True)


def choose_place(config: ReplayConfig, size: int, learner: str, folder: Path) -> ReplayPlace:
    """Choose where to store a replay of ``size`` bytes: files go to ``folder``.

    With ``device=auto`` it is the learner's device, if the replay takes less than half its free memory.
    """
    if config.storage is Storage.memmap:
        return ReplayPlace(config.capacity, size, "cpu", folder)
    fits = learner != "cpu" and size < 0.5 * available_memory(learner)
    device = (learner if fits else "cpu") if config.device == "auto" else config.device
    return ReplayPlace(config.capacity, size, device, None)


def replay_bytes(
    capacity: int,
    image_shape: Sequence[int] = (64, 64, 3),
    action_size: int = 4,
    numbers: int = 0,
    latents: LatentFormat | None = None,
) -> int:
    """Return the size in bytes of a replay of ``capacity`` records (12.3 KB each at 64×64).

    ``numbers`` are the float32 values observed besides the image: ``vector`` and the privileged one.
    """
    flags, context = 1 + len(END_KEYS), latents.bytes if latents else 0
    floats = action_size + len(RACE_REWARD_KEYS) + numbers
    return capacity * (math.prod(image_shape) + 4 * floats + flags + context)
