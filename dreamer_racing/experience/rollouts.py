"""Source of rollouts, and storage of the newest rollouts for an on-policy actor.

Shape legend: N environments, T steps of a rollout, S steps kept of each environment, A action, F features, P width of
the privileged vector.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.modules.rssm import join_features


class WorkerError(RuntimeError):
    """Raised if a worker failed or is lost for good; its rollout is lost, all earlier ones were delivered."""


class Rollouts(Iterator[TensorDictBase]):
    """Iterator over rollouts ``[N, T]`` of a collector, each collected on request; subclasses may collect ahead.

    The consumer learns from a rollout before it calls ``next()`` again.

    Args:
        collector: Source of rollouts, for example a TorchRL collector.

    Attributes:
        has_worlds: Whether the environments live in this process, and are saved with the run.
        stopping: Function that tells whether the run shall end, so that a slow rollout may be abandoned; settable.
    """

    has_worlds = True
    stopping: Callable[[], bool] = staticmethod(lambda: False)

    def __init__(self, collector: Any) -> None:
        self.collector = collector
        self._rollouts = iter(collector)

    def __next__(self) -> TensorDictBase:
        """Return the next rollout."""
        return next(self._rollouts)

    def metrics(self) -> dict[str, float]:
        """Return metrics of the latest rollout."""
        return {}

    def begin_at(self, env_steps: int) -> None:
        """Continue a run that was resumed at ``env_steps``."""

    def drain(self) -> TensorDictBase | None:
        """Return the rollout in progress, if any, so that the parts' states are consistent; start no other."""
        return None

    def close(self) -> None:
        """Abandon the rollout in progress."""


class CollectorState:
    """State that a TorchRL collector carries between rollouts: observations and the policy's recurrent state."""

    def __init__(self, collector: Any) -> None:
        self._collector = collector

    def state_dict(self) -> dict[str, Any]:
        """Return the step that the next rollout starts from."""
        # Trajectory numbers restart in every process, and nothing reads them.
        return self._collector._carrier.exclude("collector").clone().to_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; raise ``ValueError`` for another number of environments."""
        saved, present = len(state_dict["is_init"]), self._collector._carrier.batch_size[0]
        if saved != present:
            raise ValueError(
                f"The checkpoint has {saved} environments, this run has {present}: set env.num_envs={saved}."
            )
        self._collector._carrier.update(TensorDict(state_dict, self._collector._carrier.batch_size))


READ: tuple[NestedKey, ...] = (
    "action", "previous_action", "loc", "scale", ("next", "belief"), ("next", "state"), ("next", "reward"),
    ("next", "done"), ("next", "terminated"),
)  # fmt: skip
"""Keys of a rollout that are read; `DreamerPolicy` and the environment write them."""


class RolloutStorage:
    """Stores whole rollouts until there are enough steps for an update, with the action distribution of each step.

    If the shape of rollouts changes, the storage starts afresh. When it is full, the oldest rollout is dropped.

    Args:
        number: Steps to keep, summed over environments; rounded up to whole rollouts.
        device: Where they are stored.
        privileged: Whether to store the simulator's state, too.

    Attributes:
        steps: Stored steps, batch ``[S, N]``, time first: ``features`` that the policy saw; ``action``, clipped;
            ``previous_action``; ``behavior``, mean and standard deviation side by side; ``reward``, ``done``,
            ``terminated``; ``privileged``, symlog, if it is stored. None before the first rollout.
        count: Number of filled rows, at most S.
    """

    def __init__(self, number: int, device: torch.device | str = "cpu", privileged: bool = False) -> None:
        self.number = number
        self.device = torch.device(device)
        self.keys: tuple[NestedKey, ...] = (*READ, PRIVILEGED) if privileged else READ
        self.steps: TensorDictBase | None = None
        self.count = 0  # a Python number, readable without waiting for the device

    @property
    def full(self) -> bool:
        """Whether there are enough steps to learn from."""
        return self.steps is not None and self.count == len(self.steps)

    @torch.no_grad()
    def extend(self, rollout: TensorDictBase) -> None:
        """Store a rollout ``[N, T]``, or raise ``KeyError`` if it lacks one of ``keys``.

        If an environment was reset within an episode, as of a lost worker, its last stored step is marked as done.
        """
        if missing := [key for key in self.keys if rollout.get(key, None) is None]:
            raise KeyError(f"The rollout lacks {missing}, which on-policy learning needs from policy and environment.")
        steps = self._read(rollout.select(*self.keys).to(self.device).transpose(0, 1))
        length = len(steps)
        kept = self._make_room(steps)
        first = self.count
        if first == len(kept):  # full, and not yet used: drop the oldest rollout
            first -= length
            kept[:first] = kept[length:].clone()
        if first and (begins := rollout.get("is_init", None)) is not None:
            kept["done"][first - 1] |= begins[:, 0].to(self.device)
        kept[first : first + length] = steps
        self.count = first + length

    def clear(self) -> None:
        """Empty the storage; the steps stay readable until the next ``extend``."""
        self.count = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the filled steps and the capacity."""
        if self.steps is None:
            return {"room": 0, "steps": {}}
        return {"room": len(self.steps), "steps": self.steps[: self.count].to_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.steps, self.count = None, 0
        if state_dict["room"]:
            filled = TensorDict(state_dict["steps"], state_dict["steps"]["reward"].shape[:2]).to(self.device)
            self.count = len(filled)
            self.steps = filled.new_zeros(state_dict["room"], filled.batch_size[1])
            self.steps[: self.count] = filled

    def _read(self, rollout: TensorDictBase) -> TensorDictBase:
        """Return the stored entries of a rollout ``[T, N]``."""
        after = rollout["next"]
        kept = {
            "features": join_features(after["belief"], after["state"]),
            "action": rollout["action"],
            "previous_action": rollout["previous_action"],
            "behavior": torch.cat((rollout["loc"], rollout["scale"]), -1),
            **{name: after[name] for name in ("reward", "done", "terminated")},
        }
        if PRIVILEGED in self.keys:
            kept["privileged"] = symlog(rollout[PRIVILEGED])
        return TensorDict(kept, rollout.batch_size)

    def _make_room(self, steps: TensorDictBase) -> TensorDictBase:
        """Return storage for ``number`` steps in whole rollouts of this shape; steps of other shapes are dropped."""
        length, environments = steps.batch_size
        room = length * math.ceil(self.number / (length * environments))
        if self.steps is None or self.steps.batch_size != (room, environments):
            self.steps = steps.new_zeros(room, environments)
            self.count = 0
        elif self.count % length:  # the stored rollouts have another length
            self.count = 0
        return self.steps
