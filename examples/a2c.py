"""TorchRL's A2C on the Circle track, with the 21 numbers of `vector` as observation: `python examples/a2c.py`."""

import argparse

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import A2CLoss
from torchrl.objectives.value import GAE

from dreamer_racing.envs import DroneRacingEnv

parser = argparse.ArgumentParser()
parser.add_argument("--rollouts", type=int, default=4000, help="rollouts of 1024 steps: 64 drones, 16 steps each")
arguments = parser.parse_args()
torch.manual_seed(0)

race = DroneRacingEnv("circle", num_envs=64, from_pixels=False, privileged=False, seed=0)
env = TransformedEnv(race, Compose(RewardSum(), InitTracker()))  # adds `episode_reward` and `is_init`
network = {"num_cells": [64, 64], "activation_class": nn.Tanh}
normal = nn.Sequential(MLP(21, 4, **network), AddStateIndependentNormalScale(4))
actor = ProbabilisticActor(
    TensorDictModule(normal, ["vector"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)
critic = ValueOperator(MLP(21, 1, **network), in_keys=["vector"])
advantage = GAE(gamma=0.98, lmbda=0.95, value_network=critic, average_gae=True)
loss = A2CLoss(actor, critic, entropy_coeff=0.0)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
collector = Collector(env, actor, frames_per_batch=1024, total_frames=1024 * arguments.rollouts)

episodes = []
for index, rollout in enumerate(collector):  # (64, 16)
    with torch.no_grad():
        advantage(rollout)
    losses = loss(rollout)
    (losses["loss_objective"] + losses["loss_critic"]).backward()
    nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
    optimizer.step()
    optimizer.zero_grad()
    episodes.append(rollout["next"][rollout["next", "done"].squeeze(-1)])
    if (index + 1) % 200 == 0 or index + 1 == arguments.rollouts:
        ended, episodes = torch.cat(episodes), []
        gates = ended["race", "gates_passed"].float().mean()
        print(f"{1024 * (index + 1)} steps: return {ended['episode_reward'].mean():.1f}, {gates:.1f} gates an episode")
collector.shutdown()
