"""PPO in one file in the style of CleanRL, with a Gymnasium vector environment: `python examples/cleanrl.py`."""

import argparse
import math

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import nn
from torch.distributions import Normal

from dreamer_racing.modules.heads import clipped_mean

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=1_500_000)
parser.add_argument("--num-envs", type=int, default=256)
parser.add_argument("--episode-steps", type=int, default=300, help="short episodes practise the start more often")
parser.add_argument("--rollout-steps", type=int, default=64)
parser.add_argument("--learning-rate", type=float, default=1e-3, help="initial value; decays to 0")
parser.add_argument("--epochs", type=int, default=5)
parser.add_argument("--minibatches", type=int, default=8)
parser.add_argument("--gamma", type=float, default=0.99)
parser.add_argument("--lambda", type=float, default=0.95, dest="lambda_")
parser.add_argument("--clip", type=float, default=0.2)
parser.add_argument("--reward-scale", type=float, default=0.1)
parser.add_argument("--body-rate-weight", type=float, default=0.01, help="penalty in the reward, for a steadier flight")
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
torch.manual_seed(arguments.seed)

CIRCLE = {"id": "dreamer_racing:dreamer_racing/Circle-v0", "observation": "vector"}


def layer(inputs: int, outputs: int, scale: float = math.sqrt(2.0)) -> nn.Linear:
    """Return a linear layer with orthogonal weights and zero bias."""
    linear = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(linear.weight, scale)
    nn.init.zeros_(linear.bias)
    return linear


def mlp(outputs: int, scale: float) -> nn.Sequential:
    """Return an MLP with two hidden layers and an output layer of the given scale."""
    return nn.Sequential(layer(21, 128), nn.Tanh(), layer(128, 128), nn.Tanh(), layer(128, outputs, scale))


class Agent(nn.Module):
    """A policy with normally distributed actions of state-independent standard deviation, and a critic."""

    def __init__(self) -> None:
        super().__init__()
        self.mean, self.critic = mlp(4, 0.01), mlp(1, 1.0)
        self.log_std = nn.Parameter(torch.full((4,), -0.5))

    def policy(self, observation: torch.Tensor) -> Normal:
        """Return the distribution of actions (..., 4) for observations (..., 21)."""
        return Normal(self.mean(observation), self.log_std.exp())

    def value(self, observation: torch.Tensor) -> torch.Tensor:
        """Return the values (...) of observations (..., 21), in units of the scaled reward."""
        return self.critic(observation).squeeze(-1)


worlds = {"max_episode_steps": arguments.episode_steps, "body_rate_weight": arguments.body_rate_weight}
envs = gymnasium.make_vec(**CIRCLE, num_envs=arguments.num_envs, **worlds)
envs = RecordEpisodeStatistics(envs)
agent = Agent()
optimizer = torch.optim.Adam(agent.parameters(), lr=arguments.learning_rate, eps=1e-5)
shape = arguments.rollout_steps, arguments.num_envs  # (T, N)
observations = torch.zeros(shape[0] + 1, shape[1], 21)
actions, log_probs = torch.zeros(*shape, 4), torch.zeros(shape)
rewards, terminated, truncated, flown = (torch.zeros(shape) for _ in range(4))

observations[-1] = torch.from_numpy(envs.reset(seed=arguments.seed)[0])
begins = torch.zeros(arguments.num_envs)  # 1 where the last step ended an episode, so that the next one only resets
updates = -(-arguments.env_steps // (shape[0] * shape[1]))
returns, gates = [], []
for update in range(1, updates + 1):
    optimizer.param_groups[0]["lr"] = arguments.learning_rate * (1.0 - (update - 1) / updates)
    observations[0] = observations[-1]
    for step in range(shape[0]):
        with torch.no_grad():
            policy = agent.policy(observations[step])
            actions[step] = policy.sample()
            log_probs[step] = policy.log_prob(actions[step]).sum(-1)
        seen, reward, crashed, stopped, infos = envs.step(actions[step].numpy())
        flown[step] = 1.0 - begins
        observations[step + 1], rewards[step] = (
            torch.from_numpy(seen),
            torch.from_numpy(reward) * arguments.reward_scale,
        )
        terminated[step], truncated[step] = torch.from_numpy(crashed), torch.from_numpy(stopped)
        begins = terminated[step] + truncated[step]
        if (ended := crashed | stopped).any():
            returns.append(infos["episode"]["r"][ended])
            gates.append(infos["gates_passed"][ended])

    # Advantages. An episode's last observation is available, so that a truncated episode bootstraps from its value.
    with torch.no_grad():
        values = agent.value(observations)  # (T + 1, N)
        errors = rewards + arguments.gamma * values[1:] * (1.0 - terminated) - values[:-1]
        going_on = arguments.gamma * arguments.lambda_ * (1.0 - terminated) * (1.0 - truncated)
        advantages, advantage = torch.zeros(shape), torch.zeros(arguments.num_envs)
        for step in reversed(range(shape[0])):
            advantages[step] = advantage = errors[step] + going_on[step] * advantage
        targets = advantages + values[:-1]

    rows = flown.flatten().nonzero().squeeze(-1)  # without the steps whose action was ignored
    batch = [part.flatten(0, 1)[rows] for part in (observations[:-1], actions, log_probs, advantages, targets)]
    for _ in range(arguments.epochs):
        for chosen in torch.randperm(len(rows)).tensor_split(arguments.minibatches):
            seen, action, log_prob, advantage, target = (part[chosen] for part in batch)
            ratio = (agent.policy(seen).log_prob(action).sum(-1) - log_prob).exp()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            clipped = ratio.clamp(1.0 - arguments.clip, 1.0 + arguments.clip)
            actor_loss = -torch.min(advantage * ratio, advantage * clipped).mean()
            critic_loss = 0.5 * (agent.value(seen) - target).square().mean()
            optimizer.zero_grad()
            (actor_loss + critic_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()

    if (update % 4 == 0 or update == updates) and returns:
        mean_return, mean_gates = np.concatenate(returns).mean(), np.concatenate(gates).mean()
        print(
            f"{update * shape[0] * shape[1]} steps: return {mean_return:.1f}, {mean_gates:.1f} gates an episode",
            flush=True,
        )
        returns, gates = [], []
envs.close()


def race(deterministic: bool) -> str:
    """Fly three laps from 100 noisy starts with sampled actions or the mean of clipped actions; return the result."""
    envs = gymnasium.make_vec(**CIRCLE, num_envs=100, evaluation=True, start_noise=1.0)
    seen, _ = envs.reset(seed=1)
    flying, finished, laps = np.ones(100, bool), 0, []
    while flying.any():
        with torch.no_grad():
            policy = agent.policy(torch.from_numpy(seen))
            action = clipped_mean(policy.mean, policy.stddev) if deterministic else policy.sample()
        seen, _, crashed, stopped, infos = envs.step(action.numpy())
        laps += infos["lap_time"][flying & (infos["lap_time"] > 0)].tolist()
        finished += (flying & infos["finished"]).sum()
        flying &= ~(crashed | stopped)
    envs.close()
    return f"three laps from {finished} of 100 noisy starts, {np.mean(laps or np.nan):.2f} s a lap"


print(f"sampled actions: {race(deterministic=False)}")
print(f"clipped mean actions: {race(deterministic=True)}")
