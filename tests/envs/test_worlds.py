"""The options that every environment hands on to its worlds."""

from __future__ import annotations

import inspect

from dreamer_racing.envs.worlds import RaceWorlds, WorldOptions

OF_ADAPTERS = {"self", "track", "num_envs", "preset", "from_pixels"}


def test_every_option_of_the_worlds_is_handed_on():
    parameters = inspect.signature(RaceWorlds.__init__).parameters
    assert set(parameters) - OF_ADAPTERS == set(WorldOptions.__annotations__)
