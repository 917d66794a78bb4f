"""How well the policy flies in training, as a clock for what is scheduled."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase

MEMORY = 300
"""Episodes over which the share is a running mean [choice]: it is then known to about 0.02."""


class PassShare:
    """The share of target gates that training episodes pass: passes / (passes + crashes).

    An episode that runs out of time has failed at no gate. Two gates and a crash are 0.67, five 0.83, twenty 0.95.

    Attributes:
        best: The highest that the share has been, 0 before the first hundred episodes: it never goes back, so that
            what is scheduled by it does not swing with it.

    Example:
        >>> passes = PassShare()
        >>> for _ in range(200):
        ...     passes.add(gates=400.0, crashes=100.0, episodes=100)
        >>> round(passes.best, 2)
        0.8
    """

    def __init__(self) -> None:
        self.best = 0.0
        self._gates = self._crashes = self._episodes = 0.0  # forgotten at the rate of one in MEMORY episodes

    def update(self, episodes: TensorDictBase) -> float:
        """Take note of finished episodes, batch ``[E]`` of ``EpisodeTracker.update``; return the share."""
        if len(episodes) and "gates_passed" in episodes:
            self.add(
                gates=float(episodes["gates_passed"].sum()),
                crashes=float((episodes["crash"] != 0).sum()),
                episodes=len(episodes),
            )
        return self.share

    def add(self, gates: float, crashes: float, episodes: int) -> None:
        """Take note of some episodes."""
        kept = (1.0 - 1.0 / MEMORY) ** episodes
        self._gates = kept * self._gates + gates
        self._crashes = kept * self._crashes + crashes
        self._episodes = kept * self._episodes + episodes
        if self._episodes >= MEMORY / 3:
            self.best = max(self.best, self.share)

    @property
    def share(self) -> float:
        """As it is now; 0 before the first episode."""
        attempts = self._gates + self._crashes
        return self._gates / attempts if attempts else 0.0

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"best": self.best, "gates": self._gates, "crashes": self._crashes, "episodes": self._episodes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.best = state_dict["best"]
        self._gates, self._crashes = state_dict["gates"], state_dict["crashes"]
        self._episodes = state_dict["episodes"]
