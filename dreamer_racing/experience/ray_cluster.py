"""A Ray cluster to collect on: joining it, what it must have, and starting workers there.

Everything that a person can mend is refused here, before the first rollout, in a paragraph.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from torchrl.envs import EnvBase

from dreamer_racing.experience.ray_worker import RayWorker, versions
from dreamer_racing.modules import DreamerPolicy

if TYPE_CHECKING:  # which imports Ray where it is installed, and that takes a second
    from torchrl.collectors.distributed import RayCollector

SEEDS_APART = 1_000_000
"""Between the seeds of two workers."""


class Share(NamedTuple):
    """What each worker is given.

    Attributes:
        cpus: cores, may be a part of one.
        gpus: likewise.
    """

    cpus: float
    gpus: float

    @property
    def device(self) -> str:
        """Where a worker's policy lives."""
        return "cuda" if self.gpus else "cpu"


def join(address: str) -> bool:
    """Join a Ray cluster, unless this process has joined one already; return whether it did now.

    Args:
        address: ``local`` starts one on this machine, of all its CPUs and GPUs; ``auto`` is one that runs here already;
            else that of its head, ``host:port``.

    Raises:
        ValueError: there is no Ray, or no such cluster, or one of other versions; the message says what was found.
    """
    if importlib.util.find_spec("ray") is None:
        raise ValueError(
            "collector=ray: Ray is not installed here. Install the extra, pip install -e '.[ray]', or collect in this "
            "process with collector=local."
        )
    import ray

    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    try:
        ray.init(address=address, include_dashboard=False, logging_level=logging.WARNING)
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"workers.address={address}: no Ray cluster could be joined there ({_in_a_line(error)}). Start one of the "
            "same versions of Python and Ray, ray start --head, and give its address, or have one started on this "
            "machine by workers.address=local."
        ) from error
    return True


def leave() -> None:
    """Part from the cluster; one that `join` started ends."""
    import ray

    ray.shutdown()


def resources() -> tuple[dict[str, float], dict[str, float]]:
    """Return what the cluster has in all, and what of it is free: ``CPU``, ``GPU`` and others."""
    import ray

    return ray.cluster_resources(), ray.available_resources()


def check_resources(workers: int, share: Share, total: Mapping[str, float], free: Mapping[str, float]) -> None:
    """Refuse to wait for what a cluster does not have.

    Args:
        workers: how many.
        share: of each.
        total: resources of the cluster.
        free: what of them nobody uses.

    Raises:
        ValueError: the message gives what is needed and what is there.
    """
    for name, setting, each in (("CPU", "workers.cpus", share.cpus), ("GPU", "workers.gpus", share.gpus)):
        there, needed = free.get(name, 0.0), workers * each
        if needed > there:
            raise ValueError(
                f"num_workers={workers} with {setting}={each:g} need {needed:g} {name}s, and the Ray cluster has "
                f"{total.get(name, 0.0):g}, of which {there:g} are free: lower num_workers or {setting}, or add nodes "
                "to the cluster."
            )


def start_workers(
    make_env: Callable[[], EnvBase],
    policy: DreamerPolicy,
    *,
    workers: int,
    share: Share,
    env_device: str,
    frames: int,
    seed: int,
) -> RayCollector:
    """Start workers on the cluster that was joined, as many Ray actors, each a `RayWorker`.

    Args:
        make_env: makes the worlds of one worker, ``[N/W]``, with the keys that the policy reads; can be pickled.
        policy: what flies them, on the CPU; each worker has a copy.
        workers: W.
        share: of each.
        env_device: where its worlds live.
        frames: N/W · T, env_steps of a worker's rollout.
        seed: worker w draws from ``seed`` + 1,000,000 (w + 1), plus the number of the round it begins with.

    Returns:
        TorchRL's collector of them, to be given to `RayRollouts`.

    Raises:
        ValueError: there is not enough of something, or a node has other versions, or a worker cannot begin.
    """
    import ray
    from torchrl.collectors.distributed import RayCollector

    _await_room(workers, share)
    check_nodes(make_env, policy)
    try:
        return RayCollector(
            make_env,
            policy,
            frames_per_batch=frames,
            num_collectors=workers,
            collector_class=RayWorker,
            collector_kwargs=[
                {"seed": seed + SEEDS_APART * (worker + 1), "track_traj_ids": False} for worker in range(workers)
            ],
            remote_configs={"num_cpus": share.cpus, "num_gpus": share.gpus, "max_restarts": -1, "max_task_retries": -1},
            weight_sync_schemes={},
            policy_device=share.device,
            env_device=env_device,
            storing_device="cpu",
        )
    except ray.exceptions.RayActorError as error:
        raise ValueError(
            f"collector=ray: a worker could not begin ({_in_a_line(error, last=True)}). Its worlds are made there as "
            "they would be here: look for what that node lacks, e.g. a renderer (env.renderer=)."
        ) from error


def check_nodes(*parts: object) -> None:
    """Refuse nodes that could not have a worker: Ray would begin one there again and again.

    Args:
        parts: what a worker is made of, which every node must be able to unpickle.

    Raises:
        ValueError: the message names the node, and what is wrong there.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    ask = ray.remote(num_cpus=0, max_retries=0)(_versions_with)
    nodes = {node["NodeID"]: node["NodeManagerHostname"] for node in ray.nodes() if node["Alive"]}
    there = {node: NodeAffinitySchedulingStrategy(node, soft=False) for node in nodes}
    answers = {node: ask.options(scheduling_strategy=there[node]).remote(*parts) for node in nodes}
    for node, name in nodes.items():
        try:
            found = ray.get(answers[node])
        except ray.exceptions.RayError as error:
            raise ValueError(
                f"collector=ray: node {name} cannot have a worker ({_in_a_line(error, last=True)}). Every node of the "
                "cluster needs this project in the same version, at the same place or installed."
            ) from error
        check_versions(name, found, versions())


def check_versions(node: str, found: Mapping[str, str | None], here: Mapping[str, str | None]) -> None:
    """Refuse a node of other versions.

    Args:
        node: its name.
        found: there.
        here: in this process.

    Raises:
        ValueError: the message names the node, and both versions.
    """
    if others := [f"{name} {found.get(name)} (here {own})" for name, own in here.items() if found.get(name) != own]:
        raise ValueError(
            f"collector=ray: node {node} has {', '.join(others)}. Install the same there, or choose another cluster by "
            "workers.address."
        )


def _versions_with(*parts: object) -> dict[str, str | None]:
    """Return versions, where the parts could be unpickled."""
    return versions()


def _await_room(workers: int, share: Share) -> None:
    """Check resources, once those of a run that has just ended are back."""
    for _ in range(10):
        with suppress(ValueError):
            return check_resources(workers, share, *resources())
        time.sleep(0.5)
    return check_resources(workers, share, *resources())


def _in_a_line(error: Exception, last: bool = False) -> str:
    """The first words of an error's message, or its last line, where a traceback ends."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if last else " ".join(lines))[:300].rstrip(".") if lines else type(error).__name__
