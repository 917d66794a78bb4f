"""Parsing of a vehicle's telemetry: battery voltages, IMU samples, and why it does not arm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

import numpy as np


class Telemetry(ABC):
    """Extracts battery voltages and IMU samples from bytes that arrive in chunks. Other frames are ignored.

    Attributes:
        imu_samples: IMU samples (6,) found so far, oldest first, see `hil.imu`; whoever reads them clears the list.
        rejected: Number of frames that were damaged or without a usable value, and of byte runs that were no frame.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self.imu_samples: list[np.ndarray] = []

    @abstractmethod
    def read(self, data: bytes) -> list[float]:
        """Parse bytes; return the voltages in them, V, oldest first. It never raises."""

    def refusal(self, armed: bool) -> str:
        """Return why the flight controller does not (if not ``armed``: would not) follow commands, if it is known."""
        return ""


class FrameReader:
    """Splits a stream of bytes into frames. Damaged bytes are skipped up to the next intact frame.

    Args:
        size_of: Returns the size of the frame at the start of the given bytes, up to 8; 0 if more bytes are needed to
            tell; None if no frame starts there.
        is_whole: Returns whether the checksum of a frame is right.
    """

    def __init__(self, size_of: Callable[[bytes], int | None], is_whole: Callable[[bytes], bool]) -> None:
        self.size_of, self.is_whole = size_of, is_whole
        self._buffer = bytearray()
        self._lost = False  # whether the last byte was skipped: consecutive ones count once

    def read(self, data: bytes) -> Iterator[bytes | None]:
        """Add bytes; yield the intact frames in them, oldest first, and None for damaged ones and runs of no frame."""
        self._buffer += data
        while self._buffer:
            size = self.size_of(bytes(self._buffer[:8]))
            if size is not None and not 0 < size <= len(self._buffer):
                return  # the rest is on its way
            frame = bytes(self._buffer[: size or 0])
            if size is None or not self.is_whole(frame):
                counts, self._lost = size is not None or not self._lost, True
                del self._buffer[0]
                if counts:
                    yield None
                continue
            del self._buffer[:size]
            self._lost = False
            yield frame
