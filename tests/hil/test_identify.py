"""The flight that tells how a vehicle answers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.chain import ChainConfig
from dreamer_racing.hil.identify import AMPLITUDES, AXES, IdentificationFlyer, make_schedule
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.plant.lock_step import LockStep, make_chain
from dreamer_racing.plant.vehicle import PlantVehicle

CIRCLE = load_track("circle")


def test_steps_follow_each_other_and_every_axis_is_moved_both_ways() -> None:
    steps = make_schedule()
    assert all(one.end <= other.begin + 1e-9 for one, other in pairwise(steps))
    for axis in range(len(AXES)):
        moved = [step.value * (step.end - step.begin) for step in steps if step.axis == axis]
        assert min(moved) < 0 < max(moved)
        assert abs(sum(moved)) <= 0.46 * AMPLITUDES[AXES[axis]][1], "it ends near where it began"
    assert make_schedule(0) == make_schedule(0) != make_schedule(1)


def test_a_vehicle_flies_its_first_steps_within_a_metre_and_tilts_little() -> None:
    """On physics that answer later than those of most; the whole flight is in `tests/identification`."""
    plant = LockStep(PlantVehicle(CIRCLE, "faithful"))
    places, tilts = [], []
    sleep = plant.sleep_until

    def watch(deadline: float) -> None:
        sleep(deadline)
        pose = plant.plant.vehicle.pose()
        if plant.plant.vehicle.armed:  # it falls when all is over
            places.append(pose.position)
            tilts.append(1.0 - 2.0 * (pose.attitude[1] ** 2 + pose.attitude[2] ** 2))

    plant.sleep_until = watch
    limits = SafetyLimits.of_track(CIRCLE, still_time=3600.0)
    flyer = IdentificationFlyer()
    chain = make_chain(flyer, plant.plant.vehicle, ChainConfig(limits, arm=True))
    assert plant.fly(chain, flyer.rate, 12.0) == "12 s are over"
    flown = np.array(places[200:])
    assert np.abs(flown - (*CIRCLE.start_position[:2], CIRCLE.start_position[2] + 0.3)).max() < 1.0
    assert np.degrees(np.arccos(min(tilts))) < 40.0
