"""Gymnasium's vector environment: every autoreset mode, resets in parts, and TorchRL around it."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs.gym_env import OBSERVATIONS
from dreamer_racing.envs.gym_vector_env import DroneRaceVectorEnv
from dreamer_racing.envs.race.gates import CrashCause
from tests.envs.test_gym_env import HOVER, IDS, INFO, make_vec

CLIMB = np.array([0.5, 0.0, 0.0, 0.0], np.float32)
HOVERING = np.tile(HOVER, (3, 1))
POISONED = np.stack((HOVER, np.full(4, np.nan, np.float32), HOVER))  # the second one crashes: not finite


def test_a_partial_reset_needs_a_full_reset_first() -> None:
    envs = make_vec(observation="state", autoreset_mode="Disabled")
    part = {"reset_mask": np.array([True, False, False])}
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"covers only 1 of 3 episodes: first reset all of them"):
        envs.reset(seed=0, options=part)
    with pytest.raises(gymnasium.error.ResetNeeded, match="before the first reset"):
        envs.step(np.zeros((3, 4)))
    envs.reset(seed=0, options={"reset_mask": np.ones(3, bool)})  # all of them by a mask
    envs.reset(options=part)
    envs.step(np.zeros((3, 4)))


def test_vector_spaces_infos_and_frames() -> None:
    envs = make_vec(observation="both", privileged=True, render_mode="rgb_array")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.spec.id == "dreamer_racing/Circle-v0"
    observation, info = envs.reset(seed=0)
    assert envs.observation_space.contains(observation)
    assert observation["pixels"].shape == (3, 64, 64, 3)
    for name in INFO:
        assert info[name].shape == info["_" + name].shape == (3,)
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert envs.observation_space.contains(observation)
    assert reward.shape == terminated.shape == truncated.shape == (3,)
    assert list(info["crash"]) == [CrashCause.NONE] * 3
    np.testing.assert_array_equal(info["privileged"]["target_gate"], observation["target_gate"])
    assert [frame.shape for frame in envs.render()] == [(256, 256, 3)] * 3
    envs.close()
    envs.close()


def test_frames_look_as_what_is_seen() -> None:
    """With light, colours, lens and tilt of each drone: nearer to its own image than to another's."""
    envs = make_vec(observation="pixels", render_mode="rgb_array", render_view="onboard", looks="randomised")
    seen, _ = envs.reset(seed=0)
    frames = np.stack([frame.reshape(64, 4, 64, 4, 3).mean((1, 3)) for frame in envs.render()])
    apart = np.abs(frames[:, None] - seen[None].astype(float)).mean((2, 3, 4))  # (3, 3), frame by image
    envs.close()
    assert (apart.argmin(1) == np.arange(3)).all(), apart
    assert apart.diagonal().max() < 0.5 * apart[~np.eye(3, dtype=bool)].min(), apart


def test_autoreset_begins_an_episode_in_the_step_after_its_end() -> None:
    envs = make_vec(observation="both", evaluation=True, max_episode_steps=4)
    start, _ = envs.reset(seed=0)
    _, reward, terminated, _, info = envs.step(POISONED)
    assert list(terminated) == [False, True, False]
    assert list(info["crash"]) == [CrashCause.NONE, CrashCause.INVALID_ACTION, CrashCause.NONE]
    assert reward[1] == -4.0

    observation, reward, terminated, _, info = envs.step(POISONED)  # its action does not matter now
    assert not terminated.any()
    assert reward[1] == 0.0
    assert info["crash"][1] == CrashCause.NONE
    np.testing.assert_array_equal(observation["position"][1], start["position"][1])
    np.testing.assert_array_equal(observation["pixels"][1], start["pixels"][1])

    ends = [envs.step(HOVERING)[2:5] for _ in range(4)]
    # two steps more end the undisturbed ones; the other has had an episode's first observation in between
    assert [list(end[1]) for end in ends] == [
        [False, False, False],
        [True, False, True],
        [False, False, False],
        [False, True, False],
    ]
    assert not any(end[0].any() for end in ends)
    envs.close()


def test_reset_forgets_pending_autoresets() -> None:
    envs = make_vec(observation="state", evaluation=True)
    envs.reset()
    envs.step(np.full((3, 4), np.nan))
    envs.reset()
    observation, *_ = envs.step(np.tile(CLIMB, (3, 1)))
    assert (observation["linear_velocity"][:, 2] > 0.0).all()


@pytest.mark.parametrize(
    ("mode", "kind"),
    [(None, DroneRaceVectorEnv), ("vector_entry_point", DroneRaceVectorEnv), ("sync", gymnasium.vector.SyncVectorEnv)],
)
def test_every_mode_of_make_vec(mode: str | None, kind: type) -> None:
    envs = gymnasium.make_vec(IDS[0], num_envs=2, vectorization_mode=mode, observation="vector")
    assert isinstance(envs, kind) and envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.reset(seed=0)[0].shape == (2, 21)
    observations, rewards, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert observations.shape == (2, 21) and rewards.shape == terminated.shape == truncated.shape == (2,)
    assert list(info["crash"]) == [CrashCause.NONE, CrashCause.NONE]
    envs.close()


@pytest.mark.parametrize("observation", ["vector", "both"])
def test_in_mode_same_step_the_last_observation_is_in_info(observation: str) -> None:
    envs = make_vec(observation=observation, autoreset_mode="SameStep", evaluation=True)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    start, _ = envs.reset(seed=0)
    last, rewards, terminated, truncated, info = make_and_poison(envs)
    assert list(terminated) == [False, True, False] and not truncated.any() and rewards[1] == -4.0
    assert list(info["_final_obs"]) == list(info["_final_info"]) == [False, True, False]
    assert info["final_info"]["crash"][1] == CrashCause.INVALID_ACTION and info["crash"][1] == CrashCause.NONE
    assert info["final_obs"][0] is None and info["final_obs"][2] is None
    of = (lambda seen: seen) if observation == "vector" else (lambda seen: seen["position"])
    assert not np.allclose(of(last)[0], of(start)[0])  # flies on
    np.testing.assert_allclose(of(last)[1], of(start)[1], atol=1e-6)  # at the start again: evaluation
    assert not np.allclose(of(info["final_obs"][1]), of(start)[1], atol=1e-6)
    assert "final_obs" not in envs.step(HOVERING)[-1]
    envs.close()


def test_in_mode_same_step_the_last_info_is_of_those_that_ended() -> None:
    """As Gymnasium's own vector environment has it, in dictionaries within, too."""
    envs = make_vec(observation="vector", autoreset_mode="SameStep", privileged=True)
    envs.reset(seed=0)
    info = make_and_poison(envs)[-1]
    final = info["final_info"]
    for told, there in ((final, [False, True, False]), (info, [True, True, True])):
        for entries in (told, told["privileged"]):
            masks = [mask for name, mask in entries.items() if name.startswith("_") and "final" not in name]
            assert len(masks) > 4 and all(list(mask) == there for mask in masks)
    envs.close()


@pytest.mark.parametrize("observation", ["pixels", "both"])
def test_in_mode_same_step_only_the_images_of_new_episodes_are_drawn_again(
    observation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    envs = make_vec(observation=observation, autoreset_mode="SameStep", evaluation=True)
    images = (lambda seen: seen) if observation == "pixels" else (lambda seen: seen["pixels"])
    start, render, drawn = images(envs.reset(seed=0)[0]), envs.race.worlds.render, []

    def noted(mask: torch.Tensor | None = None) -> torch.Tensor:
        drawn.append(render(mask).clone())
        return drawn[-1].clone()

    monkeypatch.setattr(envs.race.worlds, "render", noted)
    last, *_, info = make_and_poison(envs)
    assert [len(batch) for batch in drawn] == [3, 3, 3, 3, 1]
    np.testing.assert_array_equal(images(info["final_obs"][1]), drawn[3][1])
    np.testing.assert_array_equal(images(last)[[0, 2]], drawn[3][[0, 2]])
    np.testing.assert_array_equal(images(last)[1], drawn[4][0])
    np.testing.assert_array_equal(images(last)[1], start[1])  # at the start again: evaluation
    envs.close()


def make_and_poison(envs: DroneRaceVectorEnv) -> tuple:
    """Fly a little, then let the second one crash."""
    for _ in range(3):
        envs.step(HOVERING + CLIMB)
    return envs.step(POISONED)


def test_in_mode_disabled_episodes_begin_where_they_are_reset() -> None:
    envs = make_vec(observation="vector", autoreset_mode=AutoresetMode.DISABLED, evaluation=True)
    start, _ = envs.reset(seed=0)
    last, _, terminated, _, _ = make_and_poison(envs)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"Episodes \[1\] have ended"):
        envs.step(HOVERING)
    observation, info = envs.reset(options={"reset_mask": terminated})
    np.testing.assert_allclose(observation[1], start[1], atol=1e-6)
    np.testing.assert_array_equal(observation[[0, 2]], last[[0, 2]])  # they did not notice
    assert list(info["_crash"]) == [False, True, False]
    assert not envs.step(HOVERING)[2].any()
    for mask in (np.zeros(3, bool), np.ones(2, bool), [True, True, True]):
        with pytest.raises(ValueError, match="reset_mask="):
            envs.reset(options={"reset_mask": mask})
    envs.close()


def test_unknown_modes_and_lengths_or_seeds_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="autoreset_mode='never': choose one of 'NextStep', 'SameStep', 'Disabled'"):
        make_vec(autoreset_mode="never")
    with pytest.raises(ValueError, match="max_episode_steps='300': must be a whole number"):
        make_vec(max_episode_steps="300", episode_steps=200)
    with pytest.raises(ValueError, match="seed=\\[1, 2, 3\\]: must be one number"):
        make_vec(observation="state").reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    ("observation", "mode"),
    [*((each, "SameStep") for each in OBSERVATIONS), ("vector", "Disabled"), ("both", "Disabled")],
)
def test_torchrl_takes_the_vector_environment(observation: str, mode: str) -> None:
    envs = make_vec(observation=observation, autoreset_mode=mode, max_episode_steps=4)
    env = GymWrapper(envs, categorical_action_encoding=True)  # which is of `target_gate`, too
    check_env_specs(env)
    flown = env.rollout(10, break_when_any_done=False)
    assert flown.batch_size == (3, 10)
    assert flown["next", "truncated"][..., 0].nonzero()[:, 1].tolist() == [3, 7] * 3  # and flies on from new starts
    keys = {"pixels": "observation", "vector": "observation", "pixels_imu": "imu", "pixels_vector": "vector"}
    key = keys.get(observation, "position")
    assert (flown[key][:, 4] != flown["next", key][:, 3]).flatten(1).any(1).all()
    env.close()


def test_torchrl_flies_one_process_for_each_environment() -> None:
    env = GymEnv(f"dreamer_racing:{IDS[0]}", num_envs=2, observation="both", categorical_action_encoding=True)
    check_env_specs(env)
    flown = env.rollout(3)
    assert flown.batch_size == (2, 3) and flown["pixels"].shape == (2, 3, 64, 64, 3)
    assert (flown["next", "crash"] == CrashCause.NONE).all()
    env.close()
