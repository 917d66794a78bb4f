"""Memory: whether something fits, found out before it is allocated; and freed blocks kept for the next update."""

from __future__ import annotations

import ctypes
import math
import sys
from pathlib import Path

import torch

GB = 1e9

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def keep_freed_memory() -> bool:
    """Let this process keep what it frees instead of returning it to the kernel.

    glibc gives blocks of many megabytes back at once and asks for them anew at the next operation, and the kernel
    fills every page with zeros each time: a third of the update of a large model on a CPU
    (``benchmarks/learner.py --return-freed-memory`` shows it). The process stays as large as it once was, and cannot be
    told otherwise later. An allocator preloaded in place of glibc's does as it likes.

    Returns:
        Whether the C library took the setting; only glibc does.
    """
    if sys.platform == "win32":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, -1))


def available_memory(device: torch.device | str) -> float:
    """Return the bytes that can still be allocated on a device; infinity where nothing tells (a CPU without /proc)."""
    device = torch.device(device)
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    information = Path("/proc/meminfo")
    if device.type != "cpu" or not information.exists():
        return math.inf
    lines = dict(line.split(":") for line in information.read_text().splitlines())
    return float(lines["MemAvailable"].split()[0]) * 1024


def check_fits(size: int, device: torch.device | str, setting: str) -> None:
    """Refuse what is larger than the memory that is left.

    Args:
        size: bytes.
        device: where.
        setting: what asks for it, as the user wrote it.

    Raises:
        ValueError: the message gives both numbers and what to change.
    """
    available = available_memory(device)
    if size > available:
        raise ValueError(
            f"{setting} needs {size / GB:.1f} GB when full, and {device} has {available / GB:.1f} GB left: lower it to "
            f"{100 * available / size:.3g}% of that or less, or keep the records in files with replay.storage=memmap."
        )


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch failed for want of memory, of a CUDA device or of the CPU."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def out_of_memory_advice(error: RuntimeError) -> str:
    """Return the first line of the error, and which settings take memory, largest first."""
    first = str(error).splitlines()[0]
    return (
        f"{first} What takes memory: the batch (model.batch_size times model.batch_length), imagination "
        "(model.imagination_starts; null takes every record of the batch), the network (model=size12m and smaller), "
        "the replay (replay.device=cpu). model.mixed_precision=true halves what the networks keep."
    )
