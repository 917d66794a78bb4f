"""PPO of Stable-Baselines3 on the Circle track: `python examples/sb3.py`, from images with `--observation pixels`."""

import argparse
from statistics import fmean
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from dreamer_racing.envs.sb3_env import DroneRaceVecEnv
from dreamer_racing.modules.heads import clipped_mean

POLICIES = {"vector": "MlpPolicy", "pixels": "CnnPolicy", "state": "MultiInputPolicy", "both": "MultiInputPolicy"}

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=1_500_000)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--observation", choices=POLICIES, default="vector")
arguments = parser.parse_args()


class Progress(BaseCallback):
    """Prints mean return and gates of the latest hundred episodes."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        latest = self.model.ep_info_buffer
        if latest:
            reward, gates = (fmean(episode[name] for episode in latest) for name in ("r", "gates_passed"))
            print(f"{self.num_timesteps} steps: return {reward:.1f}, {gates:.1f} gates an episode", flush=True)


worlds = {"episode_steps": 300, "body_rate_weight": 0.01}  # many starts, which are the hard part, and a steady flight
drones = DroneRaceVecEnv("circle", arguments.num_envs, arguments.observation, **worlds)
drones = VecMonitor(drones, info_keywords=("gates_passed",))
drones = VecNormalize(drones, norm_obs=False, gamma=0.99)  # rewards only: observations are of order one
agent = PPO(
    POLICIES[arguments.observation],
    drones,
    learning_rate=lambda left: 1e-3 * left,
    n_steps=64,
    batch_size=2048,
    n_epochs=5,
    gamma=0.99,
    policy_kwargs={"net_arch": [128, 128], "log_std_init": -0.5},
    seed=0,
)
agent.learn(arguments.env_steps, Progress())
drones.close()


class ClippedMeanActions:
    """The agent with the mean of clipped actions; `deterministic=True` would give the unclipped normal's mean."""

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        """Return actions and state, as `PPO.predict` does."""
        with torch.no_grad():
            normal = agent.policy.get_distribution(agent.policy.obs_to_tensor(observation)[0]).distribution
            return clipped_mean(normal.mean, normal.stddev).cpu().numpy(), state


def race(flyer: Any) -> str:
    """Fly three laps from 100 noisy starts; return the result as text."""
    laps, finished = [], []

    def note(step: dict[str, Any], _: dict[str, Any]) -> None:
        """Record a drone's lap times and finish from the evaluation's local variables."""
        if step["info"]["lap_time"]:
            laps.append(step["info"]["lap_time"])
        if step["done"]:
            finished.append(step["info"]["finished"])

    drones = DroneRaceVecEnv("circle", 100, arguments.observation, evaluation=True, start_noise=1.0, seed=1)
    evaluate_policy(flyer, VecMonitor(drones), n_eval_episodes=100, deterministic=False, callback=note)
    drones.close()
    return f"three laps from {sum(finished)} of 100 noisy starts, {fmean(laps or [float('nan')]):.2f} s a lap"


print(f"sampled actions: {race(agent)}")
print(f"clipped mean actions: {race(ClippedMeanActions())}")
