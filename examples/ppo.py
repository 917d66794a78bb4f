"""TorchRL's PPO on the Circle track, with the 21 numbers of `vector` as observation: `python examples/ppo.py`."""

import argparse
import math

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.evaluation.evaluate import evaluate
from dreamer_racing.modules.heads import clipped_mean

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=1_500_000)
arguments = parser.parse_args()
if arguments.env_steps < 1:
    parser.error(f"--env-steps {arguments.env_steps}: must be at least 1")
torch.manual_seed(0)
drones, steps, epochs, minibatches = 512, 32, 5, 8
rollouts = math.ceil(arguments.env_steps / (drones * steps))

vector = {"from_pixels": False, "privileged": False}
race = DroneRacingEnv("circle", num_envs=drones, episode_steps=300, seed=0, **vector)  # short: starts are the hard part
race.body_rate_weight = 0.01  # b₂ of the reward: whoever turns less flies more safely
env = TransformedEnv(race, Compose(RewardSum(), RewardScaling(0.0, 0.1), InitTracker()))  # `episode_reward` as it was
network = {"num_cells": [128, 128], "activation_class": nn.Tanh}
normal = nn.Sequential(MLP(21, 4, **network), AddStateIndependentNormalScale(4, init_value=math.log(0.6)))
normal[0][-1].weight.data *= 0.01  # initial actions are near 0: slightly more than hover thrust
actor = ProbabilisticActor(
    TensorDictModule(normal, ["vector"], ["loc", "scale"]),
    in_keys=["loc", "scale"],
    distribution_class=IndependentNormal,  # the race clips actions to [-1, 1]
    return_log_prob=True,
)
critic = ValueOperator(MLP(21, 1, **network), in_keys=["vector"])
advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
loss = ClipPPOLoss(
    actor, critic, entropy_bonus=False, critic_coeff=0.5, loss_critic_type="l2", normalize_advantage=True
)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, eps=1e-5)
schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=rollouts)
collector = Collector(env, actor, frames_per_batch=drones * steps, total_frames=drones * steps * rollouts)

episodes = []
for index, rollout in enumerate(collector):  # (512, 32)
    with torch.no_grad():
        advantage(rollout)
    records = rollout.select(*loss.in_keys, "advantage", "value_target").reshape(-1)
    for _ in range(epochs):
        for chosen in torch.randperm(len(records)).tensor_split(minibatches):
            losses = loss(records[chosen])
            (losses["loss_objective"] + losses["loss_critic"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
            optimizer.zero_grad()
    schedule.step()
    episodes.append(rollout["next"][rollout["next", "done"].squeeze(-1)])
    if (index + 1) % 4 == 0 or index + 1 == rollouts:
        ended, episodes = torch.cat(episodes), []
        gates = ended["race", "gates_passed"].float().mean()
        flown = drones * steps * (index + 1)
        print(f"{flown} steps: return {ended['episode_reward'].mean():.1f}, {gates:.1f} gates an episode", flush=True)
collector.shutdown()

# Three laps from 100 noisy starts, with sampled actions and with the mean of clipped actions.
mean = TensorDictModule(clipped_mean, ["loc", "scale"], ["action"])
flyers = {"sampled": actor, "clipped mean": TensorDictSequential(actor[0], mean)}
for name, flyer in flyers.items():
    race = DroneRacingEnv("circle", num_envs=100, from_pixels=False, evaluation=True, start_noise=1.0, seed=1)
    flights = evaluate(race, flyer, episodes=100, exploration_type=ExplorationType.RANDOM)
    finished, lap = 100 * flights.success_rate, flights.lap_time_mean or math.nan
    print(f"{name} actions: three laps from {finished:.0f} of 100 noisy starts, {lap:.2f} s a lap")
