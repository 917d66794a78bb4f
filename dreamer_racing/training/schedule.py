"""Settings that change while a run goes on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Ramp:
    """A setting that moves linearly from its own value to another, between two shares of a run's env_steps, and back.

    Attributes:
        to: Where it ends; None: it stays at its own value.
        begin: Share of the run at which it leaves its own value.
        end: Share of the run from which on it stays at ``to``.
        until: Share of the run from which on it has its own value again, at once; None: it stays.

    Example:
        >>> Ramp(to=0.99, begin=0.5, end=1.0).at(0.98, progress=0.75)
        0.985
    """

    to: float | None = None
    begin: float = 0.0
    end: float = 1.0
    until: float | None = None

    def check(self, name: str) -> None:
        """Refuse a ramp that ends before it begins, turns back before it ends, or lies outside the run.

        Args:
            name: Of the setting, for the message.

        Raises:
            ValueError: The message gives both ends.
        """
        if not 0.0 <= self.begin <= self.end <= 1.0:
            raise ValueError(
                f"{name}: begin={self.begin} and end={self.end} are shares of the run's env_steps, so it takes "
                "0 <= begin <= end <= 1."
            )
        if self.until is not None and not self.end <= self.until <= 1.0:
            raise ValueError(f"{name}: until={self.until} must be at least end={self.end} and at most 1, or null.")

    def at(self, value: float, progress: float) -> float:
        """Return the setting at a share of the run.

        Args:
            value: Its own value, where it begins.
            progress: Share of the run's env_steps that are made; beyond 1 it counts as 1.
        """
        if self.to is None or (self.until is not None and progress >= self.until):
            return value
        if progress >= self.end:
            return self.to
        if progress <= self.begin:
            return value
        return value + (self.to - value) * (progress - self.begin) / (self.end - self.begin)
