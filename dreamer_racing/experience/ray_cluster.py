"""Ray cluster for collection: connecting to it, checking its resources and versions, and starting workers."""

from __future__ import annotations

import importlib.util
import logging
import math
import os
import re
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torchrl.envs import EnvBase

from dreamer_racing.experience.ray_worker import RayWorker, versions
from dreamer_racing.modules import DreamerPolicy
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, POSITIVE, setting

if TYPE_CHECKING:  # it imports Ray, which takes a second
    from torchrl.collectors.distributed import RayCollector

logger = logging.getLogger(__name__)

SEEDS_APART = 1_000_000
"""Difference between the seeds of two workers."""
CONNECT_TIMEOUT = 5.0  # s for a cluster's head to answer
PROBE_TIMEOUT = 120.0  # s for each node to try out a worker


@dataclass
class WorkersConfig:
    """Workers on a Ray cluster, with `collector=ray`."""

    cpus: float = setting(1.0, POSITIVE)  # CPU cores per worker, also a fraction; its number of simulation threads
    gpus: float = setting(0.0, NOT_NEGATIVE)  # GPUs per worker for policy and environments: a fraction or whole ones
    # local: start a cluster on this machine for this run | auto: one that already runs here | host:port of a cluster
    address: str = "local"
    # maximum age of a rollout's weights, env_steps, when it has been learned from; null: two rounds, the minimum
    weight_interval: int | None = setting(None, COUNT)
    patience: float = setting(600.0, POSITIVE)  # seconds to wait for a round before the run is saved and ends

    @property
    def device(self) -> str:
        """Device of a worker's policy."""
        return "cuda" if self.gpus else "cpu"

    def check(self, frames: int) -> None:
        """Raise ``ValueError`` unless weights may be two rounds of ``frames`` old, and GPUs are whole or a fraction."""
        if self.gpus > 1 and self.gpus % 1:
            raise ValueError(
                f"workers.gpus={self.gpus:g}: a worker can have a fraction of one GPU or a whole number of GPUs, e.g. "
                f"workers.gpus={math.floor(self.gpus)}."
            )
        if self.weight_interval is not None and self.weight_interval < 2 * frames:
            raise ValueError(
                f"workers.weight_interval={self.weight_interval}: a round of all workers is {frames} env_steps, and is "
                f"collected while the learner trains on the one before. So weights are {2 * frames} env_steps old at "
                "its end: set at least that, or lower rollout_steps."
            )


def join(address: str) -> bool:
    """Connect to a Ray cluster, unless this process is connected already; return whether it was connected now.

    The address is that of `WorkersConfig`; a local cluster has all CPUs and GPUs of this machine.

    Raises:
        ValueError: Ray is not installed, or there is no such cluster, or it has other versions; the message says which.
    """
    if importlib.util.find_spec("ray") is None:
        raise ValueError(
            "collector=ray: Ray is not installed here. Install the extra, pip install -e '.[ray]', or collect in this "
            "process with collector=local."
        )
    import ray

    if ray.is_initialized():
        return False
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # send no usage statistics
    try:
        _check_reachable(address)
        ray.init(address=address, include_dashboard=False, logging_level=logging.WARNING)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise ValueError(
            f"workers.address={address}: cannot connect to a Ray cluster there ({in_a_line(error)}). Start one with "
            "the same versions of Python and Ray (ray start --head) and give its address, or start one on this machine "
            "with workers.address=local."
        ) from error
    return True


def _check_reachable(address: str) -> None:
    """Raise ``OSError`` if nothing answers at ``host:port``; Ray itself would retry for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_TIMEOUT).close()


def resources() -> tuple[list[dict[str, float]], dict[str, float]]:
    """Return the resources of each node, and the free resources of the cluster: ``CPU``, ``GPU`` and others."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]], ray.available_resources()


def check_resources(
    workers: int, share: WorkersConfig, nodes: Sequence[Mapping[str, float]], free: Mapping[str, float]
) -> None:
    """Raise ``ValueError`` unless a cluster of these nodes has the resources for all workers, a ``share`` each."""
    for name, option, each in (("CPU", "workers.cpus", share.cpus), ("GPU", "workers.gpus", share.gpus)):
        there, needed = free.get(name, 0.0), workers * each
        if needed > there:
            raise ValueError(
                f"num_workers={workers} with {option}={each:g} need {needed:g} {name}s, and the Ray cluster has "
                f"{sum(node.get(name, 0.0) for node in nodes):g}, of which {there:g} are free: lower num_workers or "
                f"{option}, or add nodes to the cluster."
            )
    if (room := sum(places(share, node) for node in nodes)) < workers:
        raise ValueError(
            f"num_workers={workers} with workers.cpus={share.cpus:g} and workers.gpus={share.gpus:g}: a worker cannot "
            f"be split over nodes or GPUs, and the cluster's {len(nodes)} nodes have room for {room} workers. Lower "
            "num_workers, workers.cpus or workers.gpus."
        )


def places(share: WorkersConfig, node: Mapping[str, float]) -> int:
    """Return the number of workers that fit on an otherwise empty node.

    Example:
        >>> places(WorkersConfig(cpus=2.0, gpus=0.6), {"CPU": 16.0, "GPU": 2.0})  # one on each GPU
        2
    """
    cpus, gpus = (round(node.get(name, 0.0), 4) for name in ("CPU", "GPU"))
    by_cpus = math.floor(cpus / share.cpus + 1e-6)
    if not share.gpus:
        return by_cpus
    on_one = math.floor(1.0 / share.gpus + 1e-6)
    by_gpus = math.floor(gpus) * on_one if on_one else math.floor(gpus / share.gpus)
    return min(by_cpus, by_gpus)


def start_workers(
    make_env: Callable[[], EnvBase],
    policy: DreamerPolicy,
    *,
    workers: int,
    share: WorkersConfig,
    env_device: str,
    frames: int,
    seed: int,
) -> RayCollector:
    """Start workers on the connected cluster, each a Ray actor of class `RayWorker`.

    Args:
        make_env: Makes the environments of one worker, ``[N/W]``, with the keys that the policy reads; picklable.
        policy: Policy on the CPU; each worker gets a copy.
        workers: W.
        share: Resources of each worker.
        env_device: Device of its environments.
        frames: N/W · T, env_steps of a worker's rollout.
        seed: Worker w is seeded with ``seed`` + 1,000,000 (w + 1) plus the number of its first round.

    Returns:
        TorchRL's collector of the workers, for `RayRollouts`.

    Raises:
        ValueError: Resources are missing, a node has other versions, or a worker cannot start.
    """
    import ray
    from torchrl.collectors.distributed import RayCollector

    _await_resources(workers, share)
    check_nodes(share, make_env, policy)
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
        raise ValueError(f"collector=ray: a worker could not start ({in_a_line(error, last=True)}).") from error


def check_nodes(share: WorkersConfig, make_env: Callable[[], EnvBase], policy: DreamerPolicy) -> None:
    """Raise ``ValueError`` unless every node can run a worker; otherwise Ray would restart it again and again."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    ask, here = ray.remote(max_retries=0)(_try_out), versions()
    asked = []
    for node in ray.nodes():
        if node["Alive"] and places(share, node["Resources"]):
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            options = ask.options(num_cpus=share.cpus, num_gpus=share.gpus, scheduling_strategy=there)
            asked.append((node["NodeManagerHostname"], options.remote(make_env, policy)))
    for name, answer in asked:
        try:
            found = ray.get(answer, timeout=PROBE_TIMEOUT)
        except ray.exceptions.GetTimeoutError:
            ray.cancel(answer, force=True)
            logger.warning("node %s was not checked, because its resources were in use for %.0f s", name, PROBE_TIMEOUT)
            continue
        except ray.exceptions.RayError as error:
            raise ValueError(
                f"collector=ray: node {name} cannot run a worker ({in_a_line(error, last=True)}). Every node of the "
                "cluster needs the same version of this project at the same path, and everything that environments use "
                "here, e.g. a renderer (env.renderer=)."
            ) from error
        check_versions(name, found, here)


def check_versions(node: str, found: Mapping[str, str | None], here: Mapping[str, str | None]) -> None:
    """Raise ``ValueError`` unless a node has the versions of this process; the message gives both."""
    if others := [f"{name} {found.get(name)} (here {own})" for name, own in here.items() if found.get(name) != own]:
        raise ValueError(
            f"collector=ray: node {node} has {', '.join(others)}. Install the same versions there, or choose another "
            "cluster with workers.address=."
        )


def _try_out(make_env: Callable[[], EnvBase], policy: DreamerPolicy) -> dict[str, str | None]:
    """Make a worker's environments on a node, after Ray has unpickled the policy there; return the node's versions."""
    make_env().close()
    return versions()


def _await_resources(workers: int, share: WorkersConfig) -> None:
    """Check resources repeatedly for some seconds, because a run that has just ended may still release some."""
    for left in reversed(range(10)):
        try:
            check_resources(workers, share, *resources())
            break
        except ValueError:
            if not left:
                raise
            time.sleep(0.5)


def in_a_line(error: Exception, last: bool = False) -> str:
    """Return the first 300 characters of an error's message, or of its last line, which follows a traceback."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))  # without colour codes
    lines = [line.strip() for line in plain.splitlines() if line.strip()]
    return (lines[-1] if last else " ".join(lines))[:300].rstrip(".") if lines else type(error).__name__
