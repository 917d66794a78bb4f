"""What changes while a run goes on: scheduled settings, how much it trains, and whether the policy waits for its model.

Settings change by the run's length or by how well the policy flies.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
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
"""Metrics of a world model by which a lag is told, best first."""
LOOKS = 5
"""Measurements of which the median counts, so that one of an odd flight does not [choice]."""
PATIENCE = 10
"""Measurements for which a policy waits at most; then the ratio has to fall below the limit first [choice]."""


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


class ReplayRatio:
    """So many records trained on per environment step made since the prefill.

    A run that goes on with another ratio makes the updates that the one before asked for until there, no more and no
    less.

    Args:
        ratio: records trained on per environment step.
        records: that an update trains on.
        prefill: env_steps collected before the first update.

    Example:
        >>> ratio = ReplayRatio(ratio=4.0, records=64, prefill=100)
        >>> ratio.updates_due(env_steps=180), ratio.updates_due(env_steps=180, made=2)
        (5, 3)
    """

    def __init__(self, ratio: float, records: int, prefill: int = 0) -> None:
        self.ratio, self.records, self.prefill = ratio, records, prefill
        self._env_steps = 0  # when it was last asked
        self._since, self._before = 0, 0  # env_steps from which it holds, and updates that were asked for until there

    def updates(self, env_steps: int) -> int:
        """Return the updates to make from the run's beginning until so many env_steps."""
        steps = env_steps - max(self.prefill, self._since)
        return self._before + max(0, int(steps * self.ratio / self.records))

    def updates_due(self, env_steps: int, made: int = 0) -> int:
        """Return the updates to make at so many env_steps, where some are made already."""
        self._env_steps = env_steps
        return max(0, self.updates(env_steps) - made)

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of the ratio, since when it holds, and how far the run is."""
        return {
            "ratio": self.ratio,
            "records": self.records,
            "prefill": self.prefill,
            "since": self._since,
            "before": self._before,
            "env_steps": self._env_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where a run was saved; another ratio than there holds from there on, which is logged."""
        saved = ReplayRatio(state["ratio"], state["records"], state["prefill"])
        saved._since, saved._before = state["since"], state["before"]
        self._env_steps = state["env_steps"]
        if (saved.ratio, saved.records, saved.prefill) == (self.ratio, self.records, self.prefill):
            self._since, self._before = saved._since, saved._before
            return
        self._since, self._before = self._env_steps, saved.updates(self._env_steps)
        logger.info("updates: from here on by a replay ratio of %g, %d records each", self.ratio, self.records)


class ModelLag:
    """Compares a world model's error on fresh records with that on those it is trained on.

    A policy that improves faster than its model flies where the model errs, and finds those of its errors that promise
    most. Then the fresh records' error stands above the other, and the policy should wait.

    Fresh are the newest records of all worlds: those of one that is held out follow single odd flights. They are harder
    than older ones where flights get faster, so a ratio somewhat above one is no lag yet.

    Args:
        limit: Ratio of the two above which the policy waits; None: it never does, and nothing is measured.
        every: env_steps between two measurements.

    Example:
        >>> import torch
        >>> lag = ModelLag(limit=1.2)
        >>> lag.trained({"reward_error": torch.tensor(0.01)})
        >>> lag.measured({"reward_error": torch.tensor(0.02)})["lag/ratio"]
        2.0
        >>> lag.waits
        True
    """

    def __init__(self, limit: float | None, every: int = 1) -> None:
        self.limit = limit
        self._every = every
        self._periods = 0  # of the run, that were looked at
        self._sum: Tensor | float = 0.0  # of the errors of updates since the last measurement
        self._count = 0
        self._ratios = deque[float](maxlen=LOOKS)
        self._above = 0  # measurements without a break at which the median was above the limit

    @property
    def waits(self) -> bool:
        """Whether the policy should wait."""
        return self.limit is not None and 0 < self._above <= PATIENCE

    def due(self, env_steps: int) -> bool:
        """Return whether another period has passed, in which the newest records are to be measured."""
        periods = env_steps // self._every
        passed, self._periods = self.limit is not None and periods != self._periods, periods
        return passed

    def trained(self, metrics: Mapping[str, Tensor]) -> None:
        """Take note of the error in an update's metrics, a scalar; nothing waits for its device."""
        if self.limit is not None and (error := error_of(metrics)) is not None:
            self._sum = self._sum + error.detach()
            self._count += 1

    def measured(self, metrics: Mapping[str, Tensor]) -> dict[str, Tensor | float]:
        """Take note of the error on fresh records, and decide whether the policy waits, which is logged.

        Args:
            metrics: of the world model on these records, of which one is in `ERRORS`.

        Returns:
            Metrics; the ratio is a median of the last ones. None where no error was measured.
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
                "the actor %s: %s (wait_for_model=%g)", "waits" if self.waits else "goes on", reason, self.limit
            )
        return {"lag/error": fresh, "lag/ratio": ratio, "lag/actor_waits": float(self.waits)}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "periods": self._periods,
            "sum": float(self._sum),
            "count": self._count,
            "ratios": list(self._ratios),
            "above": self._above,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self._periods = state_dict["periods"]
        self._sum, self._count = torch.tensor(state_dict["sum"]), state_dict["count"]
        self._ratios = deque(state_dict["ratios"], maxlen=LOOKS)
        self._above = state_dict["above"]


def error_of(metrics: Mapping[str, Tensor]) -> Tensor | None:
    """Return the error by which a lag is told, of a world model's metrics; None if none of them was measured."""
    return next((metrics[name] for name in ERRORS if name in metrics), None)
