"""`--help`: there at once, and in words of the recipe's own."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path

import pytest

from dreamer_racing import commands
from dreamer_racing.settings import ALLOWED
from tests.running_recipes import ROOT, recipe, recipe_module

options, usage = recipe_module("composing.options"), recipe_module("composing.usage")
RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))


@pytest.mark.parametrize("name", RECIPES)
def test_help_has_what_it_does_and_every_option_with_a_meaning(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "dev", lambda: "")  # which makes lines longer
    text = "\n".join(usage.usage(name))
    said = (ROOT / "recipes" / f"{name}.py").read_text(encoding="utf-8").splitlines()[0].lstrip('r"').rstrip('"')
    assert said in text and f"python recipes/{name}.py" in text
    assert options.options(name) and all(option.name.split(",")[0] in text for option in options.options(name))
    assert "Powered by Hydra" not in text and "schema" not in text
    assert max(map(len, text.splitlines())) <= 120


def test_groups_are_the_recipes_own() -> None:
    found = options.groups("dreamer_v3")
    assert found["env"] == ["betaflight", "dmc", "easy", "faithful"] and "race" in found["tuned"]
    assert "network" in options.groups("ppo") and "network" not in found
    assert options.groups("fly") == {}


def test_what_is_read_of_the_source_is_what_the_dataclasses_are() -> None:
    """Names, defaults and ranges of every option of DreamerV3, beside those of the imported classes."""
    schema = recipe_module("composing.schema").DreamerV3RunConfig
    found = {name: option for option in options.options("dreamer_v3") for name in option.names}

    def compare(config: type, prefix: str = "") -> Iterator[str]:
        types = typing.get_type_hints(config)
        for field in dataclasses.fields(config):
            name = f"{prefix}{field.name}"
            if dataclasses.is_dataclass(types[field.name]):
                yield from compare(types[field.name], f"{name}.")
            elif name != "algorithm":
                option = found[name]
                if len(option.names) == 1 and ALLOWED in field.metadata:
                    assert option.allowed == str(field.metadata[ALLOWED]), name
                if len(option.names) == 1 and isinstance(field.default, int | float):
                    number = field.default if isinstance(field.default, bool) else f"{field.default:g}"
                    plain = str(number).lower() if isinstance(number, bool) else number
                    assert option.default.strip("`") in (plain, str(field.default)), name
                yield name

    assert set(compare(schema)) == found.keys()


WITHOUT_WHAT_TAKES_TIME = """
import sys
for name in [*sys.modules]:  # which begin with what a recipe needs
    if name.partition(".")[0] in ("torch", "torchrl", "tensordict", "hydra", "dreamer_racing"):
        del sys.modules[name]
sys.modules["torch"] = sys.modules["hydra"] = None
"""
WHAT_IS_LOADED = """
import atexit, sys
for name in [*sys.modules]:
    if name.partition(".")[0] in ("torch", "torchrl", "tensordict", "hydra", "dreamer_racing"):
        del sys.modules[name]
atexit.register(lambda: print("loaded:", *(name for name in ("torch", "hydra") if name in sys.modules)))
"""


@pytest.mark.parametrize(("name", "flag"), [*((name, "--help") for name in RECIPES), ("export", "-h")])
def test_help_loads_neither_torch_nor_hydra(name: str, flag: str, tmp_path: Path) -> None:
    done = recipe(name, flag, cwd=tmp_path, before=WITHOUT_WHAT_TAKES_TIME)
    first = done.stdout.partition("\n")[0]
    assert done.returncode == 0 and first.startswith("usage: ") and f" {ROOT}/recipes/{name}.py" in first, done.stderr


@pytest.mark.parametrize(
    ("name", "override", "words"),
    [
        ("dreamer_v3", "trak=kidney", "there is no such setting of recipes/dreamer_v3.py (did you mean track?)"),
        (
            "dreamer_v3",
            "tuned=rcae",
            "tuned=rcae: there are auto, gpu, images, none, race, suite (did you mean race?).",
        ),
        ("dreamer_v3", "--track=kidney", "settings are written without dashes, track=kidney"),
        ("fly", "+agnt=kidney", "there is no such setting of recipes/fly.py (did you mean agent?)"),
    ],
)
def test_a_slip_of_the_pen_ends_in_a_line_before_anything_is_loaded(
    name: str, override: str, words: str, tmp_path: Path
) -> None:
    done = recipe(name, override, cwd=tmp_path, before=WHAT_IS_LOADED)
    said = done.stderr.splitlines()[-1]  # gymnasium warns that the package is imported once more
    assert done.returncode == 2 and said.startswith("error: ") and words in said
    assert done.stdout == "loaded:\n"


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
    usage.answer_early()
