"""PPO on flown rollouts, with the world model's latents for observations: an extension, not part of DreamerV3.

What an actor learns in imagination is as good as the model is where the actor takes it: where it takes a near miss for
a pass, imagined returns rise and real ones do not (docs/experiments.md, entry 18). Here the actor learns from what the
collector brings, by rewards that were paid. The world model sees and remembers for it, and imagination teaches the
critic.

Shape legend: N environments, T steps of a rollout, S steps kept of each environment, F features, A action.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from dreamer_racing.losses.clipped_actor import ClippedActorLoss, Minibatch
from dreamer_racing.losses.contract import require_keys
from dreamer_racing.losses.imagination import lambda_return
from dreamer_racing.modules.actor import ActionDistribution
from dreamer_racing.modules.world_model import join_features


class FlownPPOActorLoss(ClippedActorLoss):
    """Keep what the collector's policy flew, and improve the actor once ``ppo.flown`` steps are there.

    ``watch`` keeps a rollout with the latents that the policy saw and the distribution that it drew from, so that the
    ratio is right however old they are. Advantages are λ-returns of the rewards paid, less the critic's value, along
    all that is kept; the value of what comes after a step at which time ran out, or after the last one kept, is not
    known and taken to be that of the step; so it is where a rollout's worlds begin anew in the midst of an episode, as
    those of a lost worker do. ``forward`` imagines and judges, which teaches the critic.

    Actions are kept as they were flown, clipped to [−1, 1], and weighed by ``ActionDistribution.log_prob_clipped``.
    The steps are buffers of the module, so a checkpoint holds them. They begin anew with another number of
    environments, of steps, or of ``ppo.flown``; once they are full, the newest are kept until the next update.

    Args:
        args, kwargs: Of ``ClippedActorLoss``.
    """

    log_prob = staticmethod(ActionDistribution.log_prob_clipped)
    kept: ClassVar[tuple[str, ...]] = ("features", "action", "old", "reward", "done", "terminated")
    """What is kept of a step: latents, the clipped action, the policy that chose it, and what came of it."""
    features: Tensor
    action: Tensor
    old: Tensor
    reward: Tensor
    done: Tensor
    terminated: Tensor
    flown: Tensor

    watched_keys: ClassVar[tuple[NestedKey, ...]] = (
        "action", "loc", "scale", ("next", "belief"), ("next", "state"), ("next", "reward"), ("next", "done"),
        ("next", "terminated"),
    )  # fmt: skip
    """What ``watch`` reads of a rollout."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for name in self.kept:
            self.register_buffer(name, torch.empty(0))
        self.register_buffer("flown", torch.zeros(1, dtype=torch.int64))  # steps kept of each environment, to be saved
        self._flown = 0  # the same, to be read without waiting for the device

    @torch.no_grad()
    def watch(self, rollout: TensorDictBase) -> None:
        """Keep a rollout ``[N, T]``.

        Raises:
            KeyError: If it lacks one of ``watched_keys``, which ``DreamerPolicy`` and the environment write.
        """
        require_keys(self, rollout, self.watched_keys)
        steps = self._steps(rollout.select(*self.watched_keys).to(self.flown.device).transpose(0, 1))
        rollout_steps = len(steps["reward"])
        self._make_room(steps)
        first = self._flown
        if first == len(self.reward):  # full, and no update has come: the oldest rollout makes room
            first -= rollout_steps
            for name in self.kept:
                self.get_buffer(name)[:first] = self.get_buffer(name)[rollout_steps:].clone()
        if first and (begins := rollout.get("is_init", None)) is not None:
            self.done[first - 1] |= begins[:, 0].to(self.done.device)
        for name, value in steps.items():
            self.get_buffer(name)[first : first + len(value)] = value
        self._count(first + rollout_steps)

    def improve(self, updates: int) -> dict[str, Tensor]:
        """Train the actor if enough was flown.

        Args:
            updates: Updates of the learner so far; they do not matter.

        Returns:
            Nothing, or what ``_improve_on`` does.
        """
        if not self._flown or self._flown < len(self.reward):
            return {}
        self._count(0)
        # The policy flew in float32: at small deviations the rounding of bfloat16 would be a divergence of its own.
        with torch.autocast(self.reward.device.type, enabled=False):
            value = self._value()
            returns = self._return(value)
            advantage = returns - value
            steps = (self.features, self.action, self.old, advantage, torch.ones_like(advantage))
            learned = self._teach(returns, value)
            return learned | self._improve_on(Minibatch(*(part.flatten(0, 1) for part in steps)))

    def _steps(self, rollout: TensorDictBase) -> dict[str, Tensor]:
        """Return what is kept of the steps of a rollout ``[T, N]``, by the names of ``kept``."""
        after = rollout["next"]
        return {
            "features": join_features(after["belief"], after["state"]),
            "action": rollout["action"],
            "old": torch.cat((rollout["loc"], rollout["scale"]), -1),
            **{name: after[name] for name in ("reward", "done", "terminated")},
        }

    @torch.no_grad()
    def _value(self) -> Tensor:
        """Return what the critic makes of what was flown, ``(S, N, 1)``."""
        return self.critic.value(self.features)

    @torch.no_grad()
    def _return(self, value: Tensor) -> Tensor:
        """Return the λ-returns of what was flown, ``(S, N, 1)``."""
        following = torch.where(self.done, value, torch.cat((value[1:], value[-1:])))
        discount = self.discount * (~self.terminated).float()
        return lambda_return(self.reward, following, discount, self.lambda_ * (~self.done).float())

    def _teach(self, returns: Tensor, value: Tensor) -> dict[str, Tensor]:
        """Teach a critic of the loss's own what came of it: returns, and the values before, ``(S, N, 1)``.

        Returns:
            Metrics, scalars.
        """
        return {}

    def _make_room(self, steps: dict[str, Tensor]) -> None:
        """Make room for ``ppo.flown`` steps in whole rollouts like this; what was kept of other shapes is forgotten."""
        length, number = steps["reward"].shape[:2]
        room = length * math.ceil(self.ppo.flown / (length * number))
        if self.reward.shape[:2] == (room, number):
            if self._flown % length:  # rollouts of another length, which do not make whole ones of this
                self._count(0)
            return
        for name, value in steps.items():
            self.register_buffer(name, value.new_zeros(room, *value.shape[1:]))
        self._count(0)

    def _count(self, flown: int) -> None:
        """Take note of how many steps of each environment are kept."""
        self._flown = flown
        self.flown.fill_(flown)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Take the shape of what is loaded, unless it is of another kind of loss."""
        if all(prefix + name in state_dict for name in (*self.kept, "flown")):
            for name in self.kept:
                self.register_buffer(name, torch.empty_like(state_dict[prefix + name], device=self.flown.device))
        else:
            for name in (*self.kept, "flown"):  # a count without steps would be taken for a full memory
                state_dict.pop(prefix + name, None)
        super()._load_from_state_dict(state_dict, prefix, *args)
        self._flown = int(self.flown)
