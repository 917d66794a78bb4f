"""`--help`: there at once, and in words of the recipe's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.running_recipes import ROOT, recipe, recipe_module

usage = recipe_module("composing.usage")
RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))


@pytest.mark.parametrize("name", RECIPES)
def test_help_has_what_it_does_and_every_option_with_a_meaning(name: str) -> None:
    text = "\n".join(usage.usage(name))
    said = (ROOT / "recipes" / f"{name}.py").read_text(encoding="utf-8").splitlines()[0].lstrip('r"').rstrip('"')
    assert said in text and f"python recipes/{name}.py" in text
    assert usage.tables(usage.OPTIONS.read_text(encoding="utf-8"))[f"recipes/{name}.py"], "no options on the page"
    assert "Powered by Hydra" not in text and "schema" not in text
    assert max(map(len, text.splitlines())) <= 120


def test_groups_are_the_recipes_own() -> None:
    found = usage.groups("dreamer_v3")
    assert found["env"] == ["dmc", "easy", "faithful"] and "race" in found["tuned"]
    assert "network" in usage.groups("ppo") and "network" not in found
    assert usage.groups("fly") == {}


def test_the_options_of_all_training_recipes_are_in_the_help_of_each() -> None:
    assert set(usage.TRAINING) == set(recipe_module("composing.schema").RECIPES)


WITHOUT_WHAT_TAKES_TIME = """
import sys
for name in [*sys.modules]:  # which begin with what a recipe needs
    if name.partition(".")[0] in ("torch", "torchrl", "tensordict", "hydra", "dreamer_racing"):
        del sys.modules[name]
sys.modules["torch"] = sys.modules["hydra"] = None
"""


@pytest.mark.parametrize(("name", "flag"), [*((name, "--help") for name in RECIPES), ("export", "-h")])
def test_help_loads_neither_torch_nor_hydra(name: str, flag: str, tmp_path: Path) -> None:
    done = recipe(name, flag, cwd=tmp_path, before=WITHOUT_WHAT_TAKES_TIME)
    assert done.returncode == 0 and done.stdout.startswith(f"usage: {usage.python()} {ROOT}/recipes/{name}.py"), (
        done.stderr
    )


def test_a_reader_that_has_read_enough_is_no_error(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, str(ROOT / "recipes" / "export.py"), "--help"],
        stdout=writer, stderr=subprocess.PIPE, text=True, cwd=tmp_path, check=False,
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_other_programs_keep_their_help(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/export.py", "--help"])
    usage.answer_help()


def test_what_has_columns_and_bars_is_read() -> None:
    page = "## A\n| option | default | may be | |\n|---|---|---|---|\n| `x=` | `1` | above 0 | a \\| b |\n"
    assert usage.tables(page) == {"A": [("x=", "1", "above 0", "a | b")]}
