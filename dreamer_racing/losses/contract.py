"""What a loss asks of its input, and what of it may change while it is used."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn


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


def set_number(losses: Collection[nn.Module], name: str, value: float, captured: bool = False) -> None:
    """Set a number of all losses that have it, from their next use on: a scalar in place, a plain number or None anew.

    Args:
        losses: Of a learner.
        name: Of the number.
        value: What it is from now on.
        captured: Whether a CUDA graph replays the losses, which knows a plain number as it was.

    Raises:
        ValueError: If none has a number of that name, or one that a graph would not read anew.
    """
    numbers = (Tensor, float, int, type(None))
    if not (having := [loss for loss in losses if isinstance(getattr(loss, name, ""), numbers)]):
        kinds = ", ".join(type(loss).__name__ for loss in losses)
        raise ValueError(f"adjust({name}=...): none of {kinds} has a number of that name that could move.")
    for loss in having:
        if isinstance(present := getattr(loss, name), Tensor):
            present.fill_(value)
        elif captured:
            raise ValueError(
                f"adjust({name}=...): {type(loss).__name__} has it as a plain number, which a captured CUDA graph does "
                f"not read again: make it self.{name} = scheduled(...), or set cuda_graph=False."
            )
        else:
            setattr(loss, name, value)
