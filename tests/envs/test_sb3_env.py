"""The vector environment of Stable-Baselines3: its own checks, its autoreset, and the same race as everywhere else."""

import gymnasium
import numpy as np
import pytest

from dreamer_racing import GYM_ENVIRONMENTS
from dreamer_racing.envs.race.gates import CrashCause

pytest.importorskip("stable_baselines3", reason="needs the extra `sb3`: pip install -e '.[sb3]'")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

from dreamer_racing.envs.sb3_env import DroneRaceVecEnv
from tests.envs.test_gym_env import HOVER

FALL = np.array([-1.0, 0.0, 0.0, 0.0], np.float32)
POLICIES = {"vector": "MlpPolicy", "pixels": "CnnPolicy", "state": "MultiInputPolicy", "both": "MultiInputPolicy"}


def vec_env(num_envs: int = 3, observation: str = "vector", **arguments) -> DroneRaceVecEnv:
    return DroneRaceVecEnv("circle", num_envs, observation, **arguments)


@pytest.mark.parametrize(
    ("name", "observation"),
    [*(("Kidney", each) for each in POLICIES if each != "vector"), *((name, "vector") for name in GYM_ENVIRONMENTS)],
)
@pytest.mark.filterwarnings("error")
def test_checker_finds_nothing(name: str, observation: str) -> None:
    env = gymnasium.make(f"dreamer_racing/{name}-v0", observation=observation, render_mode="rgb_array")
    check_env(env)
    env.close()


@pytest.mark.parametrize("observation", [each for each in POLICIES if each != "state"])  # which "both" has, too
def test_every_observation_trains(observation: str) -> None:
    env = VecMonitor(vec_env(8, observation, episode_steps=6))  # episodes end, and are bootstrapped, within a rollout
    agent = PPO(POLICIES[observation], env, n_steps=10, batch_size=40, n_epochs=1, seed=0, device="cpu")
    agent.learn(160)
    assert agent.num_timesteps == 160
    assert [episode["l"] for episode in agent.ep_info_buffer][:8] == [6] * 8
    returns, lengths = evaluate_policy(agent, env, n_eval_episodes=8, return_episode_rewards=True)
    assert lengths == [6] * 8 and np.isfinite(returns).all()
    env.close()


def test_crash_ends_an_episode_and_begins_the_next_in_the_same_step() -> None:
    env = vec_env(evaluation=True, observation="both", privileged=True)
    start = env.reset()
    actions = np.stack((HOVER, FALL, HOVER))
    for _ in range(60):
        observation, rewards, ended, infos = env.step(actions)
        assert env.observation_space["position"].shape == (3,) and observation["position"].shape == (3, 3)
        if ended.any():
            break
    assert list(ended) == [False, True, False]
    assert (rewards.dtype, rewards[1]) == (np.float32, -4.0)
    assert [info["crash"] for info in infos] == [CrashCause.NONE, CrashCause.GROUND, CrashCause.NONE]
    assert [info["TimeLimit.truncated"] for info in infos] == [False] * 3
    assert ["terminal_observation" in info for info in infos] == [False, True, False]
    last = infos[1]["terminal_observation"]
    assert env.observation_space.contains({**last, "target_gate": np.int64(last["target_gate"])})
    # The last observation is of the ground, the one returned is of the start; the others fly on.
    assert last["position"][2] < 0.3 < start["position"][1, 2]
    np.testing.assert_array_equal(last["position"], infos[1]["privileged"]["position"])
    for name in ("position", "pixels"):
        np.testing.assert_array_equal(observation[name][1], start[name][1])
        assert (observation[name][0] != last[name]).any()
    assert env.reset_infos[1]["crash"] == CrashCause.NONE
    env.close()


def test_out_of_time_is_told_from_a_crash() -> None:
    env = vec_env(2, episode_steps=3)
    env.reset()
    steps = [env.step(np.tile(HOVER, (2, 1)))[2:] for _ in range(4)]
    assert [list(ended) for ended, _ in steps] == [[False, False]] * 2 + [[True, True], [False, False]]
    assert [infos[0]["TimeLimit.truncated"] for _, infos in steps] == [False, False, True, False]
    assert steps[2][1][1]["terminal_observation"].shape == (21,)


def test_it_flies_as_single_environments_do() -> None:
    env, single = vec_env(1, "state"), gymnasium.make("dreamer_racing/Circle-v0", observation="state")
    env.seed(4)
    observation, (expected, _) = env.reset(), single.reset(seed=4)
    rng = np.random.default_rng(0)
    for _ in range(10):
        np.testing.assert_array_equal(observation["position"][0], expected["position"])
        action = rng.uniform(-0.5, 0.5, (1, 4)).astype(np.float32)
        observation, rewards, _, _ = env.step(action)
        expected, reward, *_ = single.step(action[0])
        assert rewards[0] == np.float32(reward)


def test_seeds_reproduce_until_the_next_reset() -> None:
    def starts(seed: int) -> np.ndarray:
        env = vec_env()
        env.seed(seed)
        return np.stack([env.reset(), env.reset()])

    first = starts(0)
    np.testing.assert_array_equal(first, starts(0))
    assert (first[0] != first[1]).any() and (first[0] != starts(1)[0]).any()


def test_frames_and_attributes() -> None:
    env = vec_env(2, render_mode="rgb_array")
    env.reset()
    assert [frame.shape for frame in env.get_images()] == [(256, 256, 3)] * 2
    assert env.get_attr("render_mode", [1]) == ["rgb_array"]
    assert not env.has_attr("no_such_thing")
    with pytest.raises(NotImplementedError, match="set_attr\\('x'\\): the drones of DroneRaceVecEnv share one object"):
        env.set_attr("x", 1)
    with pytest.raises(NotImplementedError, match="env_method\\('close'\\)"):
        env.env_method("close")
    with pytest.raises(ValueError, match=r"shape \(3, 4\): must be \(2, 4\), for 2 environment\(s\)"):
        env.step(np.zeros((3, 4)))
    env.close()
    env.close()


@pytest.mark.slow
def test_gymnasium_environments_live_in_other_processes() -> None:
    env = make_vec_env(
        "dreamer_racing:dreamer_racing/Circle-v0",  # the part before the colon is imported there
        n_envs=1,
        env_kwargs={"observation": "vector"},
        vec_env_cls=SubprocVecEnv,
        vec_env_kwargs={"start_method": "spawn"},
    )
    assert env.reset().shape == (1, 21)
    _, rewards, *_ = env.step(HOVER[None])
    assert np.isfinite(rewards).all()
    env.close()


def test_videos_play_at_the_control_rate() -> None:
    assert vec_env(1, "state", control_rate=25).metadata["render_fps"] == 25
