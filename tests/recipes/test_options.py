"""Every option of every recipe takes a value or refuses it in plain words, whatever the value."""

from __future__ import annotations

import copy
import math

import hydra
import pytest
from hydra.errors import HydraException
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dreamer_racing.settings import check_settings, shortened
from tests.running_recipes import CONFIG, ROOT, recipe_module

RECIPES = sorted(path.stem for path in (ROOT / "recipes").glob("*.py"))
TRAINING = {
    "dreamer_v3": "check_world_model_run",
    "latent_ppo": "check_world_model_run",
    "ppo": "check_ppo",
    "sac": "check_sac",
}
UNTYPED = ("fly", "tracks")  # their checks take what hydra composed
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
    recipe_module("composing.schema").register()
    recipe_module(recipe)  # some have schemas of their own
    return recipe_module("composing.options").names(recipe)


def compose(recipe: str, *overrides: str) -> DictConfig:
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return hydra.compose(recipe, overrides=[*NEEDED.get(recipe, ()), *overrides])


def check(recipe: str, config: DictConfig) -> None:
    """Refuse what a recipe does before it makes or reads anything."""
    module, checks = recipe_module(recipe), recipe_module("composing.checks")
    if recipe in TRAINING:
        getattr(checks, TRAINING[recipe])(OmegaConf.to_object(module.resolve(config)))
    elif recipe == "experiment":
        checks.check_variant(config)
    elif recipe in UNTYPED:
        module.check(config)
    else:
        settings = OmegaConf.to_object(config)
        check_settings(settings)
        getattr(module, "check_plot" if recipe == "plot" else "check", check_settings)(settings)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_option_takes_a_value_or_refuses_it_in_plain_words(
    recipe: str, capsys: pytest.CaptureFixture[str]
) -> None:
    entry, plain_errors = recipe_module("composing.entry"), recipe_module("composing.command_line").plain_errors
    options = names(recipe)

    @given(st.sampled_from(options), values)
    @hypothesis_settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
    def attempt(name: str, value: str) -> None:
        override = entry.readable(f"{name}={value}")
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
    plain_errors, options = recipe_module("composing.command_line").plain_errors, names(recipe)
    whole = compose(recipe)
    check(recipe, copy.deepcopy(whole))  # as it is, it is taken
    config, refused, wrong = copy.deepcopy(whole), 0, []
    each = 1 if len(options) < MANY else 3  # of the values, in turn
    for index, name in enumerate(options):
        for value in ODD[index % each :: each]:
            try:
                OmegaConf.update(config, name, value)
            except OmegaConfBaseException:
                continue  # hydra says it as one of its own, which the test above is about
            taken, config = config, copy.deepcopy(whole)
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
