"""Data-parallel training: each process has a share of the environments, the replay and the batch, and equal networks.

``torchrun`` starts the processes, and ``init`` connects them; no other module uses ``torch.distributed``. Before
``init``, and with a single process, every function returns its argument. docs/scaling.md lists what is reduced over
the processes and what is not.

All processes must make the same calls in the same order. So every decision about how a run continues (a KL divergence
that ends the epochs, a signal, a timer) must first be made equal in all processes, by ``broadcast`` or a reduction.
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
"""Timeout of a wait, long enough for one process to evaluate or save; ``torchrun`` ends all if one dies."""


class _Place:
    """Rank of this process, and the number of processes."""

    rank = 0
    processes = 1


_here = _Place()


def asked_for() -> int:
    """Return how many processes ``torchrun`` started, whether they are connected or not."""
    return int(os.environ.get("WORLD_SIZE") or 1)


def init() -> None:
    """Initialise the process group, if there are several processes: NCCL for CUDA devices, Gloo for the CPU.

    Raises:
        ValueError: ``WORLD_SIZE`` is set, but not the address of the process group.
    """
    if asked_for() == 1 or _here.processes > 1:
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    try:
        dist.init_process_group(backend, timeout=PATIENCE)
    except ValueError as error:
        raise ValueError(
            f"WORLD_SIZE={asked_for()} says that this is one of several processes, and they cannot connect ({error}): "
            "start them with torchrun --nproc-per-node=N, or unset WORLD_SIZE."
        ) from error
    _here.rank, _here.processes = dist.get_rank(), dist.get_world_size()
    if (device := int(os.environ.get("LOCAL_RANK") or 0)) < torch.cuda.device_count():
        torch.cuda.set_device(device)


def destroy() -> None:
    """Destroy the process group."""
    if _here.processes > 1:
        _here.rank, _here.processes = 0, 1
        dist.destroy_process_group()


def num_processes() -> int:
    """Return the number of processes that train together; 1 for this one alone."""
    return _here.processes


def num_local_processes() -> int:
    """Return the number of processes on this machine."""
    return min(num_processes(), int(os.environ.get("LOCAL_WORLD_SIZE", num_processes())))


def rank() -> int:
    """Return the rank of this process, from 0."""
    return _here.rank


def is_first() -> bool:
    """Return whether this is the process that logs, evaluates and saves (rank 0)."""
    return _here.rank == 0


def check_devices(devices: Mapping[str, str]) -> None:
    """Refuse more processes than this machine has CUDA devices, and the same device, given by its setting, for all."""
    here, there = num_local_processes(), torch.cuda.device_count()
    for name, device in devices.items():
        if not device.startswith("cuda"):
            continue
        if ":" in device:
            raise ValueError(
                f"{name}={device} would put all {num_processes()} processes on one device: with {name}=cuda each gets "
                "its own; CUDA_VISIBLE_DEVICES selects them."
            )
        if here > there:
            raise ValueError(
                f"{name}={device} needs a CUDA device for each of the {here} processes on this machine, which has "
                f"{there}: start torchrun with --nproc-per-node={max(there, 1)}, or set {name}=cpu."
            )


def own_device(device: str) -> str:
    """Return this process's own device of the given type."""
    return f"cuda:{os.environ['LOCAL_RANK']}" if device.startswith("cuda") else device


def average_gradients(parameters: Iterable[Tensor], metrics: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Average gradients over the processes, in place, to those of the joint batch; return the means of metrics.

    This is exact if the loss is a mean over records and the processes have equal shares of the batch.

    Args:
        parameters: Parameters with the gradients; those without one are skipped, and must be the same in all processes.
        metrics: Tensors on the same device to average in the same all-reduce.
    """
    means = {name: value.clone() for name, value in (metrics or {}).items()}
    if _here.processes > 1:
        tensors = [*(parameter.grad for parameter in parameters if parameter.grad is not None), *means.values()]
        if not tensors:
            return means
        flat = torch.cat([tensor.detach().flatten().float() for tensor in tensors])
        dist.all_reduce(flat)
        flat /= _here.processes
        parts = flat.split([tensor.numel() for tensor in tensors])
        torch._foreach_copy_(tensors, [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)])
    return means


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
def all_gather(values: Tensor, dim: int) -> Tensor:
    """All-gather tensors of equal shape and concatenate them along ``dim`` in the order of ranks, without gradient."""
    if _here.processes == 1:
        return values
    parts = [torch.empty_like(values, memory_format=torch.contiguous_format) for _ in range(_here.processes)]
    dist.all_gather(parts, values.contiguous())
    return torch.cat(parts, dim)


def all_gather_rows(rows: TensorDictBase) -> TensorDictBase:
    """Concatenate the rows ``[E]`` of all processes in the order of ranks, on the CPU; E may differ among them."""
    if _here.processes == 1:
        return rows
    parts = [TensorDict(part, [length]) for length, part in _all_gather_objects((len(rows), rows.to_dict()))]
    return torch.cat(parts)


def broadcast(value: T) -> T:
    """Broadcast a picklable value of rank 0 to all processes."""
    if _here.processes == 1:
        return value
    box = [value]
    dist.broadcast_object_list(box, src=0)
    return box[0]


def all_reduce_max(value: int) -> int:
    """Return the maximum of a number over the processes."""
    if _here.processes == 1:
        return value
    box = torch.tensor(value)
    dist.all_reduce(box, dist.ReduceOp.MAX)
    return int(box)


def run_in_all(action: Callable[[], object]) -> None:
    """Run an action in every process, and wait until all have finished it.

    Raises:
        RuntimeError: It failed in another process; the message says why. A failure in this one is raised as it is.
    """
    if _here.processes == 1:
        action()
        return
    failure = None
    try:
        action()
    except Exception as error:
        failure = error
    words = _all_gather_objects("" if failure is None else f"process {_here.rank}: {failure}")
    if failure is not None:
        raise failure
    if any(words):
        raise RuntimeError("; ".join(filter(None, words)))


def check_same(values: Sequence[Tensor]) -> None:
    """Raise ``RuntimeError`` unless the networks are still equal in all processes, by the sums of their tensors."""
    if _here.processes == 1:
        return
    with torch.no_grad():
        sums = torch.stack([value.double().sum() for value in values]).tolist()
    if any(other != sums for other in _all_gather_objects(sums)):
        raise RuntimeError(
            "The networks differ between the processes, so averaged gradients are meaningless. All processes must have "
            "the same kind of device and the same versions. If they do, please report this as a bug."
        )


def _all_gather_objects(value: T) -> list[T]:
    """Return the values of all processes, in the order of ranks."""
    box: list[Any] = [None] * _here.processes
    dist.all_gather_object(box, value)
    return box
