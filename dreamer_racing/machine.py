"""The machine: its cores and memory, and what it says about itself beside numbers that were measured on it."""

from __future__ import annotations

import ctypes
import importlib.metadata
import math
import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

GB = 1e9

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def keep_freed_memory() -> bool:
    """Let this process keep what it frees instead of returning it to the kernel.

    glibc gives blocks of many megabytes back at once and asks for them anew at the next operation, and the kernel
    fills every page with zeros each time: a third of the update of a large model on a CPU
    (``benchmarks/learner.py --return-freed-memory`` shows it). The process stays as large as it once was, or
    grows on: `KeptMemory` is for that. An allocator preloaded in place of glibc's does as it likes.

    Returns:
        Whether the C library took the setting; only glibc does.
    """
    if sys.platform == "win32":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, -1))


class KeptMemory:
    """Gives back what a process keeps of its freed memory, when that has grown beyond what it uses again and again.

    Blocks of many sizes that come and go, aligned ones above all (before glibc 2.38), leave gaps in a heap that is
    never given back, and it grows without end: a training of the Control Suite was at 19 GB after 8,600 updates, of
    which one was in use. Giving back all of it takes a fraction of a second, and what is used comes back with the next
    update.

    Args:
        growth: bytes by which the process may grow before it does [choice].
    """

    def __init__(self, growth: int = 1 << 30) -> None:
        self._growth = growth
        self._usual: int | None = None  # bytes, once what was given back and is used has come back
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None

    def trim(self) -> bool:
        """Look at how large the process is, now and then; return whether memory was given back."""
        size = resident_memory()
        if self._trim is None or size is None:
            return False
        if self._usual is None:
            self._usual = size
        if size <= self._usual + self._growth:
            return False
        self._trim(0)
        self._usual = None
        return True


def resident_memory() -> int | None:
    """Return the bytes of memory that this process has; None where nothing tells (no /proc)."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else None


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


def check_space(size: int, folder: Path, setting: str) -> None:
    """Refuse files that are larger than what is free on the disk: writing them by a memory map would end the process.

    Args:
        size: bytes, of all of them when full.
        folder: where; it need not be there yet.
        setting: what asks for them, as the user wrote it.

    Raises:
        ValueError: the message gives both numbers and what to change.
    """
    place = next(above for above in (folder.absolute(), *folder.absolute().parents) if above.exists())
    free = shutil.disk_usage(place).free
    if size > free:
        raise ValueError(
            f"{setting} needs {size / GB:.1f} GB of files when full, and {place} has {free / GB:.1f} GB free: lower it "
            f"to {100 * free / size:.3g}% of that or less, or choose another run_dir=."
        )


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch failed for want of memory, of a CUDA device or of the CPU."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def out_of_memory_advice(error: RuntimeError) -> str:
    """Return the first line of the error, and which settings take memory, largest first."""
    first = str(error).splitlines()[0]
    return (
        f"{first} What takes memory: the batch (model.batch_size times model.batch_length), imagination, if any "
        "(model.imagination_starts; null takes every record of the batch), the network (model=size12m and smaller), "
        "the replay (replay.device=cpu). model.mixed_precision=true halves what the networks keep."
    )


PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp")


def provenance() -> dict[str, Any]:
    """Return machine, versions and commit, as JSON knows them."""
    return {
        "machine": f"{platform.system()} {platform.machine()}, {_cpu()}, {torch.get_num_threads()} torch threads",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": git_commit(Path(__file__).parent),
    }


def git_commit(folder: Path) -> str | None:
    """Name the commit that a folder is at, ``-dirty`` if files have changed since; None if no repository has its files.

    An installed package may well lie below a repository, of somebody else's work.
    """
    try:
        return _git(folder, "describe", "--always", "--dirty") if _git(folder, "ls-files", ".") else None
    except OSError:  # no git here
        return None


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or None


def command_line() -> str:
    """Return the command that started this process, to be run again in the same folder."""
    return shlex.join(["python", *sys.argv])


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line for line in lines if line.startswith("model name")]
    return f"{available_cpus()} x {names[0].partition(': ')[2]}" if names else f"{available_cpus()} cores"


def available_cpus() -> int:
    """CPUs this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_threads() -> int:
    """Threads of physics and rendering where nobody says how many: one for each CPU, at most ``OMP_NUM_THREADS``.

    By that variable, which torch obeys, too, two trainings share a machine.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # "4,2": 4 outside, 2 within each
    return min(available_cpus(), int(asked)) if asked.isdecimal() and int(asked) else available_cpus()
