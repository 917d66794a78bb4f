"""What a loss asks of its input, and what of it may change while it is used."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import nn


def require_keys(loss: object, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> None:
    """Refuse an input that lacks something.

    Args:
        loss: Who asks, for the message.
        tensordict: The input.
        keys: What it must have.

    Raises:
        KeyError: If a key is missing; the message names it, the loss, and what there is.
    """
    missing = [key for key in keys if tensordict.get(key, None) is None]
    if missing:
        found = sorted(map(str, tensordict.keys()))
        raise KeyError(f"{type(loss).__name__} needs {missing}, which the batch lacks. It has: {', '.join(found)}.")


def scheduled(value: float) -> nn.Buffer:
    """Return a number that may change between updates, as a scalar that a captured CUDA graph reads anew each time."""
    return nn.Buffer(torch.tensor(float(value)), persistent=False)
