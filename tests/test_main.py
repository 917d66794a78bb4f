"""`python -m dreamer_racing`, and the commands that are printed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from dreamer_racing import commands
from tests.running_recipes import ROOT, python, recipe_module

RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))


def start(*arguments: str, path: Path = ROOT, cwd: Path) -> subprocess.CompletedProcess[str]:
    return python("-m", "dreamer_racing", *arguments, cwd=cwd, PYTHONPATH=str(path), PYTHONDONTWRITEBYTECODE="1")


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a wheel holds, as setup.py builds it."""
    folder = tmp_path_factory.mktemp("installed")
    source = tmp_path_factory.mktemp("source")
    unwanted = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("dreamer_racing", "recipes", "agents"):
        shutil.copytree(ROOT / name, source / name, ignore=unwanted)
    (source / "docs").mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "docs/options.md"):
        shutil.copy(ROOT / name, source / name)
    done = python("setup.py", "-q", "build_py", "--build-lib", str(folder), cwd=source)
    assert done.returncode == 0, done.stderr
    return folder


def test_the_help_names_every_recipe(tmp_path: Path) -> None:
    done = start("--help", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")] == RECIPES


def test_an_unknown_recipe_is_refused(tmp_path: Path) -> None:
    done = start("dreamerv3", "track=kidney", cwd=tmp_path)
    assert done.returncode == 2 and "dreamerv3: no such recipe (did you mean dreamer_v3?)" in done.stderr


def test_from_a_clone_it_is_the_recipe_s_own_file(tmp_path: Path) -> None:
    done = start("fly", "--help", cwd=tmp_path)
    assert "recipes/fly.py [NAME=VALUE ...]" in done.stdout.splitlines()[0], done.stderr
    done = start("fly", "pilto=hover", cwd=tmp_path)
    assert done.returncode == 2 and "did you mean pilot?" in done.stderr


def test_a_wheel_holds_what_its_recipes_need(installed: Path, tmp_path: Path) -> None:
    assert [path.name for path in installed.iterdir()] == ["dreamer_racing"], "nothing else at the top"
    package = installed / "dreamer_racing"
    for name in ("recipes/config", "agents"):
        there = {path.relative_to(package) for path in (package / name).rglob("*")}
        unwanted = {path for path in (ROOT / name).rglob("*") if "__pycache__" in path.parts}
        assert there == {path.relative_to(ROOT) for path in set((ROOT / name).rglob("*")) - unwanted}
    done = start("fly", "--help", path=installed, cwd=tmp_path)
    assert done.stdout.startswith("usage: python -m dreamer_racing fly"), done.stderr
    done = start("fly", "agent=nobody", path=installed, cwd=tmp_path)
    names = ", ".join(sorted(path.parent.name for path in (ROOT / "agents").glob("*/agent.json")))
    named = f"Included agents, by name: {names}"
    assert done.returncode == 2 and named in done.stderr


# Commands that messages name work where the person stands.


usage = recipe_module("composing.options")


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
