"""Settings that change while a run goes on, by its length or by how well the policy flies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from itertools import product
from typing import Any

from tensordict import TensorDictBase

from dreamer_racing.learners.latent_ppo import KL_TOLERANCE
from dreamer_racing.settings import COUNT, POSITIVE, Range, allowed_values, setting
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


@dataclass
class ScheduleConfig:
    """Settings that move over a run, each from its own value `to` another, by its length or by the gates passed."""

    learning_rates: Ramp = field(default_factory=Ramp)  # `to`: share of all learning rates that is left
    world_model_rate: Ramp = field(default_factory=Ramp)  # `to`: share of that share, of the world model's alone
    discount: Ramp = field(default_factory=Ramp)  # loss.discount
    entropy_scale: Ramp = field(default_factory=Ramp)  # loss.entropy_scale
    min_std: Ramp = field(default_factory=Ramp)  # loss.min_std
    max_std: Ramp = field(default_factory=Ramp)  # loss.max_std
    start_on_line: Ramp = field(default_factory=Ramp)  # env.start_on_line

    @property
    def ramps(self) -> dict[str, Ramp]:
        """All of them by name."""
        return {name: ramp for name, ramp in vars(self).items() if isinstance(ramp, Ramp)}

    @property
    def by_length(self) -> list[str]:
        """Names of those that a longer run sets back."""
        return [name for name, ramp in self.ramps.items() if ramp.to is not None and ramp.by is not RampClock.passes]

    def check(self, owners: Mapping[str, Any], suite: str = "race") -> None:
        """Refuse ramps that end before they begin, or lead where the setting itself could not be.

        Args:
            owners: Configurations of the settings that move, by their names on the command line: ``loss``, ``env`` ...
            suite: The environment; only races have gates to go by.

        Raises:
            ValueError: The message names the ramp.
        """
        for name, ramp in self.ramps.items():
            ramp.check(f"schedule.{name}")
            if ramp.to is None:
                continue
            if suite != "race" and name == "start_on_line":
                raise ValueError(f"schedule.{name} is for races, and env.suite={suite}: leave it out.")
            if suite != "race" and ramp.by is not RampClock.run:
                raise ValueError(
                    f"schedule.{name}.by={ramp.by.value} goes by gates, and env.suite={suite} has none: by=run."
                )
            allowed = POSITIVE if name in SHARES_OF_RATES else allowed_values(owner_of(name, owners), name)
            if allowed is not None and ramp.to not in allowed:
                raise ValueError(f"schedule.{name}.to={ramp.to}: must be {allowed}.")
        self.check_deviations(owners["loss"])
        if self.start_on_line.to is not None and not owners["env"].start_on_line:
            raise ValueError("schedule.start_on_line begins at env.start_on_line=0: give that a share above 0.")

    def check_deviations(self, loss: Any) -> None:
        """Refuse a smallest deviation of actions above the largest, also where a ramp leads.

        Bounds that move on one clock are compared at its begin and at its end, others at every pair of those.

        Args:
            loss: Has both bounds.

        Raises:
            ValueError: The message names both settings.
        """
        ramps = {"min_std": self.min_std, "max_std": self.max_std}
        lowest, highest = (
            [(f"loss.{name}", getattr(loss, name)), (f"schedule.{name}.to", ramp.to)] for name, ramp in ramps.items()
        )
        together = len({(ramp.begin, ramp.end, ramp.by) for ramp in ramps.values()}) == 1
        moving = all(ramp.to is not None for ramp in ramps.values())
        pairs = zip(lowest, highest, strict=True) if together and moving else product(lowest, highest)
        for (low, least), (high, most) in pairs:
            if least is not None and most is not None and least >= most:
                raise ValueError(f"{low}={least} must be below {high}={most}: the bounds of the actions' deviation.")


@dataclass
class DreamerV3ScheduleConfig(ScheduleConfig):
    """And of what is imagined."""

    imagination_horizon: Ramp = field(default_factory=Ramp)  # model.imagination_horizon, rounded
    action_change_scale: Ramp = field(default_factory=Ramp)  # loss.action_change_scale


@dataclass
class LatentPPOScheduleConfig(ScheduleConfig):
    """And of an actor that learns from what was collected."""

    kl_target: Ramp = field(default_factory=Ramp)  # loss.ppo.kl_target
    # the actor waits while the model's error on the newest records is so many times that in training
    wait_for_model: float | None = setting(None, Range(1, open_below=True))
    wait_every: int = setting(5_000, COUNT)  # env_steps between two measurements of those errors

    def check(self, owners: Mapping[str, Any], suite: str = "race") -> None:
        """As `ScheduleConfig.check`; and refuse a target of the divergence that updates stop short of."""
        super().check(owners, suite)
        ppo, to = owners["loss.ppo"], self.kl_target.to
        if ppo.kl_target is None and to is not None:
            raise ValueError(
                f"schedule.kl_target.to={to} begins at loss.ppo.kl_target=null: give that a number, or leave the ramp "
                "out with schedule.kl_target.to=null."
            )
        for name, target in (("loss.ppo.kl_target", ppo.kl_target), ("schedule.kl_target.to", to)):
            if target is not None and ppo.kl_stop < KL_TOLERANCE * target:
                raise ValueError(
                    f"loss.ppo.kl_stop={ppo.kl_stop} ends updates before {name}={target} is seen to be exceeded: the "
                    f"stop must be at least {KL_TOLERANCE} times the target."
                )


SHARES_OF_RATES = ("learning_rates", "world_model_rate")
"""Ramps that begin at 1, and are no setting's own."""
ALWAYS = (*SHARES_OF_RATES, "min_std", "max_std", "kl_target")
"""What a learner is told of also where it does not move. The networks hold the bounds of deviations, and what a
checkpoint brings of another run's gives way to this run's."""


def owner_of(name: str, owners: Mapping[str, Any]) -> Any:
    """Return the configuration that has a setting of a name."""
    return next(owner for owner in owners.values() if hasattr(owner, name))


class Schedule:
    """Moves hyperparameters over a run: each from its own value along its ramp.

    Args:
        config: the ramps.
        owners: as of `ScheduleConfig.check`.
        total_env_steps: of the run.
        num_gates: of the track; 0: there is no race, and no ramp goes by its gates.

    Example:
        >>> from dreamer_racing.losses import LossConfig
        >>> config = ScheduleConfig(discount=Ramp(to=0.99, begin=0.5))
        >>> schedule = Schedule(config, {"loss": LossConfig(discount=0.98)}, total_env_steps=1000)
        >>> schedule.at(750)["discount"]
        0.985
    """

    def __init__(
        self, config: ScheduleConfig, owners: Mapping[str, Any], total_env_steps: int, num_gates: int = 0
    ) -> None:
        self.ramps: dict[str, tuple[float, Ramp]] = {}
        for name, ramp in config.ramps.items():
            if ramp.to is not None or name in ALWAYS:
                own = 1.0 if name in SHARES_OF_RATES else getattr(owner_of(name, owners), name)
                if own is not None:
                    self.ramps["rates" if name == "learning_rates" else name] = (own, ramp)
        self.total_env_steps = total_env_steps
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
        """Return all hyperparameters after so many env_steps, by the names that a learner's ``adjust`` has for them."""
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
