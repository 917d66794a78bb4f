"""The episodes in a collector's rollouts.

Shapes: N environments, T steps a rollout, E finished episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class EpisodeTracker:
    """Finds the finished episodes in a collector's rollouts, carrying unfinished ones from rollout to rollout.

    Its returns are exact; TorchRL's ``RewardSum`` and ``StepCounter`` sum in float32, in every step of the environment,
    and are off by some 1e-6.

    Args:
        num_envs: N.
        crash_causes: names of the values of ``("next", "race", "crash")``, 0 meaning no crash.

    Example:
        >>> tracker = EpisodeTracker(num_envs=16)
        >>> # for rollout in collector:
        >>> #     episodes = tracker.update(rollout)
        >>> #     metrics.push(tracker.summary(episodes), len(episodes))
    """

    _FACTS = ("gates_passed", "crash", "finished", "target_gate")

    def __init__(self, num_envs: int, crash_causes: type[IntEnum] | None = None) -> None:
        self.crash_causes = crash_causes
        self._return = torch.zeros(num_envs, dtype=torch.float64)  # (N,) of the unfinished episodes
        self._length = torch.zeros(num_envs, dtype=torch.int64)  # (N,)

    def update(self, rollout: TensorDictBase) -> TensorDictBase:
        """Accounts for one rollout.

        Args:
            rollout: batch ``[N, T]`` with ``("next", "reward")``, ``("next", "done")`` and, if there are any,
                ``("next", "truncated")``, ``("next", "race", ...)`` and the root's ``is_init``.

        Returns:
            Finished episodes, batch ``[E]``, on the CPU, in the order in which they ended: ``env`` int64, ``return``
            float32 (undiscounted), ``length`` int64 (control steps), and as they were at the episode's last step
            ``truncated``, ``gates_passed``, ``crash``, ``finished`` and ``target_gate``, as far as the rollout
            has them, all ``(E,)``.
        """
        reward = rollout["next", "reward"].squeeze(-1).cpu().double()  # (N, T)
        done = rollout["next", "done"].squeeze(-1).cpu()
        self._forget_interrupted(rollout)
        # Sums since the unfinished episode began, or since the rollout's first step after that.
        returned = self._return.unsqueeze(-1) + reward.cumsum(-1)  # (N, T)
        lasted = self._length.unsqueeze(-1) + torch.arange(1, done.shape[-1] + 1)
        env, step = done.nonzero(as_tuple=True)  # (E,) environment by environment
        previous = torch.arange(len(env)) - 1
        continues = torch.zeros_like(env, dtype=torch.bool)  # an earlier episode of this environment ended here too
        continues[1:] = env[1:] == env[:-1]
        returns, lengths = (
            values[env, step] - torch.where(continues, values[env, step][previous], 0) for values in (returned, lasted)
        )
        self._carry(returned, lasted, env, step)
        order = torch.argsort(step, stable=True)
        episodes = {"env": env, "return": returns.float(), "length": lengths, **self._facts(rollout, env, step)}
        return TensorDict(episodes, batch_size=[len(env)])[order]

    def summary(self, episodes: TensorDictBase) -> dict[str, float]:
        """Returns the metrics of finished episodes: means, and for each crash cause the share that ended by it.

        Args:
            episodes: batch ``[E]`` of `update`.

        Returns:
            ``episode/return``, ``episode/length``, ``episode/gates_passed``, ``crash/<cause>``; empty if E = 0.
        """
        if not len(episodes):
            return {}
        names = [name for name in ("return", "length", "gates_passed") if name in episodes]
        metrics = {f"episode/{name}": episodes[name].double().mean().item() for name in names}
        for cause in self.crash_causes or ():
            if cause and "crash" in episodes:
                metrics[f"crash/{cause.name.lower()}"] = (episodes["crash"] == cause).double().mean().item()
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"return": self._return.clone(), "length": self._length.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._return = state_dict["return"].clone()
        self._length = state_dict["length"].clone()

    def _forget_interrupted(self, rollout: TensorDictBase) -> None:
        """Drops the unfinished episodes of environments that were reset meanwhile, as they are when a run resumes."""
        is_init = rollout.get("is_init", None)
        if is_init is not None:
            began = is_init[:, 0].reshape(-1).cpu()
            self._return[began] = 0
            self._length[began] = 0

    def _carry(self, returned: Tensor, lasted: Tensor, env: Tensor, step: Tensor) -> None:
        """Keeps what came after each environment's last episode end."""
        last = torch.full((len(returned),), -1).scatter_reduce(0, env, step, "amax")  # (N,) −1: none ended
        at = last.clamp(min=0).unsqueeze(-1)
        self._return, self._length = (
            values[:, -1] - torch.where(last >= 0, values.gather(-1, at).squeeze(-1), 0)
            for values in (returned, lasted)
        )

    def _facts(self, rollout: TensorDictBase, env: Tensor, step: Tensor) -> dict[str, Tensor]:
        found = {name: rollout["next"].get(("race", name), None) for name in self._FACTS}
        found["truncated"] = rollout["next"].get("truncated", None)
        return {name: value.squeeze(-1).cpu()[env, step] for name, value in found.items() if value is not None}
