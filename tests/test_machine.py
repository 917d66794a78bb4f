"""The machine: its devices, its terminal, its caches."""

from __future__ import annotations

import io
import math
import platform
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch

from dreamer_racing import caches, devices, doctor, machine, terminal
from dreamer_racing.machine import (
    KeptMemory,
    available_memory,
    check_fits,
    check_space,
    keep_freed_memory,
    out_of_memory_advice,
    usable_threads,
)
from tests.running_recipes import ROOT, python, recipe_module


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
    done = python("-c", code)
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
    done = python("-c", code)
    assert done.stdout.split() == ["False", "True", "True", "False", "20000000.0"], done.stderr


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


# In what a recipe computes: measured, since a list of instructions does not say how fast they are.


INSTRUCTIONS = {"avx512_bf16": True, "amx_bf16": False}


@pytest.mark.parametrize("slow", [torch.float32, torch.bfloat16])
def test_a_cpu_computes_in_bfloat16_where_that_is_faster(slow: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    def as_slow_as_said(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        time.sleep(0.001 if left.dtype == slow else 0.0)
        return left

    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: INSTRUCTIONS)
    monkeypatch.setattr(torch, "mm", as_slow_as_said)
    chosen, reason = devices.choose_mixed_precision(torch.device("cpu"))
    assert chosen == (slow is torch.float32)
    assert "times as fast in bfloat16" in reason


def test_a_cpu_without_instructions_for_bfloat16_does_not_compute_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    chosen = devices.choose_mixed_precision(torch.device("cpu"))
    assert chosen == (False, "this cpu device does not compute in bfloat16")


# Terminals that do not take every letter, and pipes that nobody reads.


def latin_stream() -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), encoding="iso-8859-1", errors="strict")


def test_letters_that_are_not_there_are_written_in_plainer_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = latin_stream()
    monkeypatch.setattr(sys, "stdout", stream)
    terminal.take_any_terminal()
    terminal.say("a → b – 64×64 ≥ σ, 日, \udcff")
    assert stream.buffer.getvalue().decode("iso-8859-1") == "a -> b - 64×64 >= sigma, ?, ?\n"


@pytest.mark.parametrize("program", [["recipes/dreamer_v3.py", "--help"], ["-m", "dreamer_racing", "--help"]])
def test_help_is_printed_under_any_locale(tmp_path: Path, program: list[str]) -> None:
    command = [str(ROOT / word) if word.endswith(".py") else word for word in program]
    done = python(*command, cwd=tmp_path, PYTHONIOENCODING="ascii:strict")
    assert done.returncode == 0 and "->" in done.stdout, done.stderr


def test_an_evaluation_is_written_though_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    report = MagicMock(**{"evaluate.return_value.summary.return_value": "σ"})
    reader_has_left = MagicMock(**{"write.side_effect": BrokenPipeError(32, "Broken pipe")})
    monkeypatch.setattr(sys, "stdout", reader_has_left)
    written = recipe_module("evaluate").evaluate_nominal(report)
    assert list(written) == [call.args[0] for call in report.write.call_args_list] == ["deterministic", "stochastic"]
    assert reader_has_left.write.called


# Programs of a user whose home is not writable.


CACHES = ("WARP_CACHE_PATH", "XDG_CACHE_HOME")


@pytest.fixture
def homeless(tmp_path: Path) -> dict[str, str]:
    """Variables without a home: below a file there is no folder, whoever asks, root too."""
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    return {"HOME": str(tmp_path / "file" / "home"), "TMPDIR": str(tmp_path / "temporary")}


@pytest.mark.slow
def test_a_race_is_flown_and_it_is_said_once_and_nothing_is_left(tmp_path: Path, homeless: dict[str, str]) -> None:
    program = "import dreamer_racing.envs as envs; envs.DroneRacingEnv('circle', 2, from_pixels=False).rollout(2)"
    done = python("-c", program, without=CACHES, **homeless)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("(Not a directory)") == 1 and "WARP_CACHE_PATH=FOLDER" in done.stderr
    assert list((tmp_path / "temporary").glob("dreamer_racing_*")) == []


def test_the_doctor_says_so(tmp_path: Path, homeless: dict[str, str]) -> None:
    done = python(str(ROOT / "recipes" / "doctor.py"), cwd=tmp_path, without=CACHES, **homeless)
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("caches")]
    assert "note" in line and "cannot write to" in line
    assert "Matplotlib created" not in done.stderr


def test_the_doctor_tries_to_write_where_runs_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "why_not_writable", lambda folder: "Read-only file system")
    found = doctor.disk(1.0, tmp_path / "runs")
    assert found.state.name == "wrong" and f"cannot write to {tmp_path} (Read-only file system)" in found.found


def test_without_any_folder_it_is_said_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(caches, "why_not_writable", lambda folder: "Permission denied")
    monkeypatch.setattr(caches.tempfile, "mkdtemp", full)
    with pytest.raises(caches.CacheError, match=r"Permission denied.*No usable temporary.*WARP_CACHE_PATH=FOLDER"):
        caches.ensure_caches.__wrapped__()


def test_a_user_without_a_home_does_not_write_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert caches.why_not_writable(Path("~/.cache/warp")) == "this user has no home directory"
    assert list(tmp_path.iterdir()) == []
