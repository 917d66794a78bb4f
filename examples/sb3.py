"""PPO of Stable-Baselines3 on the Circle track: `python examples/sb3.py`, from images with `--observation pixels`."""

import argparse

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import dreamer_racing  # noqa: F401 - registers the Gymnasium environments
from dreamer_racing.envs.sb3_env import DroneRaceVecEnv

POLICIES = {"vector": "MlpPolicy", "pixels": "CnnPolicy", "state": "MultiInputPolicy", "both": "MultiInputPolicy"}

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=1_000_000)
parser.add_argument("--observation", choices=POLICIES, default="vector")
arguments = parser.parse_args()

drones = VecMonitor(DroneRaceVecEnv("circle", num_envs=64, observation=arguments.observation))
agent = PPO(POLICIES[arguments.observation], drones, n_steps=32, batch_size=512, gamma=0.98, seed=0, verbose=1)
agent.learn(arguments.env_steps)
drones.close()

# The same agent in a single Gymnasium environment: from the start, at rest, until it crashes or has flown its laps.
race = gymnasium.make("dreamer_racing/Circle-v0", observation=arguments.observation, evaluation=True)
observation, info = race.reset(seed=0)
ended = False
while not ended:
    action, _ = agent.predict(observation, deterministic=True)
    observation, reward, terminated, truncated, info = race.step(action)
    ended = terminated or truncated
race.close()
print(f"gates passed: {info['gates_passed']}, finished: {info['finished']}, crash: {info['crash']}")
