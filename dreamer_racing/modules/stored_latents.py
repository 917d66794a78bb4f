"""Latents as a replay keeps them, so that a training window goes on from where acting was.

Shape legend: N any batch, D belief, L latents, K classes, S state = L·K.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

CONTEXT = "context"
"""Key of a record under which lie the latents *before* its observation: ``belief`` and ``state``, packed."""


class LatentFormat(NamedTuple):
    """How latents are packed: the belief as float16, the state as the class of each latent, or its probabilities.

    Attributes:
        belief: D.
        latents: L.
        classes: K.
        sampled: Whether states are one-hots, of which the class is kept (uint8), or probabilities (float16).

    Example:
        >>> import torch
        >>> keep = LatentFormat(belief=3, latents=1, classes=4)
        >>> packed = keep.pack(torch.zeros(2, 3), torch.eye(4)[:2])
        >>> packed["state"].tolist()
        [[0], [1]]
    """

    belief: int
    latents: int
    classes: int
    sampled: bool = True

    @property
    def bytes(self) -> int:
        """What the latents of one record take."""
        return 2 * self.belief + self.latents * (1 if self.sampled else 2 * self.classes)

    def pack(self, belief: Tensor, state: Tensor) -> TensorDict:
        """Pack belief ``(*N, D)``, in [−1, 1], and state ``(*N, S)``; batch ``[*N]``. Floats are within 5e-4 after."""
        if self.sampled:
            state = state.unflatten(-1, (self.latents, self.classes)).argmax(-1).to(torch.uint8)
        else:
            state = state.half()
        return TensorDict({"belief": belief.half(), "state": state}, belief.shape[:-1], device=belief.device)

    def unpack(self, packed: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return belief ``(*N, D)`` and state ``(*N, S)``, float32, of packed latents ``[*N]``."""
        belief, state = packed.get("belief").float(), packed.get("state")
        if self.sampled:
            # Not one_hot, which looks at the classes first.
            state = (state.unsqueeze(-1) == torch.arange(self.classes, device=state.device)).flatten(-2)
        return belief, state.float()
