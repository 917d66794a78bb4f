"""Terminals that do not take every letter, and pipes that nobody reads."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dreamer_racing import terminal
from tests.running_recipes import ROOT, recipe_module


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
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:strict", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *(str(ROOT / word) if word.endswith(".py") else word for word in program)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0 and b"->" in done.stdout, done.stderr


class Report:
    """Flies nothing, and notes what was written."""

    def __init__(self) -> None:
        self.written: list[str] = []

    def evaluate(self, deterministic: bool) -> Any:
        return SimpleNamespace(episodes=[], summary=lambda: "σ", to_dict=dict)

    def write(self, name: str, result: object) -> None:
        self.written.append(name)

    def close(self) -> None:
        pass


class Unread(io.StringIO):
    """A pipe whose reader has left."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")


def test_an_evaluation_is_written_though_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    report = Report()
    monkeypatch.setattr(sys, "stdout", Unread())
    written = recipe_module("evaluate").evaluate_nominal(report)
    assert list(written) == report.written == ["deterministic", "stochastic"]
