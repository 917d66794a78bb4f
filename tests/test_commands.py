"""Commands that messages name work where the person stands."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dreamer_racing import commands
from tests.running_recipes import recipe_module

usage = recipe_module("composing.usage")


@pytest.mark.parametrize("folder", ["", "docs", "elsewhere"])
def test_a_hint_starts_the_recipe_from_any_folder(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = tmp_path if folder == "elsewhere" else commands.ROOT / folder
    monkeypatch.chdir(here)
    done = subprocess.run(
        f"{usage.command('tracks')} --help", shell=True, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 and "usage: " in done.stdout, done.stderr
    assert (f"{commands.ROOT}" in usage.command("tracks")) == (folder != "")


def test_an_environment_that_dev_made_is_started_by_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / commands.MADE_BY_DEV).touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.chdir(commands.ROOT)
    assert usage.command("fly") == "./dev python recipes/fly.py"
    assert commands.install_extra("play") == "./dev pip install -e '.[play]'"


def test_a_python_that_the_shell_does_not_find_is_named_by_its_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "dev", lambda: "")
    monkeypatch.setenv("PATH", "/nowhere")
    assert commands.python() == sys.executable


def test_an_extra_of_an_installed_package_comes_from_an_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "ROOT", tmp_path)
    assert commands.install_extra("play") == "pip install 'dreamer_racing[play]'"
