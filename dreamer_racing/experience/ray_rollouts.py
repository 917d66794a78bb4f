"""Collection by workers on a Ray cluster: scheduling of rounds, transfer of weights, and recovery of lost workers.

A *round* is one rollout of every worker, concatenated to one rollout ``[N, T]`` of all environments: worker w has
environments ``w·N/W`` to ``(w + 1)·N/W − 1``. While the learner uses one round, exactly one more is collected.

If a worker's process dies, Ray restarts it with newly reset environments, which records, episodes and returns recognise
by ``is_init``, and repeats the request. The round is delivered once it is complete, so every frame counts once.

TorchRL's own loop over Ray workers and its weight synchronisation are not used, because neither survives the loss of a
worker: the loop ends with the error and drops the rollouts in progress of other workers; `RayWeightSyncScheme` is a
process group, which a restarted worker cannot join.

Shapes: N environments of all W workers, T steps per rollout.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from dreamer_racing.experience import ray_cluster
from dreamer_racing.experience.ray_worker import Request, WorkerResult, as_arrays, unpack_rollout
from dreamer_racing.experience.rollouts import Rollouts, WorkerError
from dreamer_racing.modules import DreamerPolicy

if TYPE_CHECKING:
    from torchrl.collectors.distributed import RayCollector

logger = logging.getLogger(__name__)

LOOK = 1.0  # s between checks whether workers have answered, or the run shall stop
REMIND = 30.0  # s between log messages about late workers
STOP_TIMEOUT = 10.0  # s that a stopping run waits for the round in progress


class RayRollouts(Rollouts):
    """Iterator over rounds, which are collected one ahead of the learner.

    Args:
        collector: Collector of the workers, from `start_workers`.
        policy: The learner's policy, whose weights are sent.
        env: Environment whose attributes are sent with every request, to be set in the workers' environments.
        settings: Dotted names of these attributes.
        weight_interval: Maximum age of weights, env_steps, when the last frame collected with them has been learned
            from, including its own round; see `WorkersConfig.check`. New weights are sent no sooner than needed.
        patience: Seconds to wait for a round.
        leaves: Whether `close` disconnects from the cluster.

    Attributes:
        rounds: Number of rounds delivered in the run.
        lost: Number of workers that died and were replaced since this process started.
        weights_age: Age of the weights of the round delivered last, env_steps.
        processes: Host and process ID of each worker in that round.
        seconds: Time that the slowest worker took for that round.
    """

    has_worlds = False

    def __init__(
        self,
        collector: RayCollector,
        policy: DreamerPolicy,
        env: EnvBase,
        settings: Sequence[str] = (),
        *,
        weight_interval: int,
        patience: float = 600.0,
        leaves: bool = True,
    ) -> None:
        self.collector, self._policy, self._env, self._settings = collector, policy, env, settings
        self._workers = list(collector.remote_collectors)
        self._frames = collector.frames_per_batch * len(self._workers)
        self._interval, self._patience, self._leaves = weight_interval, patience, leaves
        self._asked: list[Any] = []  # Ray references to `WorkerResult`s, one for each worker
        self._weights: Any = None  # a Ray reference
        self._taken_at = self._flown_with = 0  # env_steps when weights were taken: newest, of the round in progress
        self._all_flew = self._is_over = False
        self.rounds = self.lost = self.weights_age = 0
        self.processes: list[tuple[str, int]] = []
        self.seconds = 0.0

    def __next__(self) -> TensorDictBase:
        """Return the round in progress, ``[N, T]``, once it is complete, and request the next.

        Raises:
            WorkerError: A worker failed or did not answer in time.
            StopIteration: The run shall stop and the round took too long, or an earlier round was abandoned.
        """
        if not self._asked and not self._is_over:
            self._ask(self.rounds)
        rollout = self._receive()
        if rollout is None:
            raise StopIteration
        self._ask(self.rounds + 1)
        self.rounds += 1
        return rollout

    def drain(self) -> TensorDictBase | None:
        """Return the round in progress, if there is one and it does not take too long; request no other."""
        rollout = self._receive()
        self.rounds += rollout is not None
        return rollout

    def metrics(self) -> dict[str, float]:
        """Return the age of the weights of the latest round."""
        return {"collect/weights_age": float(self.weights_age)}

    def close(self) -> None:
        """End the workers."""
        self._asked = []
        self.collector.shutdown()
        if self._leaves:
            import ray

            ray.shutdown()  # a cluster that `join` started ends

    def begin_at(self, env_steps: int) -> None:
        """Continue a run that was resumed at ``env_steps``, in freshly reset environments."""
        self.rounds = env_steps // self._frames
        logger.info("workers: environments start new episodes, at round %d", self.rounds)

    def _ask(self, number: int) -> None:
        """Request a round of every worker, with new weights if those sent before would be too old by its end."""
        import ray

        if self._weights is None or (number + 1) * self._frames - self._taken_at > self._interval:
            self._weights = ray.put(as_arrays(TensorDict.from_module(self._policy)))
            self._taken_at = self.rounds * self._frames
        settings = {name: attrgetter(name)(self._env) for name in self._settings}
        request = Request(number, [self._weights], self._taken_at, settings)
        self._asked = [worker.collect_rollout.remote(request) for worker in self._workers]
        self._flown_with = self._taken_at

    def _receive(self) -> TensorDictBase | None:
        """Wait for the round in progress; None if there is none, or if it is lost because the run stops: the last."""
        asked, self._asked = self._asked, []
        self._is_over = self._is_over or bool(asked)
        if not asked or not self._wait(asked):
            return None
        results = [_fetch(worker, answer) for worker, answer in enumerate(asked)]
        for worker, result in enumerate(results):
            if result.is_first and self._all_flew:
                self.lost += 1
                words = "worker %d was lost in round %d: process %d on %s replaces it, with newly reset environments"
                logger.warning(words, worker, self.rounds, *reversed(result.process))
        self._all_flew, self._is_over = True, False
        self.processes = [result.process for result in results]
        self.seconds = max(result.seconds for result in results)
        self.weights_age = (self.rounds + 1) * self._frames - self._flown_with
        return unpack_rollout(*(result.rollout for result in results))

    def _wait(self, asked: list[Any]) -> bool:
        """Wait until every worker has answered; return False if the run stops and they take too long."""
        import ray

        begun, reminded, pending = time.monotonic(), 0.0, asked
        while pending:
            _, pending = ray.wait(asked, num_returns=len(asked), timeout=min(LOOK, self._patience))
            waited, late = time.monotonic() - begun, ", ".join(str(asked.index(answer)) for answer in pending)
            if pending and self.stopping() and waited >= STOP_TIMEOUT:
                logger.warning("worker %s did not answer for %.0f s: this round is abandoned", late, waited)
                return False
            if pending and waited >= self._patience:
                raise WorkerError(
                    f"Worker {late} of {len(asked)} did not answer for {waited:.0f} s "
                    f"(workers.patience={self._patience:g}): {_resources()}. Resume with a lower num_workers=, or when "
                    "the cluster has free resources again."
                )
            if pending and waited - reminded >= REMIND:
                logger.warning(
                    "waiting for worker %s for %.0f s; a lost worker restarts when resources are free", late, waited
                )
                reminded = waited
        return True


def _fetch(worker: int, asked: Any) -> WorkerResult:
    """Fetch the answer of a worker; raise ``WorkerError`` if it failed, or is lost and cannot be restarted."""
    import ray

    try:
        return ray.get(asked)
    except ray.exceptions.RayTaskError as error:
        logger.error("%s", error)  # with the worker's traceback
        raise WorkerError(f"Worker {worker} failed ({ray_cluster.in_a_line(error, last=True)}).") from error
    except ray.exceptions.RayError as error:
        reason = ray_cluster.in_a_line(error, last=True)
        raise WorkerError(f"Worker {worker} is lost and cannot be restarted ({reason}).") from error


def _resources() -> str:
    """Return a description of the free resources of the cluster."""
    nodes, free = ray_cluster.resources()
    total = {name: sum(node.get(name, 0.0) for node in nodes) for name in ("CPU", "GPU")}
    has = ", ".join(f"{free.get(name, 0):g} of {there:g} {name}s" for name, there in total.items() if there)
    return f"the cluster has {has or 'nothing'} free"
