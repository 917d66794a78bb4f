"""The machine: its cores and memory, and its description beside measurements. Imports torch only where it is asked."""

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
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch

GB = 1e9

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def keep_freed_memory() -> bool:
    """Make this process keep freed memory instead of returning it to the kernel; return whether glibc accepted that.

    By default glibc returns blocks of many megabytes at once and requests them again at the next operation, and the
    kernel zeroes every page each time: a third of the time of a large model's update on a CPU
    (``benchmarks/learner.py --return-freed-memory`` measures it). With this setting the process never shrinks and may
    grow; `KeptMemory` limits that. Has no effect on an allocator that is preloaded in place of glibc's.
    """
    if sys.platform == "win32":
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, -1))


class KeptMemory:
    """Returns a process's freed memory to the kernel when the process has grown by more than ``growth``.

    Allocations of many sizes, above all aligned ones (before glibc 2.38), fragment a heap that is never returned, and
    it grows without bound: a training on the Control Suite held 19 GB after 8,600 updates, of which 1 GB was in use.
    Returning all of it takes a fraction of a second, and the next update allocates again what it uses.

    Args:
        growth: Bytes by which the process may grow before its freed memory is returned [choice].
    """

    def __init__(self, growth: int = 1 << 30) -> None:
        self._growth = growth
        self._usual: int | None = None  # size in bytes at the first call after memory was returned
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None

    def trim(self) -> bool:
        """Return freed memory if the process has grown too large; return whether it was done. Call it regularly."""
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
    """Return the resident memory of this process in bytes; None without /proc."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else None


def available_memory(device: torch.device | str) -> float:
    """Return the bytes that can still be allocated on a device; infinity if unknown (a CPU without /proc)."""
    kind = str(device).partition(":")[0]
    if kind == "cuda":
        import torch

        return float(torch.cuda.mem_get_info(device)[0])
    information = Path("/proc/meminfo")
    if kind != "cpu" or not information.exists():
        return math.inf
    lines = dict(line.split(":") for line in information.read_text().splitlines())
    return float(lines["MemAvailable"].split()[0]) * 1024


def check_fits(size: int, device: torch.device | str, setting: str) -> None:
    """Raise ``ValueError`` unless ``size`` bytes, which a setting asks for, fit in the free memory of a device."""
    available = available_memory(device)
    if size > available:
        raise ValueError(
            f"{setting} needs {size / GB:.1f} GB when full, and {device} has {available / GB:.1f} GB left: lower it to "
            f"{100 * available / size:.3g}% of that or less, or keep the records in files with replay.storage=memmap."
        )


def check_space(size: int, folder: Path, setting: str) -> None:
    """Raise ``ValueError`` unless files of ``size`` bytes fit on the disk of a folder, which need not exist yet.

    A memory map that runs out of disk space would kill the process.
    """
    place = next(above for above in (folder.absolute(), *folder.absolute().parents) if above.exists())
    free = shutil.disk_usage(place).free
    if size > free:
        raise ValueError(
            f"{setting} needs {size / GB:.1f} GB of files when full, and {place} has {free / GB:.1f} GB free: lower it "
            f"to {100 * free / size:.3g}% of that or less, or choose another run_dir=."
        )


def is_out_of_memory(error: RuntimeError) -> bool:
    """Return whether an error of torch means that a CUDA device or the CPU is out of memory."""
    import torch

    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def out_of_memory_advice(error: RuntimeError) -> str:
    """Return the first line of an out-of-memory error, and the settings that take memory, largest first."""
    first = str(error).splitlines()[0]
    return (
        f"{first} What takes memory: the batch (model.batch_size times model.batch_length), imagination, if any "
        "(model.imagination_starts; null takes every record of the batch), the network (model=size12m and smaller), "
        "the replay (replay.device=cpu). model.mixed_precision=true halves what the networks keep."
    )


PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp")


def provenance() -> dict[str, Any]:
    """Return machine, versions and commit as values that JSON can hold."""
    import torch

    return {
        "machine": f"{platform.system()} {platform.machine()}, {_cpu()}, {torch.get_num_threads()} torch threads",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": git_commit(Path(__file__).parent),
    }


def git_commit(folder: Path) -> str | None:
    """Return the commit of a folder, with ``-dirty`` if files have changed since; None if git does not track its files.

    An installed package may lie inside the repository of another project.
    """
    try:
        return _git(folder, "describe", "--always", "--dirty") if _git(folder, "ls-files", ".") else None
    except OSError:  # git is not installed
        return None


def _git(folder: Path, *arguments: str) -> str | None:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or None


def command_line() -> str:
    """Return the command that starts this process again from the same folder."""
    return shlex.join(["python", *sys.argv])


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line for line in lines if line.startswith("model name")]
    return f"{available_cpus()} x {names[0].partition(': ')[2]}" if names else f"{available_cpus()} cores"


def available_cpus() -> int:
    """Return the number of CPUs that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_threads() -> int:
    """Return the default number of threads for physics and rendering: one for each CPU, at most ``OMP_NUM_THREADS``.

    torch obeys that variable, too, so it divides a machine between two trainings.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # "4,2": 4 outer threads, 2 nested in each
    return min(available_cpus(), int(asked)) if asked.isdecimal() and int(asked) else available_cpus()
