"""What a run learns from: rollouts, one after the other; and the newest of them, as an on-policy actor keeps them.

Shape legend: N environments, T steps of a rollout, S steps kept of each environment, A action, F features, P privileged
numbers.
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
    """Who flies failed, or is gone and does not come back: what is under way is given up, all before was delivered."""


class Rollouts(Iterator[TensorDictBase]):
    """Rollouts ``[N, T]`` of a collector, each flown when it is asked for; subclasses have the next one under way then.

    Who takes them learns from what was delivered before the next ``next()``.

    Args:
        collector: What flies, e.g. a TorchRL collector.

    Attributes:
        has_worlds: Whether the worlds that are flown live in this process, and are saved with the run.
        stopping: Whether the run is to end: what is under way may be given up if it takes long; settable.
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
        """Return what is to be said of the rollout that was delivered last."""
        return {}

    def begin_at(self, env_steps: int) -> None:
        """Go on with a run that has made so many env_steps."""

    def wait(self) -> None:
        """Wait until nothing under way draws from this process's random numbers; it is delivered as ever."""

    def drain(self) -> TensorDictBase | None:
        """Return the rollout under way, if there is one, and begin no other: nothing moves until the next ``next()``.

        What a checkpoint holds of replay, environment and collector then belongs together.
        """
        return None

    def close(self) -> None:
        """End what is under way; it is not delivered any more."""


class CollectorState:
    """What a TorchRL collector carries from rollout to rollout: observations, and the policy's memory.

    Args:
        collector: A ``Collector``, whose environment is saved apart.
    """

    def __init__(self, collector: Any) -> None:
        self._collector = collector

    def state_dict(self) -> dict[str, Any]:
        """Return the step that the next rollout starts from."""
        # Trajectory numbers are counted anew in every process, and nothing reads them.
        return self._collector._carrier.exclude("collector").clone().to_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Start the next rollout from there.

        Raises:
            ValueError: if it is of another number of environments.
        """
        saved, present = len(state_dict["is_init"]), self._collector._carrier.batch_size[0]
        if saved != present:
            raise ValueError(
                f"The checkpoint is of {saved} environments, this run has {present}: set env.num_envs={saved}."
            )
        self._collector._carrier.update(TensorDict(state_dict, self._collector._carrier.batch_size))


READ: tuple[NestedKey, ...] = (
    "action", "previous_action", "loc", "scale", ("next", "belief"), ("next", "state"), ("next", "reward"),
    ("next", "done"), ("next", "terminated"),
)  # fmt: skip
"""What is read of a rollout: `DreamerPolicy` and the environment write it."""


class RolloutStorage:
    """Keeps whole rollouts of a collector until there are enough steps, with the distribution that acted.

    The steps begin anew with another number of environments or steps; once they are full, the newest are kept.

    Args:
        number: Steps to keep, summed over environments; rounded up to whole rollouts.
        device: Where they are kept.
        privileged: Whether the simulator's state is kept, too.

    Attributes:
        steps: Kept ones, batch ``[S, N]``, time first: ``features`` that the policy saw; ``action``, clipped;
            ``previous_action``; ``behavior``, mean and standard deviation side by side; ``reward``, ``done``,
            ``terminated``; ``privileged``, symlog, if it is kept. None before the first rollout.
        count: How many of the S are filled.
    """

    def __init__(self, number: int, device: torch.device | str = "cpu", privileged: bool = False) -> None:
        self.number = number
        self.device = torch.device(device)
        self.keys: tuple[NestedKey, ...] = (*READ, PRIVILEGED) if privileged else READ
        self.steps: TensorDictBase | None = None
        self.count = 0  # a plain number, to be read without waiting for the device

    @property
    def full(self) -> bool:
        """Whether there are enough steps to learn from."""
        return self.steps is not None and self.count == len(self.steps)

    @torch.no_grad()
    def extend(self, rollout: TensorDictBase) -> None:
        """Keep a rollout ``[N, T]``.

        Where its worlds begin anew in the midst of an episode, as those of a lost worker do, the step before ends that.

        Raises:
            KeyError: If it lacks one of ``keys``.
        """
        if missing := [key for key in self.keys if rollout.get(key, None) is None]:
            raise KeyError(f"The rollout lacks {missing}, which on-policy learning needs of policy and environment.")
        steps = self._read(rollout.select(*self.keys).to(self.device).transpose(0, 1))
        length = len(steps)
        kept = self._make_room(steps)
        first = self.count
        if first == len(kept):  # full, and nothing has learned from it: the oldest rollout makes room
            first -= length
            kept[:first] = kept[length:].clone()
        if first and (begins := rollout.get("is_init", None)) is not None:
            kept["done"][first - 1] |= begins[:, 0].to(self.device)
        kept[first : first + length] = steps
        self.count = first + length

    def clear(self) -> None:
        """Begin anew; the steps stay readable until the next rollout comes."""
        self.count = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the steps that are filled, and how many there is room for."""
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
        """Return what is kept of the steps of a rollout ``[T, N]``."""
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
        """Return room for ``number`` steps in whole rollouts like this; what is kept of other shapes is forgotten."""
        length, environments = steps.batch_size
        room = length * math.ceil(self.number / (length * environments))
        if self.steps is None or self.steps.batch_size != (room, environments):
            self.steps = steps.new_zeros(room, environments)
            self.count = 0
        elif self.count % length:  # rollouts of another length, which do not make whole ones of this
            self.count = 0
        return self.steps
