"""`recipes/sim_to_real.py` before anything flies."""

from __future__ import annotations

import pytest

from tests.running_recipes import recipe_module

sim_to_real = recipe_module("sim_to_real")


def test_an_actor_of_another_track_is_refused():
    assert sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney"))[0] == "kidney"
    with pytest.raises(ValueError, match="source.track is 'kidney', .* track=circle"):
        sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney", track="circle"))
