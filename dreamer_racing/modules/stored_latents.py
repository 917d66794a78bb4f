"""Latents as a replay keeps them, so that a training window goes on from where acting was.

Shape legend: N any batch, D belief, L latents, K classes, S state = L·K.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

CONTEXT = "context"
"""Key of a record under which lie the latents *before* its observation: ``belief`` and ``state``, packed."""


def pack_latents(belief: Tensor, state: Tensor, latents: int) -> TensorDict:
    """Pack latents into 2·D + L bytes each.

    Args:
        belief: h, in [−1, 1], ``(*N, D)``.
        state: z as flattened one-hots, ``(*N, S)``.
        latents: L.

    Returns:
        ``belief`` float16 ``(*N, D)``, within 5e-4 of the original, and ``state`` uint8 ``(*N, L)``, the class of each
        latent; batch ``[*N]``.

    Example:
        >>> import torch
        >>> packed = pack_latents(torch.zeros(2, 3), torch.eye(4)[:2], latents=1)
        >>> packed["state"].tolist()
        [[0], [1]]
    """
    classes = state.unflatten(-1, (latents, -1)).argmax(-1).to(torch.uint8)
    return TensorDict({"belief": belief.half(), "state": classes}, belief.shape[:-1], device=belief.device)


def unpack_latents(packed: TensorDictBase, classes: int) -> tuple[Tensor, Tensor]:
    """Return belief float32 ``(*N, D)`` and state float32 ``(*N, S)`` of packed latents ``[*N]``.

    Args:
        packed: What ``pack_latents`` returned.
        classes: K.
    """
    one_hot = torch.nn.functional.one_hot(packed.get("state").long(), classes)
    return packed.get("belief").float(), one_hot.flatten(-2).float()
