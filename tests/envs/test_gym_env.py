"""The Gymnasium environment, and what public reports found in others."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import GymEnv
from torchrl.envs.utils import check_env_specs

import dreamer_racing
from dreamer_racing.envs import gym_env
from dreamer_racing.envs.dm_control_env import load
from dreamer_racing.envs.drone.parameters import QuadrotorParameters, load_preset
from dreamer_racing.envs.gym_env import OBSERVATIONS, RENDER_VIEWS, DroneRaceGymEnv
from dreamer_racing.envs.gym_vector_env import DroneRaceVectorEnv
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.race import RewardWeights
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.envs.worlds import RaceWorlds
from tests.running_recipes import python

IDS = [f"dreamer_racing/{name}-v0" for name in dreamer_racing.GYM_ENVIRONMENTS]
HOVER = np.array([QuadrotorParameters().hover_action, 0.0, 0.0, 0.0], np.float32)
UNBOUNDED = ("vector", "state", "both")
INFO = {"gates_passed", "gate_offset", "lap_time", "crash", "finished", "reward_base", "body_rate_norm"}


def make_vec(num_envs: int = 3, **arguments) -> DroneRaceVectorEnv:
    return gymnasium.make_vec("dreamer_racing/Circle-v0", num_envs=num_envs, **arguments)


@pytest.mark.parametrize(
    ("identifier", "observation"), [*((each, "pixels") for each in IDS), *((IDS[0], each) for each in UNBOUNDED)]
)
def test_checker_finds_at_most_that_states_are_unbounded(identifier: str, observation: str) -> None:
    unbounded = observation in UNBOUNDED
    env = gymnasium.make(identifier, observation=observation, render_mode="rgb_array", privileged=unbounded).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if unbounded:
            warnings.filterwarnings("ignore", message=".*A Box observation space m(in|ax)imum value is -?infinity.*")
        check_env(env, skip_render_check=unbounded)
    env.close()


@pytest.mark.parametrize("name", dreamer_racing.GYM_ENVIRONMENTS)
def test_each_track_is_the_one_of_its_name(name: str) -> None:
    assert {"Circle", "Kidney", "Figure8", "SplitS"} <= dreamer_racing.GYM_ENVIRONMENTS.keys()  # others build on them
    identifier, track = f"dreamer_racing/{name}-v0", dreamer_racing.GYM_ENVIRONMENTS[name]
    assert name == "".join(word.capitalize() for word in track.split("_"))
    env = gymnasium.make(identifier, observation="state")
    assert env.unwrapped.race.worlds.track.name == track
    vector = gymnasium.make_vec(identifier, num_envs=2, observation="state")
    assert vector.race.worlds.track.name == track


@pytest.mark.parametrize(
    ("make", "name", "argument", "words"),
    [
        (gymnasium.make, "DroneRaceGymEnv", "start_nois", r" \(did you mean start_noise\?\)"),
        (gymnasium.make, "DroneRaceGymEnv", "from_pixels", ";"),
        (gymnasium.make_vec, "DroneRaceVectorEnv", "start_nois", r" \(did you mean start_noise\?\)"),
        (gymnasium.make_vec, "DroneRaceVectorEnv", "from_pixels", ";"),
        (DroneRacingEnv, "DroneRacingEnv", "trak", r" \(did you mean track\?\)"),
    ],
)
def test_an_unknown_argument_is_refused_by_the_class_that_was_asked_for(
    make: Callable, name: str, argument: str, words: str
) -> None:
    with pytest.raises(TypeError, match=f"^{name} got an unexpected keyword argument {argument!r}{words}"):
        make(IDS[0], **{argument: 1.0})


def test_other_values_than_booleans_are_refused() -> None:
    for make, name in ((DroneRacingEnv, "from_pixels"), (load, "from_pixels"), (DroneRacingEnv, "privileged")):
        with pytest.raises(ValueError, match=f"^{name}='yes': must be True or False"):
            make("circle", **{name: "yes"})
    with pytest.raises(ValueError, match="^evaluation=1: must be True or False"):
        gymnasium.make(IDS[0], observation="state", evaluation=1)


def test_importing_the_package_registers_and_is_cheap() -> None:
    code = (
        "import sys, gymnasium; assert not any(i.startswith('dreamer') for i in gymnasium.registry); "
        "import dreamer_racing; print(sorted(m for m in ('torch', 'mujoco', 'torchrl') if m in sys.modules), "
        "sum(i.startswith('dreamer_racing/') for i in gymnasium.registry))"
    )
    ran = python("-W", "error", "-c", code)
    assert ran.stdout.split() == ["[]", str(len(IDS))], ran.stderr


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_module_form_of_the_name_needs_no_import(make: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    for identifier in IDS:
        monkeypatch.delitem(gymnasium.registry, identifier)
    monkeypatch.delitem(sys.modules, "dreamer_racing")  # as where nobody has imported it
    env = make("dreamer_racing:dreamer_racing/Kidney-v0", observation="state")
    assert env.observation_space.contains(env.reset(seed=0)[0])


def test_pixels_by_default_and_frames_of_the_same_view() -> None:
    env = gymnasium.make(IDS[1], render_mode="rgb_array", render_view="onboard")
    observation, info = env.reset(seed=0)
    assert (observation.shape, observation.dtype) == ((64, 64, 3), np.uint8)
    assert set(info) == INFO
    frame = env.render()
    assert (frame.shape, frame.dtype) == ((256, 256, 3), np.uint8)
    small = frame.reshape(64, 4, 64, 4, 3).mean((1, 3))
    assert np.abs(small - observation).mean() < 4.0
    env.close()
    env.close()


def test_frames_show_the_drone_from_outside_by_default() -> None:
    """What `ChaseView` draws of the same state; the drone's colours are in it, and move with it."""
    env = gymnasium.make("dreamer_racing/Kidney-v0", observation="state", render_mode="rgb_array")
    state, _ = env.reset(seed=0)
    view = ChaseView(load_track("kidney"), load_preset("easy"))
    for step in range(3):
        frame = env.render()
        place = (state["position"][None], state["attitude"][None], np.array([int(state["target_gate"])]))
        (expected,) = view.draw(
            *(np.asarray(part, float if part.ndim > 1 else int) for part in place), np.array([0.02 * step])
        )
        assert (frame.shape, frame.dtype) == ((256, 256, 3), np.uint8)
        assert np.abs(frame.astype(int) - expected).mean() < 0.5, "but for float32"
        state = env.step(HOVER)[0]
    view.close()
    env.close()


def test_without_opengl_frames_say_how_to_have_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise RendererUnavailableError("There is none.")

    monkeypatch.setattr(gym_env, "ChaseView", missing)
    env = gymnasium.make(IDS[0], observation="state", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    with pytest.raises(
        RendererUnavailableError, match=r"There is none\. render_view='onboard' draws what the drone sees"
    ):
        env.render()
    env.close()


def test_single_environment_is_one_of_the_worlds() -> None:
    env = DroneRaceGymEnv("kidney", observation="state", privileged=True, body_rate_weight=0.01)
    worlds = RaceWorlds("kidney", 1, from_pixels=False)
    observation, _ = env.reset(seed=4)
    worlds.seed(4)
    worlds.reset()
    rng = np.random.default_rng(0)
    for _ in range(15):
        np.testing.assert_array_equal(observation["position"], worlds.privileged()["position"][0].numpy())
        action = rng.uniform(-0.5, 0.5, 4).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        outcome = worlds.step(torch.from_numpy(action).unsqueeze(0))
        assert reward == (outcome.reward_base - 0.01 * outcome.body_rate_norm).item()
        assert info["reward_base"] - 0.01 * info["body_rate_norm"] == pytest.approx(reward, abs=1e-7)
        np.testing.assert_array_equal(info["privileged"]["attitude"], observation["attitude"])
        assert (terminated, truncated, info["crash"]) == (False, False, CrashCause.NONE)


def test_vector_is_what_torchrl_agents_see() -> None:
    env, envs = DroneRaceGymEnv("circle", observation="vector"), make_vec(2, observation="vector")
    (single, _), (batch, _) = env.reset(seed=0), envs.reset(seed=0)
    assert (single.shape, single.dtype, batch.shape) == ((21,), np.float32, (2, 21))
    for observation, num_envs in ((single[None], 1), (batch, 2)):
        expected = DroneRacingEnv("circle", num_envs, from_pixels=False, seed=0).reset()["vector"]
        np.testing.assert_array_equal(observation, expected.numpy())
    assert env.race.worlds.simulator.renderer is None


def test_body_rate_weight_follows_the_reward_weights_unless_given() -> None:
    weights = RewardWeights(body_rate=0.5)
    assert DroneRaceGymEnv(observation="state").race.body_rate_weight == RewardWeights().body_rate
    assert DroneRaceGymEnv(observation="state", weights=weights).race.body_rate_weight == 0.5
    assert DroneRaceGymEnv(observation="state", weights=weights, body_rate_weight=0.0).race.body_rate_weight == 0.0


def test_time_limit_truncates() -> None:
    env = gymnasium.make(IDS[0], observation="state", evaluation=True, episode_steps=5)
    env.reset()
    ends = [env.step(HOVER)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    shorter = gymnasium.make(IDS[0], observation="state", evaluation=True, max_episode_steps=3)
    shorter.reset()
    assert [shorter.step(HOVER)[3] for _ in range(3)] == [False, False, True]


def test_action_that_is_not_finite_ends_the_single_environment() -> None:
    env = DroneRaceGymEnv("circle")
    env.reset(seed=0)
    observation, reward, terminated, _, info = env.step(np.array([0, np.nan, 0, 0], np.float32))
    assert (terminated, reward, info["crash"]) == (True, -4.0, CrashCause.INVALID_ACTION)
    assert env.observation_space.contains(observation)
    env.close()


@pytest.mark.parametrize(
    ("make", "shape", "words"),
    [
        (DroneRaceGymEnv, (4,), r"must be \(4,\): collective"),
        (make_vec, (3, 4), r"must be \(3, 4\), for 3 environment\(s\)"),
    ],
)
def test_wrong_actions_and_steps_before_the_first_reset_are_refused(
    make: Callable, shape: tuple[int, ...], words: str
) -> None:
    env = make(observation="state")
    with pytest.raises(gymnasium.error.ResetNeeded, match="before the first reset"):
        env.step(np.zeros(shape))
    env.reset()
    env.step(np.zeros(shape))
    with pytest.raises(TypeError, match=r"Action of [.\w]+: thrust and body rates are floating-point"):
        env.step(np.zeros(shape, int))
    with pytest.raises(ValueError, match=rf"shape \(2, 4\): {words}"):
        env.step(np.zeros((2, 4)))


def test_actions_of_any_layout_are_taken() -> None:
    """Read-only ones, as JAX gives, and views that run backwards."""
    env = DroneRaceGymEnv("circle", observation="state")
    env.reset()
    action = np.array([0.1, 0.0, 0.0, -0.26], np.float32)
    action.setflags(write=False)
    for each in (action, action[::-1]):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            env.step(each)


@pytest.mark.parametrize("make", [DroneRaceGymEnv, DroneRaceVectorEnv])
@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ({"observation": "image"}, "observation=image: must be one of pixels, pixels_imu, pixels_vector, vector"),
        ({"render_view": "front"}, "render_view=front: must be one of chase, onboard"),
        ({"render_mode": "human"}, "render_mode='human'"),
        ({"body_rate_weight": math.nan}, "body_rate_weight=nan: must be finite"),
        ({"device": "gpu"}, "device='gpu': must be cpu or cuda"),
        ({"device": "cuda:0"}, "must be cpu, where Gymnasium's arrays are"),
    ],
)
def test_wrong_values_are_explained(make: Callable, argument: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(**{"observation": "state", **argument})


@pytest.mark.parametrize("kind", [DroneRaceGymEnv, DroneRaceVectorEnv])
@pytest.mark.parametrize("view", RENDER_VIEWS)
def test_a_closed_environment_draws_no_more(kind: type[gymnasium.Env], view: str) -> None:
    env = kind(track="circle", observation="state", render_mode="rgb_array", renderer="warp", render_view=view)
    env.reset()
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match=r"render\(\) after close\(\)"):
        env.render()


@pytest.mark.parametrize("vector", [False, True])
def test_seeds_reproduce(vector: bool) -> None:
    def fly(seed: int | None) -> np.ndarray:
        arguments = {"observation": "state", "preset": "faithful"}
        env = make_vec(2, **arguments) if vector else gymnasium.make(IDS[0], **arguments)
        observation, _ = env.reset(seed=seed)
        rows = [observation["position"]]
        action = np.tile(HOVER, (2, 1)) if vector else HOVER
        for _ in range(2):
            rows += [env.step(action)[0]["linear_velocity"] for _ in range(2)]
            rows.append(env.reset()[0]["position"])  # the second episode follows from the seed too
        return np.stack(rows)

    first = fly(0)
    np.testing.assert_array_equal(first, fly(0))
    assert not np.allclose(first, fly(1))
    assert not np.allclose(fly(None), fly(None))
    assert not np.allclose(first[0], first[3])


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_torchrl_takes_a_single_environment(observation: str) -> None:
    env = GymEnv(f"dreamer_racing:{IDS[0]}", observation=observation)
    check_env_specs(env)
    flown = env.rollout(3)
    seen = {"observation"} if observation == "vector" else set(OBSERVATIONS[observation])
    assert seen <= set(flown.keys()) and flown["next", "reward"].shape == (3, 1)
    env.close()


def test_videos_play_at_the_control_rate():
    single = gymnasium.make(IDS[0], observation="state", control_rate=25)
    several = gymnasium.make_vec(IDS[0], num_envs=2, observation="state", control_rate=25)
    assert single.unwrapped.metadata["render_fps"] == several.unwrapped.metadata["render_fps"] == 25
    assert gymnasium.make(IDS[0], observation="state").unwrapped.metadata["render_fps"] == 50


# Faults that users of other projects reported, as they would show here; the table is in docs/reliability.md.


NAME = "dreamer_racing/Circle-v0"
ACTION = np.array([[0.3, 0.2, 0.1, 0.5]] * 2, np.float32)


@pytest.fixture
def worlds():
    """Two of them, seen as numbers."""
    made = gymnasium.make_vec(NAME, num_envs=2, observation="vector")
    yield made
    made.close()


@pytest.mark.parametrize("observation", ["pixels", "vector"])
def test_what_was_seen_is_not_overwritten_by_the_next_step(observation: str) -> None:
    """google-deepmind/dm_control#34."""
    env = gymnasium.make(NAME, observation=observation)
    seen = [env.reset(seed=0)[0]]
    copies = [seen[0].copy()]
    for _ in range(3):
        seen.append(env.step(ACTION[0])[0])
        copies.append(seen[-1].copy())
    env.close()
    assert all(np.array_equal(one, copy) for one, copy in zip(seen, copies, strict=True))
    assert not np.array_equal(copies[1], copies[3])  # else nothing could have been noticed


def test_what_torchrl_saw_is_not_overwritten_by_the_next_step() -> None:
    """google-deepmind/dm_control#34, in tensors."""
    env = DroneRacingEnv(track="circle", num_envs=2, from_pixels=True)
    seen, copies, tensordict = [], [], env.reset()
    for _ in range(3):
        seen.append(tensordict["pixels"])
        copies.append(seen[-1].clone())
        tensordict = env.step(tensordict.set("action", torch.from_numpy(ACTION)))["next"].clone(recurse=False)
    env.close()
    assert all(map(torch.equal, seen, copies)) and not torch.equal(copies[0], copies[2])


def test_neighbouring_seeds_share_no_world() -> None:
    """DLR-RM/stable-baselines3#2268."""
    starts = []
    for seed in (0, 1):
        env = DroneRacingEnv(track="circle", num_envs=4, from_pixels=False, seed=seed, start_noise=1.0)
        starts += [tuple(place.tolist()) for place in env.reset()["privileged", "position"]]
        env.close()
    assert len(set(starts)) == 8


def test_float64_flies_as_float32_and_the_caller_s_array_is_left_alone(worlds) -> None:
    """Farama-Foundation/PettingZoo#1000, openai/gym#2188."""
    flown = []
    for kind in (np.float32, np.float64):
        worlds.reset(seed=1)
        given = (10 * ACTION).astype(kind)  # three of four beyond the bounds
        kept = given.copy()
        flown.append(worlds.step(given)[0])
        assert np.array_equal(given, kept)
    worlds.reset(seed=1)
    flown.append(worlds.step(np.clip(10 * ACTION, -1.0, 1.0))[0])
    assert np.array_equal(flown[0], flown[1]) and np.array_equal(flown[0], flown[2])


def test_a_seed_forgets_what_was_flown_before_it(worlds) -> None:
    """google-deepmind/lab#133."""
    begins = []
    for steps in (1, 4):
        worlds.reset(seed=5)
        for _ in range(steps):
            worlds.step(ACTION)
        begins.append(worlds.reset(seed=5)[0])
    assert np.array_equal(*begins)


def test_seeding_does_not_disturb_the_flight() -> None:
    """DLR-RM/stable-baselines3#1481."""
    pytest.importorskip("stable_baselines3")
    from dreamer_racing.envs.sb3_env import DroneRaceVecEnv

    flown = []
    for seeded in (False, True):
        env = DroneRaceVecEnv(track="circle", num_envs=2, observation="vector", seed=3)
        env.reset()
        env.step(ACTION)
        if seeded:
            env.seed(7)
        flown.append(env.step(ACTION)[0])
        env.close()
    assert np.array_equal(*flown)


def test_every_number_of_the_state_tells_something() -> None:
    """google-deepmind/dm_control#23."""
    env = DroneRacingEnv(track="circle", num_envs=8, from_pixels=False, seed=0)
    torch.manual_seed(0)
    seen = env.rollout(60, break_when_any_done=False)["vector"].flatten(0, 1)
    env.close()
    assert (seen.std(0) > 0.01).all()
