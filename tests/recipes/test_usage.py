"""Usage and options of every recipe."""

from __future__ import annotations

import copy
import math
import os
import pickle
import subprocess
import sys
from pathlib import Path

import hydra
import pytest
from hydra.errors import HydraException
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dreamer_racing import commands
from dreamer_racing.settings import shortened
from tests.running_recipes import CONFIG, ROOT, recipe, recipe_module

options = recipe_module("composing.options")
RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))


@pytest.mark.parametrize("name", RECIPES)
def test_help_has_what_it_does_and_every_option_with_a_meaning(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "dev", lambda: "")  # which makes lines longer
    text = "\n".join(options.usage(name))
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


FORGET = """
import atexit, sys
for name in [*sys.modules]:  # which begin with what a recipe needs
    if name.partition(".")[0] in ("torch", "torchrl", "tensordict", "hydra", "dreamer_racing"):
        del sys.modules[name]
"""
WITHOUT_WHAT_TAKES_TIME = f'{FORGET}sys.modules["torch"] = sys.modules["hydra"] = None'
WHAT_IS_LOADED = f"""{FORGET}
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
            "tuned=rcae: must be one of auto, gpu, images, none, race, suite (did you mean race?).",
        ),
        ("dreamer_v3", "--track=kidney", "settings are written without dashes, track=kidney"),
        ("fly", "+agnt=kidney", "there is no such setting of recipes/fly.py (did you mean agent?)"),
    ],
)
def test_a_typing_error_ends_in_a_line_before_anything_is_loaded(
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
    options.handle_help_and_typos()


# Every option of every recipe takes a value or refuses it in plain words, whatever the value.


TRAINING = ("dreamer_v3", "latent_ppo", "ppo", "sac")
NEEDED = {
    "dreamer_v3": ["model=debug", "device=cpu"],
    "latent_ppo": ["model=debug", "device=cpu"],
    "ppo": ["device=cpu"],
    "sac": ["device=cpu"],
    "evaluate": ["checkpoint=nowhere"],
    "perception": ["checkpoint=nowhere"],
    "export": ["checkpoint=nowhere"],
    "hil": ["actor=kidney"],
    "sim_to_real": ["track=kidney"],
    "dashboard": ["run=nowhere"],
}
ODD = (-1, 0, 10**30, 0.5, -math.inf, math.inf, math.nan, 1e300, "", "x" * 60, None, True, [], [1, "a"])
MANY = 100
REFUSED, MOST_LETTERS = 2, 1500  # exit status, and letters of what is said
LENIENT = ("tracks", "export")  # whose options of one type take any value, or are looked at once files are read
numbers = st.one_of(st.integers(), st.floats(), st.sampled_from([0, -1, 1e6, 1e300]))
values = st.one_of(numbers.map(str), st.text(max_size=20), st.sampled_from(["null", "true", "[]", "{}", "auto", "''"]))


def names(recipe: str) -> list[str]:
    recipe_module(recipe)  # some have schemas of their own
    return recipe_module("composing.options").names(recipe)


def compose(recipe: str, *overrides: str) -> DictConfig:
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return hydra.compose(recipe, overrides=[*NEEDED.get(recipe, ()), *overrides])


def check(recipe: str, config: DictConfig) -> None:
    """Refuse what a recipe does before it makes or reads anything."""
    module = recipe_module(recipe)
    if recipe in TRAINING:
        OmegaConf.to_object(module.resolve(config)).check()
    elif recipe == "experiment":
        module.check(config)
    else:
        settings = recipe_module("composing.entry").to_checked_object(config)
        getattr(module, "check", lambda checked: None)(settings)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_option_takes_a_value_or_refuses_it_in_plain_words(
    recipe: str, capsys: pytest.CaptureFixture[str]
) -> None:
    entry, plain_errors = recipe_module("composing.entry"), recipe_module("composing.entry").plain_errors
    options = names(recipe)

    @given(st.sampled_from(options), values)
    @hypothesis_settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
    def attempt(name: str, value: str) -> None:
        override = entry.normalise_argument(f"{name}={value}")
        capsys.readouterr()
        try:
            with plain_errors():
                check(recipe, compose(recipe, override))
            return
        except HydraException as error:
            words = entry.in_plain_words(error, recipe, [override])
        except SystemExit as refused:
            words = capsys.readouterr().err if refused.code == REFUSED else ""
        assert words.strip()

    attempt()


@pytest.mark.parametrize("recipe", RECIPES)
def test_no_option_lets_a_value_of_another_kind_or_size_through_to_a_traceback(
    recipe: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every option in turn, with odd values that its type takes, before the recipe's own check."""
    plain_errors, options = recipe_module("composing.entry").plain_errors, names(recipe)
    whole = compose(recipe)
    check(recipe, copy.deepcopy(whole))  # as it is, it is taken
    state = pickle.dumps(whole)  # quicker copied by this than by deepcopy
    config, refused, wrong = pickle.loads(state), 0, []
    shared = set(names(TRAINING[0])) if recipe in TRAINING[1:] else set()  # which have all of their values there
    for index, name in enumerate(options):
        each = len(ODD) if name in shared else 1 if len(options) < MANY else 3  # of the values, in turn
        for value in ODD[index % each :: each]:
            try:
                OmegaConf.update(config, name, value)
            except OmegaConfBaseException:
                continue  # hydra says it as one of its own, which the test above is about
            taken, config = config, pickle.loads(state)
            capsys.readouterr()
            try:
                with plain_errors():
                    check(recipe, taken)
            except SystemExit as error:
                refused += 1
                words = capsys.readouterr().err
                if error.code != REFUSED or not words.startswith("error: ") or len(words) > MOST_LETTERS:
                    wrong.append(f"{name}={value!r}: exit status {error.code}, {shortened(words, 200)}")
            except Exception as error:
                wrong.append(f"{name}={value!r}: {error!r}")
    assert not wrong, "\n".join(wrong)
    assert refused or recipe in LENIENT, "no value was refused: this test has tested nothing"
