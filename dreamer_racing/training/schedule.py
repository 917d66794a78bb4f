"""Settings that change while a run goes on, by its length or by how well the policy flies."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Clock(Enum):
    """What a ramp goes by, a number from 0 to 1."""

    run = "run"  # share of the run's env_steps
    passes = "passes"  # best share of gates passed in training, `PassShare`


@dataclass
class Ramp:
    """A setting that moves linearly from its own value to another, between two times of its clock, and back.

    Attributes:
        to: Where it ends; None: it stays at its own value.
        begin: Time at which it leaves its own value.
        end: Time from which on it stays at ``to``.
        until: Time from which on it has its own value again, at once; None: it stays.
        by: The clock: the share of the run's env_steps that are made, or that of gates that are passed.

    Example:
        >>> Ramp(to=0.99, begin=0.5, end=1.0).at(0.98, progress=0.75)
        0.985
    """

    to: float | None = None
    begin: float = 0.0
    end: float = 1.0
    until: float | None = None
    by: Clock = Clock.run

    def check(self, name: str) -> None:
        """Refuse a ramp that ends before it begins, turns back before it ends, or lies outside the run.

        Args:
            name: Of the setting, for the message.

        Raises:
            ValueError: The message gives both ends.
        """
        if not 0.0 <= self.begin <= self.end <= 1.0:
            raise ValueError(
                f"{name}: begin={self.begin} and end={self.end} are shares, so it takes 0 <= begin <= end <= 1."
            )
        if self.until is not None and not self.end <= self.until <= 1.0:
            raise ValueError(f"{name}: until={self.until} must be at least end={self.end} and at most 1, or null.")

    def at(self, value: float, progress: float) -> float:
        """Return the setting at a time of its clock.

        Args:
            value: Its own value, where it begins.
            progress: The clock's time; beyond 1 it counts as 1.
        """
        if self.to is None or (self.until is not None and progress >= self.until):
            return value
        if progress >= self.end:
            return self.to
        if progress <= self.begin:
            return value
        return value + (self.to - value) * (progress - self.begin) / (self.end - self.begin)
