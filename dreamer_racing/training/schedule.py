"""Settings that change while a run goes on, by its length or by how well the policy flies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum


class Clock(Enum):
    """What a ramp goes by, a number from 0 to 1."""

    run = "run"  # share of the run's env_steps
    passes = "passes"  # best share of flights that pass the hardest gate, `PassShare`


@dataclass
class Ramp:
    """A setting that moves linearly from its own value to another, between two times of its clock, and back.

    Attributes:
        to: Where it ends; None: it stays at its own value.
        begin: Time at which it leaves its own value.
        end: Time from which on it stays at ``to``.
        until: Time from which on it has its own value again, at once; None: it stays.
        by: The clock: the share of the run's env_steps that are made, or that of flights that pass the hardest gate.
        until_by: The clock of ``until``; None: the same.

    Example:
        >>> Ramp(to=0.99, begin=0.5, end=1.0).at(0.98, {Clock.run: 0.75})
        0.985
    """

    to: float | None = None
    begin: float = 0.0
    end: float = 1.0
    until: float | None = None
    by: Clock = Clock.run
    until_by: Clock | None = None

    @property
    def clocks(self) -> set[Clock]:
        """Those that it goes by."""
        return {self.by, self._until_by}

    @property
    def _until_by(self) -> Clock:
        return self.by if self.until_by is None else self.until_by

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
        if self.until is None:
            if self.until_by is not None:
                raise ValueError(f"{name}: until_by={self.until_by.value} says by what, and there is no until.")
            return
        least = self.end if self._until_by is self.by else 0.0
        if not least <= self.until <= 1.0:
            bound = f"at least end={least}" if self._until_by is self.by else "at least 0"
            raise ValueError(f"{name}: until={self.until} must be {bound} and at most 1, or null.")

    def at(self, value: float, times: Mapping[Clock, float]) -> float:
        """Return the setting at a time.

        Args:
            value: Its own value, where it begins.
            times: What the clocks say; beyond 1 counts as 1.
        """
        if self.to is None or (self.until is not None and times[self._until_by] >= self.until):
            return value
        progress = times[self.by]
        if progress >= self.end:
            return self.to
        if progress <= self.begin:
            return value
        return value + (self.to - value) * (progress - self.begin) / (self.end - self.begin)
