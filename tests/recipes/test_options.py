"""Every option of every recipe takes a value or refuses it in plain words, whatever the value."""

from __future__ import annotations

import hydra
import pytest
from hydra.errors import HydraException
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue

from dreamer_racing.settings import check_settings
from tests.running_recipes import CONFIG, recipe_module

RECIPES = sorted(path.stem for path in CONFIG.glob("*.yaml") if path.stem != "ablation")
numbers = st.one_of(st.integers(), st.floats(), st.sampled_from([0, -1, 1e6, 1e300]))
values = st.one_of(numbers.map(str), st.text(max_size=20), st.sampled_from(["null", "true", "[]", "{}", "auto", "''"]))


def names(recipe: str) -> list[str]:
    entry = recipe_module("composing.entry")
    recipe_module("composing.schema").register()
    recipe_module(recipe)  # some have schemas of their own
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return entry.setting_names(hydra.compose(recipe))


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_option_takes_a_value_or_refuses_it_in_plain_words(recipe: str) -> None:
    entry = recipe_module("composing.entry")
    options = names(recipe)

    @given(st.sampled_from(options), values)
    @settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck))
    def attempt(name: str, value: str) -> None:
        override = entry.whole_number(f"{name}={value}")
        try:
            with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
                config = hydra.compose(recipe, overrides=[override])
            check_settings(OmegaConf.to_object(config))
            return
        except HydraException as error:
            words = entry.in_plain_words(error, recipe, [override])
        except (ValueError, MissingMandatoryValue) as error:
            words = str(error)
        assert words.strip()

    attempt()
