"""Several processes that train one agent: each has a share of worlds, replay and batch, and all have the same networks.

This module alone knows that there are several; ``torchrun`` starts them, and ``join`` finds them. Until then, and where
there is a single one, every function returns what it was given, and nothing of ``torch.distributed`` runs. What is
reduced over the processes and what is not: docs/scaling.md.

All processes must come to the same calls in the same order. So whatever decides how a run goes on (a divergence that
ends epochs, a signal, a minute that has passed) has to be agreed on first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

T = TypeVar("T")
PATIENCE = timedelta(days=1)
"""For the others, while one evaluates or saves; ``torchrun`` ends whoever waits for one that is gone."""


class _Place:
    """Which process this is, of how many."""

    rank = 0
    processes = 1


_here = _Place()


def asked_for() -> int:
    """How many processes were started, whether they have met or not."""
    return int(os.environ.get("WORLD_SIZE") or 1)


def join() -> None:
    """Meet the other processes, if there are any: on CUDA devices by NCCL, on the CPU by Gloo.

    Raises:
        ValueError: ``WORLD_SIZE`` says that there are, but not where they meet.
    """
    if asked_for() == 1 or _here.processes > 1:
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    try:
        dist.init_process_group(backend, timeout=PATIENCE)
    except ValueError as error:
        raise ValueError(
            f"WORLD_SIZE={asked_for()} says that this is one of several processes, and they cannot meet ({error}): "
            "start them by torchrun --nproc-per-node=N, or unset WORLD_SIZE."
        ) from error
    _here.rank, _here.processes = dist.get_rank(), dist.get_world_size()
    if (device := int(os.environ.get("LOCAL_RANK") or 0)) < torch.cuda.device_count():
        torch.cuda.set_device(device)


def leave() -> None:
    """Part from the others."""
    if _here.processes > 1:
        _here.rank, _here.processes = 0, 1
        dist.destroy_process_group()


def count() -> int:
    """How many processes train together; 1: this one alone."""
    return _here.processes


def count_here() -> int:
    """How many of them are on this machine."""
    return min(count(), int(os.environ.get("LOCAL_WORLD_SIZE", count())))


def rank() -> int:
    """Which of them this is, from 0."""
    return _here.rank


def is_first() -> bool:
    """Whether this is the one that logs, evaluates and saves."""
    return _here.rank == 0


def average_(values: Iterable[Tensor]) -> None:
    """Replace tensors of one device by their mean over the processes, in a single exchange."""
    tensors = list(values)
    if _here.processes == 1 or not tensors:
        return
    flat = torch.cat([tensor.detach().flatten().float() for tensor in tensors])
    dist.all_reduce(flat)
    flat /= _here.processes
    parts = flat.split([tensor.numel() for tensor in tensors])
    torch._foreach_copy_(tensors, [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)])


def average_gradients(parameters: Iterable[Tensor], metrics: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Make gradients the means over the processes, in place: those of the joint batch.

    That is exact where a loss is a mean over records and the processes' shares of the batch are equal.

    Args:
        parameters: whose gradients; those that have none are left out, the same ones in all processes.
        metrics: tensors on the same device that go along in the exchange.

    Returns:
        The metrics' means.
    """
    own = {name: value.clone() for name, value in (metrics or {}).items()}
    average_([*(parameter.grad for parameter in parameters if parameter.grad is not None), *own.values()])
    return own


def averaged(metrics: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the metrics' means over the processes."""
    return metrics if _here.processes == 1 else average_gradients((), metrics)


@torch.no_grad()
def total(values: Tensor) -> Tensor:
    """Return the sum over the processes, without gradient."""
    if _here.processes == 1:
        return values
    values = values.clone()
    dist.all_reduce(values)
    return values


@torch.no_grad()
def gathered(values: Tensor, dim: int) -> Tensor:
    """Return tensors of equal shape side by side, in the order of the processes, without gradient."""
    if _here.processes == 1:
        return values
    parts = [torch.empty_like(values, memory_format=torch.contiguous_format) for _ in range(_here.processes)]
    dist.all_gather(parts, values.contiguous())
    return torch.cat(parts, dim)


def gathered_rows(rows: TensorDictBase) -> TensorDictBase:
    """Return rows ``[E]`` of all processes, however many each has, one process after the other; on the CPU."""
    if _here.processes == 1:
        return rows
    parts = [TensorDict(part, [length]) for length, part in _gathered_objects((len(rows), rows.to_dict()))]
    return torch.cat(parts)


def agreed(value: T) -> T:
    """Return what the first process gives, a plain value."""
    if _here.processes == 1:
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def largest(value: int) -> int:
    """Return the largest of the processes' numbers."""
    if _here.processes == 1:
        return value
    box = torch.tensor(value)
    dist.all_reduce(box, dist.ReduceOp.MAX)
    return int(box)


def together(action: Callable[[], object]) -> None:
    """Do something, and wait for the others to have done it.

    Raises:
        RuntimeError: It failed in another process; the message says why. Where it failed in this one, that is raised.
    """
    if _here.processes == 1:
        action()
        return
    failure = None
    try:
        action()
    except Exception as error:
        failure = error
    words = _gathered_objects("" if failure is None else f"process {_here.rank}: {failure}")
    if failure is not None:
        raise failure
    if any(words):
        raise RuntimeError("; ".join(filter(None, words)))


def check_same(values: Sequence[Tensor]) -> None:
    """Refuse to go on with networks that have drifted apart.

    Raises:
        RuntimeError: The tensors are not the same in all processes, bit for bit.
    """
    if _here.processes == 1:
        return
    with torch.no_grad():
        sums = torch.stack([value.double().sum() for value in values]).tolist()
    if any(other != sums for other in _gathered_objects(sums)):
        raise RuntimeError(
            "The networks of the processes are no longer the same, so their averaged gradients mean nothing: they must "
            "run on devices of one kind with the same versions. This should be reported as a defect if they do."
        )


def _gathered_objects(value: T) -> list[T]:
    """Return the plain values of all processes, in their order."""
    box: list[Any] = [None] * _here.processes
    dist.all_gather_object(box, value)
    return box
