"""How well the policy flies in training, as a clock for what is scheduled."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

MEMORY = 200
"""Attempts at a gate over which its share is a running mean [choice]: it is then known to about 0.03."""

KNOWN = 0.4
"""Share from which on a way through the hardest gate is known [choice]."""

PACE = 3.0
"""What `GatePassRate.known` gains over a whole run at least, once that gate is known [choice]: 0.4 in 200,000 of
1,500,000 env_steps."""


class GatePassRate:
    """The share of flights that pass the hardest gate of a track, of those that come from the gate before it.

    It is the hardest gate that tells when a whole lap is known: a mean over gates is high where most are passed and one
    never is. What an episode does with its first gate is not counted, since training may begin one right before it.
    An episode that runs out of time has failed at no gate.

    Args:
        num_gates: Of the track, G; 0: there is no race, and the share stays 0.

    Attributes:
        best: The highest that the share has been since each gate's decayed count of attempts was half of `MEMORY`, 0
            before: it never goes back, so that what is scheduled by it does not swing with it.
        known_since: env_steps at which `best` reached `KNOWN`; None before.

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
        self._passes = torch.zeros(num_gates, dtype=torch.float64)  # (G,), forgotten at the rate of one in MEMORY
        self._attempts = torch.zeros(num_gates, dtype=torch.float64)  # (G,)

    def update(self, episodes: TensorDictBase, env_steps: int) -> float:
        """Take note of finished episodes; return the share.

        Args:
            episodes: Batch ``[E]`` of ``EpisodeTracker.update``.
            env_steps: Made so far.
        """
        num_gates = len(self._passes)
        if not num_gates or not len(episodes):
            return self.share
        passed, target = episodes["gates_passed"].unsqueeze(-1), episodes["target_gate"].unsqueeze(-1)  # (E, 1)
        gates = torch.arange(num_gates)
        # How many passes ago gate g was passed last, 1 being the pass before the target; then every G passes before it.
        # The first pass of an episode, `passed` ago, is left out.
        ago = (target - gates - 1) % num_gates + 1  # (E, G)
        passes = ((passed - 1 - ago) // num_gates + 1).clamp(min=0).sum(0)  # (G,)
        failed = (episodes["crash"].unsqueeze(-1) != 0) & (passed > 0) & (target == gates)
        attempts = passes + failed.sum(0)
        kept = (1.0 - 1.0 / MEMORY) ** attempts
        self._passes = kept * self._passes + passes
        self._attempts = kept * self._attempts + attempts
        if self._attempts.min() >= MEMORY / 2:
            self.best = max(self.best, self.share)
        if self.known_since is None and self.best >= KNOWN:
            self.known_since = env_steps
        return self.share

    def known(self, env_steps: int, total_env_steps: int) -> float:
        """`best`, or what time has made of `KNOWN` since it was reached, whichever is more.

        What a setting holds back must not hold back that setting: where gates are missed for a large deviation alone,
        their share stays as it is until the deviation falls.

        Args:
            env_steps: Made so far.
            total_env_steps: Of the whole run.
        """
        if self.known_since is None:
            return self.best
        return max(self.best, KNOWN + PACE * (env_steps - self.known_since) / total_env_steps)

    @property
    def shares(self) -> torch.Tensor:
        """Of each gate as it is now, (G,); 0 before the first attempt."""
        return self._passes / self._attempts.clamp(min=1.0)

    @property
    def share(self) -> float:
        """Of the hardest gate as it is now."""
        return float(self.shares.min()) if len(self._passes) else 0.0

    @property
    def hardest_gate(self) -> int:
        """Which gate that is, in the order of the track."""
        return int(self.shares.argmin())

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "best": self.best,
            "known_since": self.known_since,
            "passes": self._passes.clone(),
            "attempts": self._attempts.clone(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.best = state_dict["best"]
        self.known_since = state_dict["known_since"]
        self._passes, self._attempts = state_dict["passes"].clone(), state_dict["attempts"].clone()
