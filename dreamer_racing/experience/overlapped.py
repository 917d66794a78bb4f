"""Acting while learning: the next rollout is collected in a thread, with a copy of the policy.

The rollout that `next()` returns was collected during the updates before, with the weights from before those: the
policy that acts is older than the learner's by one round of updates. Thread and learner share the global random
generators, so two such runs differ from each other; without overlap they do not.
"""

from __future__ import annotations

import copy
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from tensordict import TensorDictBase

from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.modules import DreamerPolicy


def acting_copy(policy: DreamerPolicy) -> DreamerPolicy:
    """Return a policy with parameters of its own, for a thread that must not see them change."""
    return copy.deepcopy(policy).requires_grad_(False)


class OverlappedRollouts(Rollouts):
    """Collects one rollout ahead.

    Args:
        collector: A TorchRL collector that acts with ``acting``.
        acting: The copy that acts.
        policy: The learner's, whose weights are copied to ``acting`` before each rollout.

    Example:
        >>> # acting = acting_copy(policy); collector = Collector(env, acting, ...)
        >>> # for rollout in OverlappedRollouts(collector, acting, policy): learn(...)
    """

    def __init__(self, collector: Any, acting: DreamerPolicy, policy: DreamerPolicy) -> None:
        super().__init__(collector)
        self._acting, self._policy = acting, policy
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="collector")
        self._next: Future[TensorDictBase] | None = None

    def __next__(self) -> TensorDictBase:
        """Return the rollout that was collected meanwhile, and begin the next."""
        if self._next is None:
            self._copy_weights()
            rollout = super().__next__()
        else:
            rollout = self._next.result()
        rollout = rollout.clone()  # the collector writes the next one over it
        self._copy_weights()
        self._next = self._thread.submit(next, self._rollouts)
        return rollout

    def _copy_weights(self) -> None:
        self._acting.load_state_dict(self._policy.state_dict())

    def wait(self) -> None:
        """Wait for the rollout under way."""
        if self._next is not None:
            self._next.exception()  # which `next` raises

    def drain(self) -> TensorDictBase | None:
        """Return the rollout under way, if there is one, and begin no other."""
        if self._next is None:
            return None
        rollout, self._next = self._next.result().clone(), None
        return rollout

    def close(self) -> None:
        """Wait for the rollout under way."""
        self._thread.shutdown(wait=True)
