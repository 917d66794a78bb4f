"""A study's flights: one thing is changed, the rest stays, and a seed gives the same flight again."""

from __future__ import annotations

import numpy as np
import pytest

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.vehicle import hover
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.study import fly


class Hover:
    rate, camera = 50.0, None

    def reset(self):
        pass

    def act(self, pose, image, target_gate):
        return hover()

    def prepare(self):
        pass


def test_what_ends_at_once_is_said_and_repeats():
    class Fall(Hover):
        def act(self, pose, image, target_gate):
            return hover()._replace(collective_thrust=7.0, body_rates=np.array([1.0, 0.0, 0.0]))

    flown = [fly(Fall(), "circle", "easy", "position_noise", 0.02, seed) for seed in (0, 0, 1)]
    assert flown[0] == flown[1]
    assert (flown[0].gates, flown[0].finished, flown[0].lap_time) == (0, False, None)
    assert flown[0].speed_max > 1.0 and flown[0].ended.startswith("cut: ")


@pytest.mark.slow
def test_the_pilot_finishes_through_the_rate_loop_of_a_betaflight():
    flown = fly(PilotFlyer(load_track("circle"), "betaflight"), "circle", "betaflight", "mass", 1.0, 0)
    assert flown.finished and flown.gates == 12 and 2.0 < flown.lap_time < 6.0


@pytest.mark.slow
def test_the_pilot_finishes_with_ten_percent_more_mass():
    flown = fly(PilotFlyer(load_track("circle"), "faithful"), "circle", "faithful", "mass", 1.1, 0)
    assert flown.finished and flown.gates == 12 and 2.0 < flown.lap_time < 6.0
