"""Settings that change while a run goes on, by its length or by how well the policy flies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from tensordict import TensorDictBase

from dreamer_racing.training.gate_pass_rate import GatePassRate


class RampClock(Enum):
    """What a ramp goes by, a number from 0 to 1."""

    run = "run"  # share of the run's env_steps
    passes = "passes"  # best share of flights that pass the hardest gate, `GatePassRate.best`
    known = "known"  # the same, and on by itself once that gate is known, `GatePassRate.known`


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


class Schedule:
    """Moves hyperparameters over a run: each from its own value along its ramp.

    Args:
        ramps: value and ramp of each, by name.
        total_env_steps: of the run.
        num_gates: of the track; 0: there is no race, and no ramp goes by its gates.

    Example:
        >>> schedule = Schedule({"discount": (0.98, Ramp(to=0.99, begin=0.5))}, total_env_steps=1000)
        >>> schedule.at(750)
        {'discount': 0.985}
    """

    def __init__(self, ramps: Mapping[str, tuple[float, Ramp]], total_env_steps: int, num_gates: int = 0) -> None:
        self.ramps, self.total_env_steps = dict(ramps), total_env_steps
        self.pass_rate = GatePassRate(num_gates)

    def observe(self, episodes: TensorDictBase, env_steps: int) -> dict[str, float]:
        """Take note of the gates that finished episodes passed, by which some ramps go; return metrics.

        Args:
            episodes: Batch ``[E]`` of ``EpisodeTracker.update``.
            env_steps: Made so far.
        """
        if not len(episodes) or "gates_passed" not in episodes:
            return {}
        share = self.pass_rate.update(episodes, env_steps)
        return {"episode/pass_share": share, "episode/hardest_gate": float(self.pass_rate.hardest_gate)}

    def at(self, env_steps: int) -> dict[str, float]:
        """Return all hyperparameters after so many env_steps, by name."""
        times = {
            RampClock.run: env_steps / self.total_env_steps,
            RampClock.passes: self.pass_rate.best,
            RampClock.known: self.pass_rate.known(env_steps, self.total_env_steps),
        }
        return {name: ramp.at(value, times) for name, (value, ramp) in self.ramps.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return self.pass_rate.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.pass_rate.load_state_dict(state_dict)
