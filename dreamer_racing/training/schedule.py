"""Settings that change while a run goes on, by its length or by how well the policy flies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum


class RampClock(Enum):
    """What a ramp goes by, a number from 0 to 1."""

    run = "run"  # share of the run's env_steps
    passes = "passes"  # best share of flights that pass the hardest gate, `PassShare.best`
    known = "known"  # the same, and on by itself once that gate is known, `PassShare.known`


@dataclass
class Ramp:
    """A setting that moves linearly from its own value to another, between two times of its clock.

    Attributes:
        to: Where it ends; None: it stays at its own value.
        begin: Time at which it leaves its own value.
        end: Time from which on it stays at ``to``.
        by: The clock: the share of the run's env_steps that are made, or that of flights that pass the hardest gate,
            with time or without.

    Example:
        >>> Ramp(to=0.99, begin=0.5, end=1.0).at(0.98, {RampClock.run: 0.75})
        0.985
    """

    to: float | None = None
    begin: float = 0.0
    end: float = 1.0
    by: RampClock = RampClock.run

    def check(self, name: str) -> None:
        """Refuse a ramp that ends before it begins, or lies outside the run.

        Args:
            name: Of the setting, for the message.

        Raises:
            ValueError: The message gives both ends.
        """
        if not 0.0 <= self.begin <= self.end <= 1.0:
            raise ValueError(
                f"{name}: begin={self.begin} and end={self.end} are shares, so it takes 0 <= begin <= end <= 1."
            )

    def at(self, value: float, times: Mapping[RampClock, float]) -> float:
        """Return the setting at a time.

        Args:
            value: Its own value, where it begins.
            times: What the clocks say; beyond 1 counts as 1.
        """
        if self.to is None:
            return value
        progress = times[self.by]
        if progress >= self.end:
            return self.to
        if progress <= self.begin:
            return value
        return value + (self.to - value) * (progress - self.begin) / (self.end - self.begin)
