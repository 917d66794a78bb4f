"""A TorchRL collector as a part of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict


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
