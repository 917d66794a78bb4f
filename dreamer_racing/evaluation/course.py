"""Where a policy is flown: worlds to evaluate in, with what the policy needs beside observations.

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


def act(policy: Policy, tensordict: TensorDictBase) -> TensorDictBase:
    """Act wherever the policy lives, with worlds that live where their data are: on the CPU, if those do not say."""
    weight = next(cast(torch.nn.Module, policy).parameters(), torch.zeros(()))
    return policy(tensordict.to(weight.device)).to(tensordict.device or "cpu")


class Course:
    """Worlds to evaluate a policy in, as often as wanted.

    Each time it meets the same starts, drones and looks in the first episode of every world; in later ones, where
    ``num_envs`` makes worlds fewer than episodes, they depend on how the episodes before went. What a policy samples
    comes from torch's generator.

    Args:
        policy: what is flown, on whichever device it is.
        worlds: arguments of ``DroneRacingEnv``: track, preset, renderer, camera, seed (0 if they do not say), device
            (the CPU if they do not say) ...
        episodes: E, of an evaluation.
        num_envs: N, worlds that they are flown in side by side, at most E; None: one for each episode.
    """

    def __init__(self, policy: Policy, worlds: Mapping[str, Any], episodes: int, num_envs: int | None = None) -> None:
        worlds = {"seed": 0, **worlds}
        num_envs = min(num_envs or episodes, episodes)
        self.base = DroneRacingEnv(num_envs=num_envs, evaluation=True, **worlds)
        self._policy, self._episodes = policy, episodes
        self._seed = worlds["seed"]
        self._env = with_memory(self.base, policy.make_primer())

    def evaluate(self, deterministic: bool = True, **recording: Any) -> Evaluation:
        """Fly the episodes; ``recording`` are arguments of ``evaluate``."""
        self._policy.deterministic = deterministic
        self.base.worlds.seed(self._seed)
        return evaluate(self._env, lambda tensordict: act(self._policy, tensordict), self._episodes, **recording)

    def close(self) -> None:
        """Free the simulators."""
        self._env.close(raise_if_closed=False)
