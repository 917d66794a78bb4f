"""Environments for evaluation, with the recurrent state that a policy needs.

Shapes: N environments.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from tensordict import TensorDictBase

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.evaluate import Evaluation, evaluate
from dreamer_racing.learners.learner import Policy

OF_SAMPLES = 2**32
"""Added to the seed of the worlds for the policy's samples, which would else be the numbers of the starts."""


def device_of(policy: Policy) -> torch.device:
    """Return the device of a policy; the CPU if it has no parameters."""
    return next(cast(torch.nn.Module, policy).parameters(), torch.zeros(())).device


def act(policy: Policy, tensordict: TensorDictBase) -> TensorDictBase:
    """Run the policy on its own device and move the result to the environment's device (the CPU if it has none)."""
    return policy(tensordict.to(device_of(policy))).to(tensordict.device or "cpu")


class Course:
    """Environments in which a policy can be evaluated repeatedly.

    Every evaluation has the same starts, drones and looks in the first episode of each environment. If ``num_envs`` is
    less than ``episodes``, those of later episodes depend on the episodes before. The policy draws the same samples,
    too; torch's global generator is left as it was.

    Args:
        policy: the policy, on any device.
        worlds: arguments of ``DroneRacingEnv``: track, preset, renderer, camera, seed (default 0), device (default: the
            CPU) ...
        episodes: E, number of episodes per evaluation.
        num_envs: N, number of parallel environments, at most E; None: one for each episode.
    """

    def __init__(self, policy: Policy, worlds: Mapping[str, Any], episodes: int, num_envs: int | None = None) -> None:
        worlds = {"seed": 0, **worlds}
        num_envs = min(num_envs or episodes, episodes)
        self.base = DroneRacingEnv(num_envs=num_envs, evaluation=True, **worlds)
        self._policy, self._episodes = policy, episodes
        self._seed, self._device = worlds["seed"], device_of(policy)
        self._env = with_memory(self.base, policy.make_primer())

    def evaluate(self, deterministic: bool = True, **recording: Any) -> Evaluation:
        """Run the episodes; ``recording`` are arguments of ``evaluate``."""
        self._policy.deterministic = deterministic
        self.base.worlds.seed(self._seed)
        devices, is_seeded = [self._device] if self._device.type == "cuda" else [], self._seed is not None
        with torch.random.fork_rng(devices, enabled=is_seeded):
            if is_seeded:
                torch.manual_seed(self._seed + OF_SAMPLES)
            return evaluate(self._env, lambda tensordict: act(self._policy, tensordict), self._episodes, **recording)

    def close(self) -> None:
        """Close the simulators."""
        self._env.close(raise_if_closed=False)
