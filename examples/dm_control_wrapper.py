"""Collect episodes of the race as a dm_control environment with TorchRL: `python examples/dm_control_wrapper.py`."""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import CatTensors, Compose, DMControlWrapper, DoubleToFloat, InitTracker, RewardSum, TransformedEnv
from torchrl.modules import MLP

from dreamer_racing.envs import load

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=2000)
arguments = parser.parse_args()
torch.manual_seed(0)

race = DMControlWrapper(load("circle", random=0))
rollout = race.rollout(1000)  # random actions, until the drone crashes
print(f"{len(rollout)} steps, crashed: {rollout['next', 'terminated'][-1].item()}")
print({name: tuple(value.shape) for name, value in rollout["next"].items()})

# dm_control's observations are separate float64 entries; networks need one float32 vector.
state = ["position", "attitude", "linear_velocity", "body_rates"]
transforms = Compose(DoubleToFloat(), CatTensors(state, out_key="observation"), RewardSum(), InitTracker())
policy = TensorDictModule(nn.Sequential(MLP(13, 4, num_cells=[64, 64]), nn.Tanh()), ["observation"], ["action"])
collector = Collector(TransformedEnv(race, transforms), policy, frames_per_batch=500, total_frames=arguments.env_steps)
for batch in collector:  # (500,), consecutive episodes
    ended = batch["next"][batch["next", "done"].squeeze(-1)]
    print(f"{len(ended)} episodes, returns {[round(value, 1) for value in ended['episode_reward'].flatten().tolist()]}")
collector.shutdown()
