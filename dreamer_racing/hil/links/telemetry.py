"""What comes back from a vehicle, as far as it is read: voltages, what its IMU tells, why it does not arm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

import numpy as np


class Telemetry(ABC):
    """Finds battery voltages and samples of an IMU in bytes that arrive in pieces. Other frames are passed over.

    Attributes:
        felt: Samples (6,) of the IMU that have been found, oldest first, see `hil.imu`; whoever takes them clears it.
        rejected: Frames so far that were damaged or say no voltage, and stretches of bytes that were no frame.
    """

    def __init__(self) -> None:
        self.rejected = 0
        self.felt: list[np.ndarray] = []

    @abstractmethod
    def read(self, data: bytes) -> list[float]:
        """Take in bytes; return the voltages in them, V, oldest first. It never raises."""

    def refusal(self, armed: bool) -> str:
        """Return why the flight controller does not fly what it is told, or would not; empty as far as is known.

        Args:
            armed: Whether it was told to be armed.
        """
        return ""


class FrameReader:
    """Cuts a stream of bytes into frames. What is damaged is skipped up to the next frame that is whole.

    Args:
        size_of: Returns the size of the frame that begins the bytes that it is given, up to 8; 0 if that takes more
            bytes to tell; None: none begins.
        is_whole: Returns whether the checksum of a frame is right.

    Attributes:
        rejected: Frames so far that were damaged, and stretches of bytes that were no frame.
    """

    def __init__(self, size_of: Callable[[bytes], int | None], is_whole: Callable[[bytes], bool]) -> None:
        self.size_of, self.is_whole = size_of, is_whole
        self.rejected = 0
        self._buffer = bytearray()
        self._lost = False  # whether the last byte was skipped: those in a row count once

    def read(self, data: bytes) -> Iterator[bytes]:
        """Take in bytes; yield the whole frames in them, oldest first."""
        self._buffer += data
        while self._buffer:
            size = self.size_of(bytes(self._buffer[:8]))
            if size is not None and not 0 < size <= len(self._buffer):
                return  # the rest is on its way
            frame = bytes(self._buffer[: size or 0])
            if size is None or not self.is_whole(frame):
                self.rejected += size is not None or not self._lost
                self._lost = True
                del self._buffer[0]
                continue
            del self._buffer[:size]
            self._lost = False
            yield frame
