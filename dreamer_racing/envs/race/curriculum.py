"""Curriculum of the body-rate penalty: the schedule of b₂, and relabelling of replayed rewards with the current b₂.

Reference: paper, Eq. 1 (b₁ = 1, b₂ → 0.01) and Section IV-A: b₂ starts at 0 and grows once the total reward exceeds
50. How fast it grows is this project's choice, see `BodyRateCurriculum`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform


@dataclass
class BodyRateSchedule:
    """Schedule of b₂, the weight of the body-rate penalty in paper Eq. 1, see `BodyRateCurriculum`."""

    threshold: float = 50.0  # mean return above which b₂ grows.
    increment: float = 0.001  # step by which b₂ grows, 1/(rad/s).
    maximum: float = 0.01  # upper limit of b₂, 1/(rad/s).
    window: int = 100  # number of episodes in the mean; b₂ does not grow before there are as many.
    cooldown: int = 100  # minimum number of episodes between two increments.
    relabel: bool = True  # whether rewards of replayed steps are recomputed with the current b₂.


class BodyRateCurriculum:
    """Raises b₂, the weight of the body-rate penalty, once the policy races well.

    b₂ starts at 0. Whenever the mean return of the last ``window`` training episodes exceeds ``threshold``, it grows by
    ``increment``, but at most once in ``cooldown`` episodes and never beyond ``maximum``. It never decreases.

    Args:
        schedule: the schedule of b₂.
        env: the environment whose `body_rate_weight` is set; None if there is no race: `adapt` then does nothing.

    Raises:
        ValueError: a number is out of its range.

    Example:
        >>> curriculum = BodyRateCurriculum(BodyRateSchedule(window=2, cooldown=2))
        >>> curriculum.update([60.0, 60.0, 60.0, 60.0])
        0.002
    """

    def __init__(self, schedule: BodyRateSchedule | None = None, env: Any = None) -> None:
        self.schedule = schedule = schedule or BodyRateSchedule()
        self.env = env
        if schedule.window < 1 or schedule.cooldown < 1 or schedule.increment < 0 or schedule.maximum < 0:
            raise ValueError(
                "The body-rate curriculum needs window >= 1, cooldown >= 1, increment >= 0 and maximum >= 0, got "
                f"window={schedule.window}, cooldown={schedule.cooldown}, increment={schedule.increment}, "
                f"maximum={schedule.maximum}."
            )
        self._returns: deque[float] = deque(maxlen=schedule.window)
        self._growths = 0
        self._since_growth = schedule.cooldown

    @property
    def body_rate_weight(self) -> float:
        """Current b₂, 1/(rad/s)."""
        # a product, not a sum of increments, so that ten times 0.001 is exactly 0.01
        return min(self._growths * self.schedule.increment, self.schedule.maximum)

    def adapt(self, episodes: TensorDictBase) -> dict[str, float]:
        """Update the environment's b₂ from the ``return`` of finished episodes ``[E]``; return metrics."""
        if self.env is None:
            return {}
        self.env.body_rate_weight = self.update(episodes["return"])
        return {"curriculum/body_rate_weight": self.body_rate_weight}

    def update(self, episode_returns: Tensor | Sequence[float]) -> float:
        """Update b₂ with the undiscounted returns ``(E,)`` of finished training episodes, in order; return b₂."""
        schedule = self.schedule
        values = episode_returns.flatten().tolist() if isinstance(episode_returns, Tensor) else episode_returns
        for value in values:
            self._returns.append(float(value))
            self._since_growth += 1
            may_grow = len(self._returns) == schedule.window and self._since_growth >= schedule.cooldown
            races_well = sum(self._returns) > schedule.threshold * len(self._returns)
            if may_grow and races_well and self.body_rate_weight < schedule.maximum:
                self._growths += 1
                self._since_growth = 0
        return self.body_rate_weight

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"returns": list(self._returns), "growths": self._growths, "since_growth": self._since_growth}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, and set the environment's b₂."""
        self._returns.clear()
        self._returns.extend(state_dict["returns"])
        self._growths = state_dict["growths"]
        self._since_growth = state_dict["since_growth"]
        if self.env is not None:
            self.env.body_rate_weight = self.body_rate_weight


class RelabelReward(Transform):
    """Replay transform that recomputes rewards with the current b₂: ``reward_base − b₂ · body_rate_norm``.

    Without it, sampled rewards have the b₂ at the time of their collection.
    """

    def __init__(self, curriculum: BodyRateCurriculum) -> None:
        super().__init__()
        self.curriculum = curriculum

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Recompute the rewards of a sample, in place."""
        penalty = self.curriculum.body_rate_weight * tensordict["body_rate_norm"]
        return tensordict.set("reward", tensordict["reward_base"] - penalty)
