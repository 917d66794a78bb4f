"""PPO on imagined rollouts: an extension, not part of DreamerV3.

Shape legend: K updates, H horizon, N starts.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dreamer_racing.losses.clipped_actor import ClippedActorLoss, Minibatch


class PPOActorLoss(ClippedActorLoss):
    """Keep imagined rollouts, and improve the actor on them every few updates.

    ``forward`` imagines and judges as its siblings do, keeps the rollout, and writes a ``loss_actor`` of zero: nothing
    for the learner's optimiser. ``improve``, which the learner calls after each update, does nothing until K rollouts
    are there; then advantages are normalised over all of them. A step counts for the discounted probability of getting
    there.

    The rollouts are buffers of the module, so a checkpoint holds them and a CUDA graph can fill them. They take the
    number of starts from the first batch; with another number, or another K or H, they begin anew.

    Args:
        args, kwargs: Of ``ClippedActorLoss``.
    """

    features: Tensor
    action: Tensor
    old: Tensor
    advantage: Tensor
    weight: Tensor
    cursor: Tensor
    kept: Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for name in Minibatch._fields:
            self.register_buffer(name, torch.empty(0))
        self.register_buffer("cursor", torch.zeros(1, dtype=torch.int64))  # the place that is written next
        self.register_buffer("kept", torch.zeros(1, dtype=torch.int64))  # places written so far, at most K
        self._full = False  # whether those are known to be K, so that the device need not be asked

    def prepare(self, starts: int) -> None:
        """Make room for K rollouts from so many starts each; what was kept of another shape is forgotten.

        The learner calls this before an update, so that nothing is allocated inside a captured or compiled step.
        """
        shape = (self.ppo.updates, self.horizon, starts)
        if self.weight.shape[:-1] == shape:
            return
        features, actions = self.world_model.size.features, self.world_model.interface.action_dim
        for name, width in zip(Minibatch._fields, (features, actions, 2 * actions, 1, 1), strict=True):
            self.register_buffer(name, torch.zeros(*shape, width, device=self.cursor.device))
        self.cursor.zero_()
        self.kept.zero_()
        self._full = False

    def _objective(self, belief: Tensor, state: Tensor, terminated: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        self.prepare(len(belief))
        return super()._objective(belief, state, terminated)

    def _keep(self, **rollout: Tensor) -> None:
        """Write a rollout of ``(H, N, ...)`` into the next of the K places."""
        for name, value in rollout.items():
            self.get_buffer(name).index_copy_(0, self.cursor, value.unsqueeze(0).float())
        self.cursor.add_(1).remainder_(self.ppo.updates)
        self.kept.add_(1).clamp_(max=self.ppo.updates)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Take the number of starts from what is loaded; rollouts of another number or horizon are left out."""
        saved = state_dict.get(f"{prefix}weight")
        if saved is not None and saved.shape[:2] == (self.ppo.updates, self.horizon):
            self.prepare(saved.shape[2])
        else:
            for name in (*Minibatch._fields, "cursor", "kept"):
                state_dict.pop(prefix + name, None)
        self._full = False
        super()._load_from_state_dict(state_dict, prefix, *args)

    def improve(self, updates: int) -> dict[str, Tensor]:
        """Train the actor if the rollouts of K updates are there.

        Args:
            updates: Updates of the learner so far.

        Returns:
            Nothing, or what ``_improve_on`` does.
        """
        if updates % self.ppo.updates:
            return {}
        self._full = self._full or int(self.kept) >= self.ppo.updates  # waits for the device in the first round alone
        if not self._full:
            return {}
        return self._improve_on(Minibatch(*(self.get_buffer(name).flatten(0, 2) for name in Minibatch._fields)))
