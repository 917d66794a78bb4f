"""Finished episodes in a collector's rollouts, and their gate pass rate, which schedules depend on.

Shapes: N environments, T steps per rollout, E finished episodes, G gates.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

MEMORY = 200
"""Attempts at a gate over which its pass rate is a running mean [choice]; its standard error is then about 0.03."""
KNOWN_PASS_RATE = 0.4
"""Pass rate of the gate with the lowest one above which the whole lap counts as known [choice]."""
MIN_PROGRESS_RATE = 3.0
"""Minimum increase of `GatePassRate.progress` per length of the run, once the lap is known [choice]: 0.4 in 200,000 of
1,500,000 env_steps."""


class EpisodeTracker:
    """Finds the finished episodes in a collector's rollouts, and carries unfinished ones from rollout to rollout.

    Its returns are exact; TorchRL's ``RewardSum`` and ``StepCounter`` sum in float32, in every step of the environment,
    and are off by some 1e-6.

    Args:
        num_envs: N.
        crash_causes: Names of the values of ``("next", "race", "crash")``; 0 means no crash.

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
        """Add one rollout ``[N, T]``, and return the episodes that ended in it.

        Returns:
            Finished episodes, batch ``[E]``, on the CPU, in the order in which they ended: ``env`` int64, ``return``
            float32 (undiscounted), ``length`` int64 (control steps), and the values at the episode's last step of
            ``truncated``, ``gates_passed``, ``crash``, ``finished`` and ``target_gate``, if the rollout has them; all
            ``(E,)``.
        """
        reward = rollout["next", "reward"].squeeze(-1).cpu().double()  # (N, T)
        done = rollout["next", "done"].squeeze(-1).cpu()
        if (is_init := rollout.get("is_init", None)) is not None:
            began = is_init[:, 0].reshape(-1).cpu()  # also if reset between rollouts, for example at a resume
            self._return[began] = 0
            self._length[began] = 0
        # Sums over the rollout, plus those that the unfinished episode brings from earlier rollouts.
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
        found = {name: rollout["next"].get(("race", name), None) for name in self._FACTS}
        found["truncated"] = rollout["next"].get("truncated", None)
        facts = {name: value.squeeze(-1).cpu()[env, step] for name, value in found.items() if value is not None}
        episodes = {"env": env, "return": returns.float(), "length": lengths, **facts}
        return TensorDict(episodes, batch_size=[len(env)])[order]

    def summary(self, episodes: TensorDictBase) -> dict[str, float]:
        """Return means over finished episodes ``[E]``, and the share that ended by each crash cause; none if E = 0."""
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

    def _carry(self, returned: Tensor, lasted: Tensor, env: Tensor, step: Tensor) -> None:
        """Keep the sums since each environment's last episode end."""
        last = torch.full((len(returned),), -1).scatter_reduce(0, env, step, "amax")  # (N,) −1: none ended
        at = last.clamp(min=0).unsqueeze(-1)
        self._return, self._length = (
            values[:, -1] - torch.where(last >= 0, values.gather(-1, at).squeeze(-1), 0)
            for values in (returned, lasted)
        )


class GatePassRate:
    """Pass rate of each of a track's G gates, among attempts from the gate before, and the lowest of these rates.

    The lowest rate tells whether a whole lap is known; a mean would be high even if one gate was never passed. An
    episode's first gate does not count, because training may start right before it. An episode that runs out of time
    has failed at no gate. Without a race G is 0, and the rate stays 0.

    Attributes:
        best: Highest value of the lowest rate since the decayed number of attempts of each gate reached half of
            `MEMORY`; 0 before. It never falls, so schedules that depend on it do not oscillate.
        known_since: env_steps at which `best` reached `KNOWN_PASS_RATE`; None before.

    Example:
        >>> from tensordict import TensorDict
        >>> passes = GatePassRate(num_gates=4)
        >>> episodes = TensorDict(
        ...     {"gates_passed": torch.tensor([4]), "target_gate": torch.tensor([0]), "crash": torch.tensor([1])}, [1]
        ... )
        >>> for _ in range(120):  # gate 0, then 1, 2, 3, and a crash at 0
        ...     share = passes.update(episodes, env_steps=10_000)
        >>> passes.shares.tolist(), passes.best
        ([0.0, 1.0, 1.0, 1.0], 0.0)
    """

    def __init__(self, num_gates: int) -> None:
        self.best = 0.0
        self.known_since: int | None = None
        self._passes = torch.zeros(num_gates, dtype=torch.float64)  # (G,), decayed by 1 / MEMORY per attempt
        self._attempts = torch.zeros(num_gates, dtype=torch.float64)  # (G,)

    def update(self, episodes: TensorDictBase, env_steps: int) -> float:
        """Update the rates by finished episodes, batch ``[E]`` of `EpisodeTracker.update`; return the lowest rate."""
        num_gates = len(self._passes)
        if not num_gates or not len(episodes):
            return self.share
        passed, target = episodes["gates_passed"].unsqueeze(-1), episodes["target_gate"].unsqueeze(-1)  # (E, 1)
        gates = torch.arange(num_gates)
        # Number of passes since gate g was passed last, 1 for the gate before the target; earlier passes are G apart.
        # The first pass of an episode, `passed` ago, is not counted.
        ago = (target - gates - 1) % num_gates + 1  # (E, G)
        passes = ((passed - 1 - ago) // num_gates + 1).clamp(min=0).sum(0)  # (G,)
        failed = (episodes["crash"].unsqueeze(-1) != 0) & (passed > 0) & (target == gates)
        attempts = passes + failed.sum(0)
        kept = (1.0 - 1.0 / MEMORY) ** attempts
        self._passes = kept * self._passes + passes
        self._attempts = kept * self._attempts + attempts
        if self._attempts.min() >= MEMORY / 2:
            self.best = max(self.best, self.share)
        if self.known_since is None and self.best >= KNOWN_PASS_RATE:
            self.known_since = env_steps
        return self.share

    def progress(self, env_steps: int, total_env_steps: int) -> float:
        """Return the larger of `best` and a value that rises linearly from `KNOWN_PASS_RATE` once `best` reached it.

        This prevents a deadlock: if gates are only missed because of a large standard deviation of actions, their pass
        rate does not rise until the schedule lowers that standard deviation.
        """
        if self.known_since is None:
            return self.best
        return max(self.best, KNOWN_PASS_RATE + MIN_PROGRESS_RATE * (env_steps - self.known_since) / total_env_steps)

    @property
    def shares(self) -> torch.Tensor:
        """Current pass rate of each gate, (G,); 0 before the first attempt."""
        return self._passes / self._attempts.clamp(min=1.0)

    @property
    def share(self) -> float:
        """Current pass rate of the gate with the lowest one."""
        return float(self.shares.min()) if len(self._passes) else 0.0

    @property
    def lowest_rate_gate(self) -> int:
        """Index of the gate with the lowest pass rate, in the order of the track."""
        return int(self.shares.argmin())

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        tensors = {"passes": self._passes.clone(), "attempts": self._attempts.clone()}
        return {"best": self.best, "known_since": self.known_since, **tensors}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.best = state_dict["best"]
        self.known_since = state_dict["known_since"]
        self._passes, self._attempts = state_dict["passes"].clone(), state_dict["attempts"].clone()
