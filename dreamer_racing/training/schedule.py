"""Schedules of hyperparameters, the replay ratio, and the check whether the policy should wait for its world model."""

from __future__ import annotations

import logging
import math
import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dreamer_racing.losses.config import KL_TOLERANCE
from dreamer_racing.settings import COUNT, POSITIVE, Range, allowed_values, setting
from dreamer_racing.training.episodes import GatePassRate

logger = logging.getLogger(__name__)

ERRORS = ("privileged_error", "image_error", "loss_vector", "reward_error")
"""Metrics of a world model by which a lag can be measured, best first."""
MEDIAN_WINDOW = 5
"""Number of latest measurements whose median is used, so that a single unusual flight does not count [choice]."""
PATIENCE = 10
"""Measurements that a policy waits at most; it waits again only after the ratio fell below the limit [choice]."""


class RampClock(Enum):
    """Progress measure of a ramp, a number from 0 to 1."""

    run = "run"  # share of the run's env_steps
    passes = "passes"  # best pass rate of the gate with the lowest pass rate, `GatePassRate.best`
    known = "known"  # the same, but also rises with time once that rate is high enough, `GatePassRate.progress`


@dataclass
class Ramp:
    """Linear change of a hyperparameter from its configured value to another, between two times of a clock.

    Attributes:
        to: Final value; None keeps the configured value.
        begin: Time at which the change begins.
        end: Time at which ``to`` is reached.
        by: Clock: ``run`` is the share of the run's env_steps; ``passes`` is the pass rate of the gate with the lowest
            one; ``known`` is the same, but rises with time, too, once a threshold is reached.

    Example:
        >>> Ramp(to=0.99, begin=0.5, end=1.0).at(0.98, {RampClock.run: 0.75})
        0.985
    """

    to: float | None = None
    begin: float = 0.0
    end: float = 1.0
    by: RampClock = RampClock.run

    def check(self, name: str) -> None:
        """Raise ``ValueError`` unless 0 <= begin <= end <= 1."""
        if not 0.0 <= self.begin <= self.end <= 1.0:
            raise ValueError(f"{name}: begin={self.begin} and end={self.end} must satisfy 0 <= begin <= end <= 1.")

    def at(self, value: float, times: Mapping[RampClock, float]) -> float:
        """Return the value to which the ramp has moved a configured one, by the times of all clocks."""
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
    """Ramps of hyperparameters, each from its configured value `to` another, by env_steps or by the gate pass rate."""

    learning_rates: Ramp = field(default_factory=Ramp)  # `to`: final factor on all learning rates
    world_model_rate: Ramp = field(default_factory=Ramp)  # `to`: further final factor on the world model's rate
    discount: Ramp = field(default_factory=Ramp)  # loss.discount
    entropy_scale: Ramp = field(default_factory=Ramp)  # loss.entropy_scale
    min_std: Ramp = field(default_factory=Ramp)  # loss.min_std
    max_std: Ramp = field(default_factory=Ramp)  # loss.max_std
    start_on_line: Ramp = field(default_factory=Ramp)  # env.start_on_line

    @property
    def ramps(self) -> dict[str, Ramp]:
        """All ramps by name."""
        return {name: ramp for name, ramp in vars(self).items() if isinstance(ramp, Ramp)}

    @property
    def by_length(self) -> list[str]:
        """Names of the active ramps that depend on the run's total env_steps."""
        return [name for name, ramp in self.ramps.items() if ramp.to is not None and ramp.by is not RampClock.passes]

    def check(self, owners: Mapping[str, Any], suite: str = "race") -> None:
        """Check the times of all ramps, and that each final value is allowed for its hyperparameter.

        Args:
            owners: Configurations that hold the hyperparameters, by their command-line names: ``loss``, ``env`` ...
            suite: Environment suite; only races have gates.

        Raises:
            ValueError: They are not; the message names the ramp.
        """
        for name, ramp in self.ramps.items():
            ramp.check(f"schedule.{name}")
            if ramp.to is None:
                continue
            if suite != "race" and name == "start_on_line":
                raise ValueError(f"schedule.{name} is for races, and env.suite={suite}: leave it out.")
            if suite != "race" and ramp.by is not RampClock.run:
                raise ValueError(
                    f"schedule.{name}.by={ramp.by.value} depends on gates, and env.suite={suite} has none: set by=run."
                )
            allowed = POSITIVE if name in RATE_FACTORS else allowed_values(owner_of(name, owners), name)
            if allowed is not None and ramp.to not in allowed:
                raise ValueError(f"schedule.{name}.to={ramp.to}: must be {allowed}.")
        self.check_deviations(owners["loss"])
        if self.start_on_line.to is not None and not owners["env"].start_on_line:
            raise ValueError("schedule.start_on_line starts from env.start_on_line=0: set that above 0.")

    def check_deviations(self, loss: Any) -> None:
        """Raise ``ValueError`` unless ``min_std`` stays below ``max_std`` during the ramps of both.

        If both ramps have the same clock and times, the bounds are compared at begin and end, else in all combinations.
        """
        low_ramp, high_ramp = self.min_std, self.max_std
        lowest = [("loss.min_std", loss.min_std), ("schedule.min_std.to", low_ramp.to)]
        highest = [("loss.max_std", loss.max_std), ("schedule.max_std.to", high_ramp.to)]
        together = replace(low_ramp, to=None) == replace(high_ramp, to=None)
        moving = low_ramp.to is not None and high_ramp.to is not None
        pairs = zip(lowest, highest, strict=True) if together and moving else product(lowest, highest)
        for (low, least), (high, most) in pairs:
            if least is not None and most is not None and least >= most:
                apart = ", which move at different times (begin, end, by)" if moving else ""
                raise ValueError(
                    f"{low}={least} must be below {high}={most}: the bounds of the standard deviation{apart}."
                )


@dataclass
class DreamerV3ScheduleConfig(ScheduleConfig):
    """Ramps of DreamerV3, including those of imagination."""

    imagination_horizon: Ramp = field(default_factory=Ramp)  # model.imagination_horizon, rounded
    action_change_scale: Ramp = field(default_factory=Ramp)  # loss.action_change_scale
    averaged_kl_scale: Ramp = field(default_factory=Ramp)  # loss.averaged_kl_scale
    crash_weight: Ramp = field(default_factory=Ramp)  # loss.crash_weight

    def check(self, owners: Mapping[str, Any], suite: str = "race") -> None:
        """Check as `ScheduleConfig.check` does, and that there are averaged weights if the policy is held near them."""
        super().check(owners, suite)
        largest = max(owners["loss"].averaged_kl_scale, self.averaged_kl_scale.to or 0.0)
        if largest > 0 and owners["model"].average_rate is None:
            raise ValueError(
                f"loss.averaged_kl_scale of up to {largest:g} needs averaged weights: set model.average_rate, such as "
                "to 0.005."
            )


@dataclass
class LatentPPOScheduleConfig(ScheduleConfig):
    """Ramps of latent PPO, and its check of the world model's lag."""

    kl_target: Ramp = field(default_factory=Ramp)  # loss.ppo.kl_target
    # the actor waits while the model's error on the newest records is more than this factor times that in training
    wait_for_model: float | None = setting(None, Range(1, open_below=True))
    wait_every: int = setting(5_000, COUNT)  # env_steps between two measurements of those errors

    def check(self, owners: Mapping[str, Any], suite: str = "race") -> None:
        """Check as `ScheduleConfig.check` does, and that ``kl_stop`` is well above the largest ``kl_target``."""
        super().check(owners, suite)
        ppo, to = owners["loss.ppo"], self.kl_target.to
        if ppo.kl_target is None and to is not None:
            raise ValueError(
                f"schedule.kl_target.to={to} starts from loss.ppo.kl_target=null: set that to a number, or turn the "
                "ramp off with schedule.kl_target.to=null."
            )
        for name, target in (("loss.ppo.kl_target", ppo.kl_target), ("schedule.kl_target.to", to)):
            if target is not None and ppo.kl_stop < KL_TOLERANCE * target:
                raise ValueError(
                    f"loss.ppo.kl_stop={ppo.kl_stop} must be at least {KL_TOLERANCE} times {name}={target}: otherwise "
                    "updates stop before the target is clearly exceeded."
                )


RATE_FACTORS = ("learning_rates", "world_model_rate")
"""Ramps of factors, which start at 1 instead of a configured value."""
ALWAYS = (*RATE_FACTORS, "min_std", "max_std", "kl_target")
"""Hyperparameters that are always set, even without a ramp. The networks hold the bounds of standard deviations, so
a checkpoint of another run may bring other bounds, which this run's must replace."""


def owner_of(name: str, owners: Mapping[str, Any]) -> Any:
    """Return the configuration that has a field of this name."""
    return next(owner for owner in owners.values() if hasattr(owner, name))


class Schedule:
    """Computes the scheduled values of hyperparameters over a run, by its length or by the gate pass rate.

    Args:
        config: Ramps.
        owners: As for `ScheduleConfig.check`.
        total_env_steps: Length of the run.
        num_gates: Number of gates of the track; 0 without a race.

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
                own = 1.0 if name in RATE_FACTORS else getattr(owner_of(name, owners), name)
                if own is not None:
                    self.ramps["rates" if name == "learning_rates" else name] = (own, ramp)
        self.total_env_steps = total_env_steps
        self.pass_rate = GatePassRate(num_gates)

    def observe(self, episodes: TensorDictBase, env_steps: int) -> dict[str, float]:
        """Update the gate pass rate by finished episodes, batch ``[E]`` of `EpisodeTracker.update`; return metrics."""
        if not len(episodes) or "gates_passed" not in episodes:
            return {}
        return {"episode/pass_share": self.pass_rate.update(episodes, env_steps)}

    def hardest_gate(self) -> dict[str, float]:
        """Return the number of the gate with the lowest pass rate, as a metric; nothing without a race."""
        passes = self.pass_rate
        return {"episode/hardest_gate": float(passes.lowest_rate_gate)} if len(passes.shares) else {}

    def at(self, env_steps: int) -> dict[str, float]:
        """Return all scheduled hyperparameters at ``env_steps``, by their names in a learner's ``adjust``."""
        times = {
            RampClock.run: env_steps / self.total_env_steps,
            RampClock.passes: self.pass_rate.best,
            RampClock.known: self.pass_rate.progress(env_steps, self.total_env_steps),
        }
        return {name: ramp.at(value, times) for name, (value, ramp) in self.ramps.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return self.pass_rate.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.pass_rate.load_state_dict(state_dict)


class ReplayRatio:
    """Computes the number of updates due from the replay ratio, the records trained on per environment step.

    If a run is resumed with another ratio, the updates due before that point still follow the old one. An update
    trains on ``records``; the first follows ``prefill`` env_steps.

    Example:
        >>> ratio = ReplayRatio(ratio=4.0, records=64, prefill=100)
        >>> ratio.updates_due(env_steps=180), ratio.updates_due(env_steps=180, made=2)
        (5, 3)
    """

    def __init__(self, ratio: float, records: int, prefill: int = 0) -> None:
        self.ratio, self.records, self.prefill = ratio, records, prefill
        self._env_steps = 0  # at the latest call of `updates_due`
        self._since, self._before = 0, 0  # env_steps from which this ratio applies, and updates due before them

    def updates(self, env_steps: int) -> int:
        """Return the number of updates due from the start of the run until ``env_steps``."""
        steps = env_steps - max(self.prefill, self._since)
        return self._before + max(0, int(steps * self.ratio / self.records))

    def updates_due(self, env_steps: int, made: int = 0) -> int:
        """Return the number of updates to make now, at ``env_steps``, after ``made`` updates."""
        self._env_steps = env_steps
        return max(0, self.updates(env_steps) - made)

    def state_dict(self) -> dict[str, Any]:
        """Return the ratio, since when it applies, and the latest env_steps."""
        numbers = {"ratio": self.ratio, "records": self.records, "prefill": self.prefill}
        return {**numbers, "since": self._since, "before": self._before, "env_steps": self._env_steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned; if the ratio has changed, log it, and apply the new one from here on."""
        saved = ReplayRatio(state["ratio"], state["records"], state["prefill"])
        saved._since, saved._before = state["since"], state["before"]
        self._env_steps = state["env_steps"]
        if (saved.ratio, saved.records, saved.prefill) == (self.ratio, self.records, self.prefill):
            self._since, self._before = saved._since, saved._before
            return
        self._since, self._before = self._env_steps, saved.updates(self._env_steps)
        logger.info("updates: from now on with a replay ratio of %g and %d records each", self.ratio, self.records)


class ModelLag:
    """Compares a world model's error on the newest records with its error in training.

    A policy that improves faster than its model reaches states where the model is wrong, and exploits the errors that
    promise the most reward. Then the error on the newest records exceeds that in training, and the policy should wait.
    The newest records are those of all environments: those of a single one vary too much from flight to flight.
    While flights get faster, new records are harder than old ones, so a ratio slightly above 1 is no lag.

    Args:
        limit: Ratio of these errors above which the policy waits; None turns the measurement off.
        every: env_steps between two measurements.

    Example:
        >>> import torch
        >>> lag = ModelLag(limit=1.2)
        >>> lag.add_training_error({"reward_error": torch.tensor(0.01)})
        >>> lag.add_fresh_error({"reward_error": torch.tensor(0.02)})["lag/ratio"]
        2.0
        >>> lag.waits
        True
    """

    def __init__(self, limit: float | None, every: int = 1) -> None:
        self.limit = limit
        self._every = every
        self._periods = 0  # number of the latest period
        self._sum: Tensor | float = 0.0  # sum of training errors since the last measurement
        self._count = 0
        self._ratios = deque[float](maxlen=MEDIAN_WINDOW)
        self._above = 0  # consecutive measurements with a median above the limit

    @property
    def waits(self) -> bool:
        """Whether the policy should wait."""
        return self.limit is not None and 0 < self._above <= PATIENCE

    def due(self, env_steps: int) -> bool:
        """Return whether a new period has begun, so that a measurement is due."""
        periods = env_steps // self._every
        passed, self._periods = self.limit is not None and periods != self._periods, periods
        return passed

    def add_training_error(self, metrics: Mapping[str, Tensor]) -> None:
        """Add the error in an update's metrics, without waiting for the device."""
        if self.limit is not None and (error := error_of(metrics)) is not None:
            self._sum = self._sum + error.detach()
            self._count += 1

    def add_fresh_error(self, metrics: Mapping[str, Tensor]) -> dict[str, Tensor | float]:
        """Add the error on the newest records, decide whether the policy waits, and log changes of the decision.

        Returns:
            Metrics, of which the ratio is the median of the latest ones; empty if none of `ERRORS` is among the given.
        """
        if (fresh := error_of(metrics)) is None:
            return {}
        trained = float(self._sum) / self._count if self._count else 0.0
        self._sum, self._count = 0.0, 0
        if trained:
            self._ratios.append(float(fresh) / trained)
        ratio = statistics.median(self._ratios) if self._ratios else math.nan
        waited = self.waits
        self._above = self._above + 1 if self.limit is not None and ratio > self.limit else 0
        if self.waits is not waited:
            reason = f"the model's error on the newest records is {ratio:.2f} times that in training"
            logger.info(
                "the actor %s: %s (wait_for_model=%g)", "waits" if self.waits else "continues", reason, self.limit
            )
        return {"lag/error": fresh, "lag/ratio": ratio, "lag/actor_waits": float(self.waits)}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        errors = {"sum": float(self._sum), "count": self._count, "ratios": list(self._ratios)}
        return {"periods": self._periods, **errors, "above": self._above}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self._periods = state_dict["periods"]
        self._sum, self._count = torch.tensor(state_dict["sum"]), state_dict["count"]
        self._ratios = deque(state_dict["ratios"], maxlen=MEDIAN_WINDOW)
        self._above = state_dict["above"]


def error_of(metrics: Mapping[str, Tensor]) -> Tensor | None:
    """Return the best error of `ERRORS` in a world model's metrics; None if there is none."""
    return next((metrics[name] for name in ERRORS if name in metrics), None)
