"""What fits into memory, with the machine's numbers put in by hand."""

from __future__ import annotations

import math
import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dreamer_racing import machine
from dreamer_racing.machine import (
    KeptMemory,
    available_memory,
    check_fits,
    check_space,
    keep_freed_memory,
    out_of_memory_advice,
    usable_threads,
)


def test_available_memory_is_read_from_the_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    information = tmp_path / "meminfo"
    information.write_text("MemTotal:       8000000 kB\nMemFree:         100000 kB\nMemAvailable:    2000000 kB\n")
    monkeypatch.setattr(machine, "Path", lambda _: information)
    assert available_memory("cpu") == available_memory(torch.device("cpu")) == 2_000_000 * 1024
    information.unlink()
    assert available_memory("cpu") == math.inf


def test_nothing_is_known_of_other_devices() -> None:
    assert available_memory("meta") == math.inf
    check_fits(10**30, "meta", "replay.capacity=1")


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda device: 12e9)
    check_fits(12_000_000_000, "cpu", "replay.capacity=7")
    with pytest.raises(
        ValueError, match=r"^replay.capacity=7 needs 24.0 GB .* cpu has 12.0 GB left: .* 50% of"
    ) as error:
        check_fits(24_000_000_000, "cpu", "replay.capacity=7")
    assert "replay.storage=memmap" in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"lower it to 0\.001% of that"):
        check_fits(1_200_000_000_000_000, "cpu", "replay.capacity=7")


def test_files_that_the_disk_has_no_room_for_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda place: SimpleNamespace(free=3e9 * (place == tmp_path)))
    check_space(3_000_000_000, tmp_path / "not" / "there", "replay.capacity=7")
    with pytest.raises(ValueError, match=r"^replay.capacity=7 needs 6.0 GB .* has 3.0 GB free: .* 50% of .* run_dir="):
        check_space(6_000_000_000, tmp_path / "not" / "there", "replay.capacity=7")


def test_advice_keeps_the_first_line_of_the_error() -> None:
    advice = out_of_memory_advice(torch.OutOfMemoryError("Tried to allocate 2.00 GiB.\nSee documentation"))
    assert advice.startswith("Tried to allocate 2.00 GiB. ") and "\n" not in advice and "documentation" not in advice
    for setting in ("model.batch_size", "model.imagination_starts", "replay.device=cpu", "model.mixed_precision"):
        assert setting in advice


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to keep freed memory")
def test_freed_memory_is_kept() -> None:
    code = """
import resource, torch
from dreamer_racing.machine import keep_freed_memory
assert keep_freed_memory()
for _ in range(40):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(16_000_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 100, "16 million numbers are 15,625 pages, and the last ones need no new page"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to keep freed memory")
def test_what_is_kept_beyond_what_is_used_is_given_back() -> None:
    """Of 40 blocks of 4 MB each second one is freed: there is no end of the heap to give back."""
    code = """
import torch
from dreamer_racing.machine import KeptMemory, keep_freed_memory, resident_memory
assert keep_freed_memory()
kept = KeptMemory(growth=40_000_000)
print(kept.trim(), end=" ")
blocks = [torch.ones(1_000_000) for _ in range(40)]
largest = resident_memory()
del blocks[::2]
print(kept.trim(), largest - resident_memory() > 70_000_000, kept.trim(), torch.stack(blocks).sum().item())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "True", "False", "20000000.0"]


def test_a_c_library_that_cannot_keep_memory_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory() and not KeptMemory(growth=-1).trim()


@pytest.mark.parametrize(
    ("asked", "expected"), [(None, 4), ("", 4), ("1", 1), ("3,2", 3), ("16", 4), ("0", 4), ("-1", 4), ("many", 4)]
)
def test_threads_are_one_a_cpu_and_at_most_what_the_variable_says(
    asked: str | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "available_cpus", lambda: 4)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if asked is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
    assert usable_threads() == expected
