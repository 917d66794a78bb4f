"""The dm_control task: the same flights as the batched worlds, bit for bit, and the manners of the Control Suite."""

import ctypes
import gc
import os
import unittest
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from dm_env import StepType, test_utils
from torchrl.envs import DMControlWrapper
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs import dm_control_env as task_module
from dreamer_racing.envs import dm_control_gl
from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.envs.dm_control_env import load, open_nose
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.race.race import RewardWeights
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.envs.worlds import RaceWorlds
from tests.renderers import NEEDS_EGL

HOVER = np.array([-0.26407, 0.0, 0.0, 0.0], np.float32)
STATE = ("position", "attitude", "linear_velocity", "body_rates")
Policy = Callable[[int, dict[str, np.ndarray]], np.ndarray]

ONE_LAP = replace(load_track("circle"), laps=1)


def pilot(track: Track) -> Policy:
    """The scripted pilot."""
    scripted = ScriptedPilot(track, dtype=torch.float64)

    def act(step: int, observation: dict[str, np.ndarray]) -> np.ndarray:
        rows = (torch.from_numpy(observation[name])[None] for name in STATE)
        return scripted.act(*rows, torch.from_numpy(observation["target_gate"]))[0].float().numpy()

    return act


@pytest.fixture(autouse=True)
def free_contexts() -> Iterator[None]:
    """Free dm_control's OpenGL contexts here: their finalisers raise, which Python 3.11 cannot bear amid parsing."""
    yield
    gc.collect()


def wild(step: int, observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.random.RandomState(step).uniform(-1.2, 1.2, 4).astype(np.float32)


def fall(step: int, observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.array([-1.0, 0.1, 0.0, 0.0], np.float32)


def compare(env, worlds: RaceWorlds, time_step, policy: Policy, steps: int) -> list:
    """Fly both from where they are; every state, reward and ending must agree. Returns the worlds' outcomes."""
    outcomes = []
    for step in range(steps):
        action = policy(step, time_step.observation)
        time_step = env.step(action)
        rows = np.stack([action] + [-action] * (worlds.num_envs - 1))
        outcome = worlds.step(torch.from_numpy(rows))
        outcomes.append(outcome)
        for name in STATE:
            expected = getattr(worlds.simulator.state, name)[0].numpy()
            np.testing.assert_allclose(time_step.observation[name], expected, rtol=0, atol=1e-9)
        assert time_step.observation["target_gate"].item() == outcome.target_gate[0].item()
        weight = env.task.body_rate_weight
        reward = (outcome.reward_base - weight * outcome.body_rate_norm)[0].item()
        assert time_step.reward == pytest.approx(reward, abs=1e-9)
        ended = outcome.terminated[0].item() or outcome.truncated[0].item()
        assert time_step.last() == ended
        assert time_step.discount == (0.0 if outcome.terminated[0] else 1.0)
        if ended:
            break
    return outcomes


@pytest.mark.parametrize("preset", ["easy", "faithful"])
@pytest.mark.parametrize("policy", [wild, fall], ids=["wild", "fall"])
def test_flies_as_the_batched_worlds_episode_after_episode(preset: str, policy: Policy) -> None:
    weights = RewardWeights(body_rate=0.01)
    env = load("kidney", preset, random=7, time_limit=1.0, weights=weights)
    worlds = RaceWorlds("kidney", 1, preset, from_pixels=False, episode_steps=50, weights=weights)
    random = np.random.RandomState(7)
    endings = set()
    for _ in range(3):
        worlds.seed(int(random.randint(2**31)))  # what the task does in each episode
        worlds.reset()
        time_step = env.reset()
        np.testing.assert_array_equal(time_step.observation["position"], worlds.simulator.state.position[0].numpy())
        outcomes = compare(env, worlds, time_step, policy, 60)
        endings.add((outcomes[-1].terminated.item(), outcomes[-1].truncated.item()))
    assert endings <= {(True, False), (False, True)}
    if policy is fall:
        assert endings == {(True, False)}


def test_flies_gates_as_the_batched_worlds() -> None:
    track = load_track("circle")
    env = load(track, evaluation=True)
    worlds = RaceWorlds(track, 1, evaluation=True, from_pixels=False)
    worlds.reset()
    outcomes = compare(env, worlds, env.reset(), pilot(track), 300)
    assert outcomes[-1].gates_passed.item() >= 2
    assert len(outcomes) == 300  # no crash


def test_finishing_the_last_lap_truncates() -> None:
    env = load(ONE_LAP, evaluation=True)
    time_step, fly = env.reset(), pilot(ONE_LAP)
    for step in range(300):
        time_step = env.step(fly(step, time_step.observation))
        if time_step.last():
            break
    assert time_step.last()
    assert time_step.discount == 1.0
    assert time_step.reward == 10.0
    assert env.task.outcome.finished.item()
    assert env.task.outcome.lap_time.item() == pytest.approx((step + 1) * 0.02)


def test_time_limit_truncates_and_the_next_step_begins_an_episode() -> None:
    env = load("circle", evaluation=True, time_limit=0.1)
    env.reset()
    steps = [env.step(HOVER) for _ in range(6)]
    assert [step.step_type for step in steps] == [StepType.MID] * 4 + [StepType.LAST, StepType.FIRST]
    assert steps[4].discount == 1.0
    assert env.control_timestep() == pytest.approx(0.02)
    assert env.physics.time() == 0.0


@pytest.mark.parametrize(
    ("time_limit", "action", "spin", "cause"),
    [
        (None, np.array([0.0, np.inf, 0.0, 0.0]), 0.0, CrashCause.INVALID_ACTION),
        (0.02, np.full(4, np.nan), 0.0, CrashCause.INVALID_ACTION),  # in the last step
        (None, HOVER, 1e200, CrashCause.NON_FINITE_STATE),
    ],
)
def test_what_is_not_finite_is_a_crash_and_not_an_exception(
    time_limit: float | None, action: np.ndarray, spin: float, cause: CrashCause
) -> None:
    env = load("circle", random=0, time_limit=time_limit)
    env.reset()
    env.physics.data.qvel[3:] += spin
    time_step = env.step(action)
    assert (time_step.last(), time_step.discount, time_step.reward) == (True, 0.0, -4.0)
    assert env.task.outcome.crash.item() == cause
    assert spin or all(np.isfinite(values).all() for values in time_step.observation.values())
    begun = env.reset()
    assert not begun.last() and np.isfinite(begun.observation["position"]).all()
    assert env.step(HOVER).discount == 1.0


def test_actions_of_another_shape_or_type_are_refused() -> None:
    env = load("circle")
    env.reset()
    with pytest.raises(ValueError, match=r"shape \(3,\): must be \(4,\): collective thrust"):
        env.step(np.zeros(3))
    with pytest.raises(TypeError, match="Action of int64: thrust and body rates are floating-point numbers"):
        env.step(np.zeros(4, np.int64))


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ({"control_rate": "50"}, "control_rate='50': must be a number"),
        ({"time_limit": "3"}, "time_limit='3': must be a number"),
        ({"time_limit": 0.001}, r"time_limit=0\.001 s"),
        ({"camera": "x"}, "camera='x': must be a Camera"),
        ({"preset": ["easy"]}, r"preset=\['easy'\]: must be one of"),
    ],
)
def test_arguments_of_a_wrong_type_are_named(argument: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load("circle", **argument)


def test_seeds_reproduce_and_differ() -> None:
    def starts(seed: int) -> np.ndarray:
        env = load("split_s", "faithful", random=seed)
        rows = []
        for _ in range(2):
            env.reset()
            rows.append(env.step(HOVER).observation["linear_velocity"])  # depends on the drawn mass too
        return np.stack(rows)

    first = starts(0)
    np.testing.assert_array_equal(first, starts(0))
    assert not np.allclose(first, starts(1))
    assert not np.allclose(first[0], first[1])


class TestSuiteManners(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own conformance tests."""

    def make_object_under_test(self):
        return load("kidney", random=0, time_limit=1.0)

    def make_action_sequence(self):
        return [HOVER] * 120


def test_observations_match_their_specs() -> None:
    env = load("kidney", random=0)
    spec, observation = env.observation_spec(), env.reset().observation
    assert list(spec) == list(observation) == [*STATE, "target_gate"]
    for name, values in observation.items():
        spec[name].validate(values)
    action = env.action_spec()
    assert (action.shape, action.dtype) == ((4,), np.float32)
    assert (action.minimum.min(), action.maximum.max()) == (-1.0, 1.0)
    flat = load("kidney", random=0, environment_kwargs={"flat_observation": True})
    assert flat.reset().observation["observations"].shape == (14,)


def test_observations_are_copies() -> None:
    env = load("kidney", random=0)
    before = env.reset().observation
    kept = {name: values.copy() for name, values in before.items()}
    env.step(np.ones(4))
    for name, values in kept.items():
        np.testing.assert_array_equal(before[name], values)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    error = np.square(one.astype(float) - other.astype(float)).mean()
    return 10 * np.log10(255**2 / max(error, 1e-9))


@NEEDS_EGL
@pytest.mark.parametrize(("renderer", "least"), [("egl", 45.0), ("warp", 26.0)])
def test_pixels_are_those_of_the_batched_renderer(renderer: str, least: float) -> None:
    env = load("kidney", random=0, from_pixels=True)
    worlds = RaceWorlds("kidney", 1, renderer=renderer)
    random = np.random.RandomState(0)
    for _ in range(3):
        worlds.seed(int(random.randint(2**31)))
        worlds.reset()
        pixels = env.reset().observation["pixels"]
        assert (pixels.shape, pixels.dtype) == ((64, 64, 3), np.uint8)
        assert psnr(pixels, worlds.render()[0].numpy()) > least
    action = np.array([0.2, 0.3, -0.2, 0.5], np.float32)
    for _ in range(5):
        flown = env.step(action).observation["pixels"]
        worlds.step(torch.from_numpy(action).unsqueeze(0))
    assert psnr(flown, worlds.render()[0].numpy()) > least
    assert psnr(flown, pixels) < 25.0  # the camera did move, and the first image was not overwritten
    worlds.close()


@NEEDS_EGL
def test_viewer_style_loop_renders_any_size_and_the_drone_from_outside() -> None:
    env = load("kidney", random=0, from_pixels=True)
    env.reset()
    nose = env.step(HOVER).observation["pixels"]
    assert env.physics.render(480, 640, camera_id="nose").shape == (480, 640, 3)
    assert env.physics.render(camera_id=-1).std() > 1.0
    segments = env.physics.render(480, 640, camera_id="spectator", segmentation=True)[..., 0]
    drone = np.flatnonzero(env.physics.model.geom_bodyid == env.physics.model.name2id("drone", "body"))
    rows, columns = np.isin(segments, drone).nonzero()
    assert len(rows) >= 3
    assert abs(rows.mean() - 240) < 10  # the spectator looks at the drone
    assert abs(columns.mean() - 320) < 10
    np.testing.assert_array_equal(env.task._view.render(), nose)  # whose own view other cameras leave alone


@pytest.mark.parametrize(
    "draw", [lambda: open_nose(load("circle").physics, Camera()), lambda: ControlSuiteEnv("cartpole_swingup", 1)]
)
def test_missing_opengl_is_explained(draw: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: object) -> None:
        raise RuntimeError("No OpenGL rendering backend is available.")

    monkeypatch.setattr(task_module.mujoco, "Camera", broken)
    words = "No OpenGL rendering backend.*libegl1.*MUJOCO_GL=egl.*from_pixels=False"
    with pytest.raises(RendererUnavailableError, match=words):
        draw()


@pytest.mark.parametrize(
    ("environment", "libraries", "chosen"),
    [
        ({}, ("libEGL.so.1",), "egl"),
        ({}, ("libOSMesa.so.6",), "osmesa"),
        ({}, (), "disable"),
        ({"DISPLAY": ":0"}, ("libEGL.so.1",), None),
        ({"MUJOCO_GL": "osmesa"}, ("libEGL.so.1",), "osmesa"),
    ],
)
def test_headless_backend_choice(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], libraries: tuple[str, ...], chosen: str | None
) -> None:
    def open_library(name: str) -> None:
        if name not in libraries:
            raise OSError(name)

    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.setenv(name, "")  # remembers what was there, or that nothing was
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(dm_control_gl.sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", open_library)
    dm_control_gl.choose_backend()
    assert os.environ.get("MUJOCO_GL") == chosen


@pytest.mark.parametrize("from_pixels", [False, pytest.param(True, marks=NEEDS_EGL)])
def test_torchrl_wraps_it(from_pixels: bool) -> None:
    env = DMControlWrapper(load("circle", random=0, time_limit=0.2, from_pixels=from_pixels))
    check_env_specs(env, seed=0)
    env.set_seed(5)
    first = env.rollout(5)
    env.set_seed(5)
    again = env.reset()
    torch.testing.assert_close(first["position"][0], again["position"])
    long = env.rollout(15, policy=lambda *observation: torch.from_numpy(HOVER))
    assert len(long) == 10
    assert long["next", "truncated"][-1].item()
    assert not long["next", "terminated"].any()


def test_another_control_rate() -> None:
    env = load("circle", random=0, control_rate=25)
    assert env.control_timestep() == pytest.approx(0.04)
    assert env.task.race.episode_steps == 500


@NEEDS_EGL
@pytest.mark.parametrize("changes", [{"imu": "exact"}, {"camera_rate": 25}])
def test_specs_are_known_before_the_first_episode(changes: dict[str, object]) -> None:
    """TorchRL's wrapper reads them then."""
    env = DMControlWrapper(load("circle", random=0, from_pixels=True, **changes))
    flown = env.rollout(2)
    assert flown["pixels"].shape == (2, 64, 64, 3)
    assert ("imu" in flown.keys()) == ("imu" in changes)  # noqa: SIM118
    env.close()
