"""Gyro and accelerometer of the flight controller: closed-form flights, errors, and every front door."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from dreamer_racing.envs.dm_control_env import load
from dreamer_racing.envs.drone.parameters import GRAVITY, PRESETS, QuadrotorParameters
from dreamer_racing.envs.imu import ACCELEROMETER_RANGE, IMUS, Imu, ImuErrors
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.simulator.simulators import MujocoSimulator
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.plant.vehicle import PlantVehicle
from tests.interfaces import flights

SMALL = {"camera": Camera(16, 16), "seed": 3}
LEVEL = (1.0, 0.0, 0.0, 0.0)


def simulated(parameters: QuadrotorParameters, attitude=LEVEL, velocity=(0.0, 0.0, 0.0)):
    generator = torch.Generator().manual_seed(0)
    simulator = MujocoSimulator(load_track("circle"), parameters, 1, renderer=None, generator=generator)
    rows = [torch.tensor([values], dtype=torch.float64) for values in ((0.0, 0.0, 5.0), attitude, velocity)]
    simulator.reset(torch.tensor([True]), *rows)
    return simulator


def act(*action: float) -> Tensor:
    return torch.tensor([action], dtype=torch.float64)


def test_a_hover_weighs_its_weight() -> None:
    simulator = simulated(PRESETS["easy"])
    assert simulator.ideal_imu().tolist() == [[0, 0, 0, 0, 0, GRAVITY]]
    for _ in range(20):
        simulator.step(act(PRESETS["easy"].hover_action, 0.0, 0.0, 0.0))
    assert torch.allclose(simulator.ideal_imu(), act(0, 0, 0, 0, 0, GRAVITY), atol=1e-3)


def test_a_fall_weighs_nothing_and_full_thrust_what_the_rotors_give() -> None:
    simulator = simulated(PRESETS["easy"], attitude=(0.6, 0.0, 0.8, 0.0))
    for _ in range(60):
        simulator.step(act(-1.0, 0.0, 0.0, 0.0))
    assert simulator.ideal_imu().abs().max() < 0.01
    for _ in range(60):
        simulator.step(act(1.0, 0.0, 0.0, 0.0))
    assert torch.allclose(simulator.ideal_imu()[:, 3:], act(0, 0, 4 * 4.0 / 0.6), atol=0.01)


def test_drag_is_felt_against_the_way_and_rates_are_the_bodys() -> None:
    parameters = PRESETS["faithful"]
    drone = QuadrotorParameters(drag=parameters.drag, physics_dt=0.001)
    simulator = simulated(drone, velocity=(5.0, -2.0, 0.0))
    simulator.step(act(drone.hover_action, 0.0, 0.0, 0.0))
    velocity = simulator.state.linear_velocity
    expected = -velocity * torch.tensor(parameters.drag) / drone.mass
    assert torch.allclose(simulator.ideal_imu()[:, 3:5], expected[:, :2], atol=0.01)
    for _ in range(20):
        simulator.step(act(0.0, 0.3, -0.2, 0.5))
    assert torch.equal(simulator.ideal_imu()[:, :3], simulator.state.body_rates)
    assert torch.allclose(simulator.ideal_imu()[:, :3], act(3.0, -2.0, 2.0), atol=0.1)


def test_the_plant_feels_the_same() -> None:
    """By `specific_force`, which it tells a firmware."""
    vehicle = PlantVehicle("circle", "easy")
    assert vehicle.specific_force.tolist() == [0, 0, GRAVITY]


def test_noise_and_bias_have_their_widths_and_biases_stay_for_an_episode() -> None:
    count, errors = 4000, ImuErrors(gyro_noise=0.1, gyro_bias=0.2, accelerometer_noise=0.3, accelerometer_bias=0.4)
    imu = Imu(errors, lambda: torch.zeros(count, 6, dtype=torch.float64), torch.Generator().manual_seed(0))
    imu.begin(torch.ones(count, dtype=torch.bool))
    samples = []
    for _ in range(20):
        imu.step()
        samples.append(imu.sample)
    flown = torch.stack(samples)  # (20, N, 6)
    assert torch.allclose(flown.std(0).mean(0), torch.tensor([0.1] * 3 + [0.3] * 3), rtol=0.05)
    assert torch.allclose(flown.mean(0).std(0), torch.tensor([0.2] * 3 + [0.4] * 3), rtol=0.05)
    kept = imu._bias.clone()
    begun = torch.arange(count) % 2 == 0
    imu.begin(begun)
    changed = (imu._bias != kept).any(1)
    assert torch.equal(changed, begun)


def test_a_late_sample_is_the_one_of_before_and_none_is_older_than_its_episode() -> None:
    felt = torch.arange(6.0).repeat(2, 1)
    imu = Imu(ImuErrors(delay=2), lambda: felt, torch.Generator())
    imu.begin(torch.tensor([True, True]))
    seen = []
    for step in range(1, 5):
        felt = torch.arange(6.0).repeat(2, 1) + step
        if step == 4:
            imu.begin(torch.tensor([False, True]))
        imu.step()
        seen.append(imu.sample[:, 0].tolist())
    assert seen == [[0, 0], [0, 0], [1, 1], [2, 4]]


def test_a_sensor_has_its_range_and_a_broken_state_shows_finite_numbers() -> None:
    felt = torch.tensor([[1e9, -1e9, float("nan"), float("inf"), -1e9, 0.0]])
    imu = Imu(ImuErrors(), lambda: felt, torch.Generator())
    imu.begin(torch.tensor([True]))
    assert imu.sample.isfinite().all()
    assert imu.sample[0, 4].item() == pytest.approx(-ACCELEROMETER_RANGE)


def test_every_interface_gives_the_same_imu() -> None:
    action = np.array([-0.1, 0.1, -0.1, 0.2], np.float32)
    seen = flights(action, 5, "imu", "pixels_imu", preset="faithful", imu="exact", **SMALL)
    assert seen["torchrl"][0].dtype == np.float32
    for name, each in seen.items():
        assert np.array_equal(each, seen["torchrl"]), name


def test_dm_control_feels_what_the_batched_worlds_feel() -> None:
    env = load("circle", "easy", random=0, evaluation=True, imu="exact")
    worlds = RaceWorlds("circle", 1, evaluation=True, imu="exact", seed=0, camera=Camera(16, 16))
    worlds.reset()
    action = np.array([0.2, 0.1, -0.1, 0.2], np.float32)
    seen = [env.reset(), *(env.step(action) for _ in range(5))]
    assert worlds.imu is not None
    expected = [worlds.imu.sample[0]]
    for _ in range(5):
        worlds.step(torch.from_numpy(action)[None])
        expected.append(worlds.imu.sample[0])
    worlds.close()
    assert np.allclose([each.observation["imu"] for each in seen], torch.stack(expected), atol=1e-4)


def test_the_worlds_are_those_without() -> None:
    """Only noise draws from the generator."""
    exact, without = (DroneRacingEnv("circle", 2, preset="faithful", imu=imu, **SMALL) for imu in ("exact", None))
    for env in (exact, without):
        env.reset()
        for _ in range(6):
            env.worlds.step(torch.zeros(2, 4))
        env.close()
    assert torch.equal(exact.worlds.simulator.state.position, without.worlds.simulator.state.position)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DroneRacingEnv("circle", 1, imu="perfect"), "imu='perfect': must be exact, noisy, ImuErrors"),
        (lambda: DroneRacingEnv("circle", 1, imu=True), "imu=True: must be exact"),
        (lambda: DroneRacingEnv("circle", 1, imu="exact", from_pixels=False), "imu='exact': needs images"),
        (lambda: ImuErrors(gyro_noise=-1), "imu.gyro_noise=-1: must be at least 0"),
        (lambda: ImuErrors(delay=0.5), "imu.delay=0.5: must be a whole number"),
        (
            lambda: gymnasium.make("dreamer_racing/Circle-v0", imu="exact"),
            "imu='exact' is for observation='pixels_imu', not 'pixels'",
        ),
    ],
)
def test_bad_values_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_named_imus_have_the_errors_of_their_name() -> None:
    assert IMUS["exact"] == ImuErrors()
    assert all(value > 0 for value in vars(IMUS["noisy"]).values())
