"""Flights of flyers that need what the IMU tells: told, played back, and cut where it is told no longer."""

from __future__ import annotations

import json
from typing import ClassVar

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.chain import ChainConfig, FlightChain, describe_outputs, read_inputs
from dreamer_racing.hil.recording import FILE, Flight, FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.vehicle import Setpoint
from dreamer_racing.plant.lock_step import LockStep, make_chain
from dreamer_racing.plant.vehicle import PlantVehicle

CIRCLE = load_track("circle")


class Feeling:
    """Damps by the gyro, so that every sample shows in what it wants."""

    rate, camera, feels = 50.0, None, True
    told: ClassVar[list[np.ndarray]] = []

    def reset(self) -> None:
        self.told.clear()

    def act(self, pose, image, target_gate, imu=None) -> Setpoint:
        assert imu is not None
        self.told.append(imu)
        return Setpoint(GRAVITY + 0.5 - 0.01 * (imu[5] - GRAVITY), 0.3 - imu[:3])

    def prepare(self) -> None:
        pass


def make(**limits: float) -> tuple[LockStep, FlightChain]:
    plant = LockStep(PlantVehicle(CIRCLE, "easy"))
    config = ChainConfig(SafetyLimits.of_track(CIRCLE, **limits), arm=True)
    return plant, make_chain(Feeling(), plant.plant.vehicle, config)


def test_a_flight_is_told_what_the_plant_feels_and_plays_back_bit_for_bit(tmp_path) -> None:
    plant, chain = make()
    felt, feel = [], plant.plant.vehicle.feel
    plant.plant.vehicle.feel = lambda: felt.append(feel()) or felt[-1]
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        plant.fly(chain, 50.0, 2.5, recorder)
    told = np.stack(Feeling.told)
    assert len(told) > 30
    assert np.array_equal(told, felt[-len(told) :])
    assert np.abs(told[-1, :3] - 0.15).max() < 0.05, "half of 0.3 rad/s, as it damps itself"
    assert told[-1, 5] == pytest.approx(GRAVITY + 0.5, abs=0.1)
    again = make()[1]
    again.warm_up()
    for tick in Flight(tmp_path).ticks:
        outputs = json.loads(json.dumps(describe_outputs(again.tick(read_inputs(tick["in"])))))
        assert json.dumps(outputs) == json.dumps(tick["out"])


def test_without_samples_it_does_not_arm_and_in_flight_it_is_cut() -> None:
    plant, chain = make()
    plant.feel = list
    assert "it flies by the IMU, and nothing was heard of that" in plant.fly(chain, 50.0, 1.0)
    plant, chain = make()
    feel = plant.feel
    plant.feel = lambda: feel() if plant.elapsed < 2.0 else []
    assert plant.fly(chain, 50.0, 5.0).startswith("cut: the actor has given no usable setpoint for 0.1")
    assert 2.0 < plant.elapsed - 1.0 < 2.3, "s, and a second of farewell"


def test_an_accelerometer_of_another_scale_is_refused_on_the_ground() -> None:
    plant, chain = make()
    feel = plant.plant.vehicle.feel
    plant.plant.vehicle.feel = lambda: feel() * np.array((1.0, 1.0, 1.0, 0.5, 0.5, 0.5))
    assert "its accelerometer shows 4.91 m/s² where it stands" in plant.fly(chain, 50.0, 1.0)
