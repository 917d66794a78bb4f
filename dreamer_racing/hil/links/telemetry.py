"""What comes back from a vehicle, as far as it is read: voltages, what its IMU tells, why it does not arm."""

from __future__ import annotations

from abc import ABC, abstractmethod

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


class FrameTelemetry(Telemetry):
    """Cuts a stream of bytes into frames; a subclass says what a frame is, and what it says.

    What is damaged is skipped up to the next frame that is whole.
    """

    def __init__(self) -> None:
        super().__init__()
        self._buffer = bytearray()
        self._lost = False  # whether the last byte was skipped: those in a row count once

    @abstractmethod
    def frame_size(self, data: bytes) -> int | None:
        """Return the size of the frame that begins the data; 0 if that takes more bytes to tell; None: none begins."""

    @abstractmethod
    def is_whole(self, frame: bytes) -> bool:
        """Whether the checksum of a frame is right."""

    @abstractmethod
    def is_battery(self, frame: bytes) -> bool:
        """Whether a whole frame speaks of the battery."""

    @abstractmethod
    def voltage(self, frame: bytes) -> float | None:
        """Return what a frame that speaks of the battery says, V; None if it is too short, or there is no battery."""

    def is_imu(self, frame: bytes) -> bool:
        """Whether a whole frame speaks of the IMU."""
        return False

    def sample(self, frame: bytes) -> np.ndarray | None:
        """Return what a frame that speaks of the IMU says, (6,); None if it is too short, or there is none."""
        raise NotImplementedError(f"{type(self).__name__} reads no IMU.")

    def note(self, frame: bytes) -> None:
        """Take in a whole frame that speaks of something else."""

    def read(self, data: bytes) -> list[float]:
        """Take in bytes; return the voltages in them, V, oldest first."""
        self._buffer += data
        voltages = []
        while self._buffer:
            size = self.frame_size(bytes(self._buffer[:8]))
            if size is not None and not 0 < size <= len(self._buffer):
                break  # the rest is on its way
            frame = bytes(self._buffer[: size or 0])
            if size is None or not self.is_whole(frame):
                self.rejected += size is not None or not self._lost
                self._lost = True
                del self._buffer[0]
                continue
            del self._buffer[:size]
            self._lost = False
            if self.is_battery(frame):
                voltage = self.voltage(frame)
                self.rejected += voltage is None
                voltages += [] if voltage is None else [voltage]
            elif self.is_imu(frame):
                sample = self.sample(frame)
                self.rejected += sample is None
                self.felt += [] if sample is None else [sample]
            else:
                self.note(frame)
        return voltages
