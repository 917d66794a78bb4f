"""TorchRL's TD3 on the Circle track, with the 21 numbers of `vector` as observation: `python examples/td3.py`."""

import argparse

import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, InitTracker, RewardSum, TransformedEnv
from torchrl.modules import MLP, Actor, AdditiveGaussianModule, ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

from dreamer_racing.envs import DroneRacingEnv

parser = argparse.ArgumentParser()
parser.add_argument("--rollouts", type=int, default=1000, help="rollouts of 512 steps: 64 drones, 8 steps each")
parser.add_argument("--random-rollouts", type=int, default=20, help="random ones before the first update")
arguments = parser.parse_args()
torch.manual_seed(0)

race = DroneRacingEnv("circle", num_envs=64, from_pixels=False, privileged=False, seed=0)
env = TransformedEnv(race, Compose(RewardSum(), InitTracker()))  # adds `episode_reward` and `is_init`
network = {"num_cells": [128, 128], "activation_class": nn.ReLU}
actor = Actor(nn.Sequential(MLP(21, 4, **network), nn.Tanh()), in_keys=["vector"])
critic = ValueOperator(MLP(21 + 4, 1, **network), in_keys=["vector", "action"])
noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.1, annealing_num_steps=arguments.rollouts)
policy = TensorDictSequential(actor, noise)
steps = {"total_frames": 512 * arguments.rollouts, "init_random_frames": 512 * arguments.random_rollouts}
collector = Collector(env, policy, frames_per_batch=512, **steps)
loss = TD3Loss(actor, critic, action_spec=env.action_spec_unbatched)
loss.make_value_estimator(gamma=0.98)
targets = SoftUpdate(loss, tau=0.005)
actor_optimizer = torch.optim.Adam(loss.actor_network_params.flatten_keys().values(), lr=5e-4)
critic_optimizer = torch.optim.Adam(loss.qvalue_network_params.flatten_keys().values(), lr=5e-4)
replay = ReplayBuffer(storage=LazyTensorStorage(200_000), batch_size=256)

episodes = []
for index, rollout in enumerate(collector):  # (64, 8)
    replay.extend(rollout.select(*loss.in_keys).reshape(-1))
    for update in range(32 if index >= arguments.random_rollouts else 0):
        batch = replay.sample()
        loss.value_loss(batch)[0].backward()
        critic_optimizer.step()
        critic_optimizer.zero_grad()
        if update % 2 == 1:
            loss.actor_loss(batch)[0].backward()
            actor_optimizer.step()
            actor_optimizer.zero_grad()
            targets.step()
    noise.step()
    episodes.append(rollout["next"][rollout["next", "done"].squeeze(-1)])
    if (index + 1) % 50 == 0 or index + 1 == arguments.rollouts:
        ended, episodes = torch.cat(episodes), []
        gates = ended["race", "gates_passed"].float().mean()
        print(f"{512 * (index + 1)} steps: return {ended['episode_reward'].mean():.1f}, {gates:.1f} gates an episode")
collector.shutdown()
