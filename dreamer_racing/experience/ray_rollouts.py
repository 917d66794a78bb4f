"""Collection by workers on a Ray cluster: who flies when, with which weights, and what becomes of it.

TorchRL's `RayCollector` starts the workers and ends them; each is a TorchRL `Collector` (`RayWorker`). Rollouts come,
and weights go, through Ray's object store. What is here is the order in which that happens.

A *round* is a rollout of every worker, side by side one rollout ``[N, T]`` of all worlds: worker w flies worlds
``w·N/W`` to ``(w + 1)·N/W − 1`` of every round. So whatever takes rollouts (streams of a replay, episodes, an actor
that learns from what was flown) does not know of workers. One round is under way while the last is learned from, never
more: workers that are faster wait, and nothing piles up.

A worker whose process dies is begun anew by Ray, wherever there is room, and asked again for what it owes. What it had
flown of that rollout was never seen; the rollouts of the others stay as they are, and the round is delivered once it is
whole. So every frame counts once, and none is lost that was delivered. The worlds of the worker begin anew: records,
episodes and returns know that by ``is_init``.

TorchRL's own loop over Ray's workers and its weight synchronisation are not used, because neither outlives a worker:
the first ends with the error, and drops what the other workers have under way; `RayWeightSyncScheme` is a process group
that a worker which was begun anew is no part of.

Shapes: N worlds of all W workers, T steps a rollout.
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
from dreamer_racing.experience.ray_arrays import as_arrays, unpack_rollout
from dreamer_racing.experience.ray_worker import Flight, Request
from dreamer_racing.experience.rollouts import Rollouts, WorkerError
from dreamer_racing.modules import DreamerPolicy

if TYPE_CHECKING:
    from torchrl.collectors.distributed import RayCollector

logger = logging.getLogger(__name__)

LOOK = 1.0  # s between looks at whether workers have answered, or the run is to stop
REMIND = 30.0  # s, after which it is said that workers are waited for
FAREWELL = 10.0  # s that a run which is to stop waits for the round under way


class RayRollouts(Rollouts):
    """Rounds of rollouts, one ahead of the learner.

    Args:
        collector: Of workers, as `start_workers` makes it.
        policy: The learner's, whose weights are sent.
        env: Whose attributes are sent with every request, for workers to set in theirs.
        settings: Which those are, by dotted name.
        weight_interval: env_steps that weights may be old at most when the last frame flown with them is learned from,
            this rollout's counted. At least two rounds; new ones are sent no sooner than needed.
        patience: s to wait for a round.
        leaves: Whether `close` parts from the cluster.

    Attributes:
        rounds: Delivered so far in the run.
        lost: How often a worker died in this process's time and another took its place.
        weights_age: env_steps, of the round delivered last: of its weights.
        processes: Host and process id of each worker, as of that round.
        seconds: Of that round, how long the slowest worker flew.

    Raises:
        ValueError: If no weights could be as new as ``weight_interval`` asks.
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
        check_interval(weight_interval, self._frames)
        self._interval, self._patience, self._leaves = weight_interval, patience, leaves
        self._asked: list[Any] = []  # references to flights, one of each worker
        self._weights: Any = None  # a reference
        self._taken_at = self._flown_with = 0  # env_steps learned from when weights were taken: newest, under way
        self._all_flew = self._is_over = False
        self.rounds = self.lost = self.weights_age = 0
        self.processes: list[tuple[str, int]] = []
        self.seconds = 0.0

    def __next__(self) -> TensorDictBase:
        """Return the round that was flown meanwhile, ``[N, T]``, and ask for the next.

        Raises:
            WorkerError: It cannot be had.
            StopIteration: It took too long for a run that is to stop, or one before was given up.
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
        """Return the round under way, if there is one and it does not take too long, and ask for no other."""
        rollout = self._receive()
        self.rounds += rollout is not None
        return rollout

    def metrics(self) -> dict[str, float]:
        """Return how old the weights of the round were."""
        return {"collect/weights_age": float(self.weights_age)}

    def close(self) -> None:
        """End the workers."""
        self._asked = []
        self.collector.shutdown()
        if self._leaves:
            ray_cluster.leave()

    def begin_at(self, env_steps: int) -> None:
        """Go on with a run that has made so many env_steps, in fresh worlds."""
        self.rounds = env_steps // self._frames
        logger.info("workers: their worlds begin anew, at round %d", self.rounds)

    def _ask(self, number: int) -> None:
        """Ask every worker for its rollout of a round, with new weights if those sent would be too old by its end."""
        import ray

        if self._weights is None or (number + 1) * self._frames - self._taken_at > self._interval:
            self._weights = ray.put(as_arrays(TensorDict.from_module(self._policy)))
            self._taken_at = self.rounds * self._frames
        settings = {name: attrgetter(name)(self._env) for name in self._settings}
        request = Request(number, [self._weights], self._taken_at, settings)
        self._asked, self._flown_with = [worker.fly.remote(request) for worker in self._workers], self._taken_at

    def _receive(self) -> TensorDictBase | None:
        """Wait for the round under way; None if there is none, or if it is given up because the run is to stop.

        What workers have flown of a round that is given up is lost, so that there can be none after it.
        """
        asked, self._asked = self._asked, []
        self._is_over = self._is_over or bool(asked)
        if not asked or not self._wait(asked):
            return None
        flights = [_flight(worker, flight) for worker, flight in enumerate(asked)]
        for worker, flight in enumerate(flights):
            if flight.began and self._all_flew:
                self.lost += 1
                host, process = flight.process
                logger.warning(
                    "worker %d was lost in round %d: process %d on %s took its place, and its worlds began anew",
                    worker,
                    self.rounds,
                    process,
                    host,
                )
        self._all_flew, self._is_over = True, False
        self.processes = [flight.process for flight in flights]
        self.seconds = max(flight.seconds for flight in flights)
        self.weights_age = (self.rounds + 1) * self._frames - self._flown_with
        return unpack_rollout(*(flight.rollout for flight in flights))

    def _wait(self, asked: list[Any]) -> bool:
        """Wait until every worker has answered; return whether they have, rather than the run is to stop.

        Raises:
            WorkerError: One has not for too long.
        """
        import ray

        begun, reminded, pending = time.monotonic(), 0.0, asked
        while pending:
            _, pending = ray.wait(asked, num_returns=len(asked), timeout=min(LOOK, self._patience))
            waited, late = time.monotonic() - begun, _listed([asked.index(flight) for flight in pending])
            if pending and self.stopping() and waited >= FAREWELL:
                logger.warning("worker %s did not answer for %.0f s: this round is given up", late, waited)
                return False
            if pending and waited >= self._patience:
                raise WorkerError(
                    f"Of {len(asked)} workers, {late} did not answer for {waited:.0f} s "
                    f"(workers.patience={self._patience:g}): {_room()}. Continue with fewer by num_workers=, or once "
                    "the cluster has room again."
                )
            if pending and waited - reminded >= REMIND:
                logger.warning("waiting for worker %s since %.0f s; one that was lost needs room", late, waited)
                reminded = waited
        return True


def _flight(worker: int, asked: Any) -> Flight:
    """Fetch what a worker answered.

    Raises:
        WorkerError: It failed, or is lost and does not come back.
    """
    import ray

    try:
        return ray.get(asked)
    except ray.exceptions.RayTaskError as error:
        logger.error("%s", error)  # with the traceback of over there
        raise WorkerError(f"Worker {worker} failed ({ray_cluster.in_a_line(error, last=True)}).") from error
    except ray.exceptions.RayError as error:
        reason = ray_cluster.in_a_line(error, last=True)
        raise WorkerError(f"Worker {worker} is lost and cannot be begun anew ({reason}).") from error


def check_interval(weight_interval: int, frames: int) -> None:
    """Refuse weights newer than those of a round that is flown while the one before is learned from.

    Args:
        weight_interval: env_steps.
        frames: env_steps of a round.

    Raises:
        ValueError: the message gives the smallest that is possible.
    """
    if weight_interval < 2 * frames:
        raise ValueError(
            f"workers.weight_interval={weight_interval}: a round of all workers is {frames} env_steps, and is flown "
            f"while the one before is learned from, so weights are {2 * frames} env_steps old at its end: give at "
            "least that, or lower rollout_steps."
        )


def _listed(workers: Sequence[int]) -> str:
    return ", ".join(map(str, workers))


def _room() -> str:
    """What the cluster has, in words."""
    nodes, free = ray_cluster.resources()
    total = {name: sum(node.get(name, 0.0) for node in nodes) for name in ("CPU", "GPU")}
    has = ", ".join(f"{free.get(name, 0):g} of {there:g} {name}s" for name, there in total.items() if there)
    return f"the cluster has {has or 'nothing'} free"
