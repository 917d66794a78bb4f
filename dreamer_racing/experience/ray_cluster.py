"""A Ray cluster to collect on: joining it, what it must have, and starting workers there.

Everything that a person can mend is refused here, before the first rollout, in a paragraph.
"""

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

if TYPE_CHECKING:  # which imports Ray where it is installed, and that takes a second
    from torchrl.collectors.distributed import RayCollector

logger = logging.getLogger(__name__)

SEEDS_APART = 1_000_000
"""Between the seeds of two workers."""
KNOCK, TRY = 5.0, 120.0  # s to wait for an answer of a cluster's head, and of each node that a worker can be had there


@dataclass
class WorkersConfig:
    """Workers on a Ray cluster, with `collector=ray`."""

    cpus: float = setting(1.0, POSITIVE)  # cores of each, may be a part of one; as many threads draw and step worlds
    gpus: float = setting(0.0, NOT_NEGATIVE)  # of each, a part of one or whole ones; its policy and worlds live there
    # local: a cluster started on this machine, for this run | auto: one that runs here | host:port of one
    address: str = "local"
    # env_steps that weights are old at most when what was flown with them is learned from; null: two rounds, the least
    weight_interval: int | None = setting(None, COUNT)
    patience: float = setting(600.0, POSITIVE)  # s to wait for a round, before the run is saved and ends

    @property
    def device(self) -> str:
        """Where a worker's policy lives."""
        return "cuda" if self.gpus else "cpu"

    def check(self) -> None:
        """Refuse parts of several GPUs.

        Raises:
            ValueError: the message gives the next number that can be.
        """
        if self.gpus > 1 and self.gpus % 1:
            raise ValueError(
                f"workers.gpus={self.gpus:g}: Ray gives a worker a part of one GPU or whole ones, e.g. "
                f"workers.gpus={math.floor(self.gpus)}."
            )


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
        _knock(address)
        ray.init(address=address, include_dashboard=False, logging_level=logging.WARNING)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise ValueError(
            f"workers.address={address}: no Ray cluster could be joined there ({in_a_line(error)}). Start one of the "
            "same versions of Python and Ray, ray start --head, and give its address, or have one started on this "
            "machine by workers.address=local."
        ) from error
    return True


def _knock(address: str) -> None:
    """Raise ``OSError`` if nobody answers at ``host:port``, where Ray would try for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), KNOCK).close()


def leave() -> None:
    """Part from the cluster; one that `join` started ends."""
    import ray

    ray.shutdown()


def resources() -> tuple[list[dict[str, float]], dict[str, float]]:
    """Return what each node of the cluster has, and what of all of it is free: ``CPU``, ``GPU`` and others."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]], ray.available_resources()


def check_resources(
    workers: int, share: WorkersConfig, nodes: Sequence[Mapping[str, float]], free: Mapping[str, float]
) -> None:
    """Refuse to wait for what a cluster does not have.

    Args:
        workers: how many.
        share: of each.
        nodes: resources of each node.
        free: what of them all nobody uses.

    Raises:
        ValueError: the message gives what is needed and what is there.
    """
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
            f"be spread over nodes or GPUs, and there is room for {room} of them on the cluster's {len(nodes)} nodes. "
            "Lower num_workers, or the share of each so that several fit."
        )


def places(share: WorkersConfig, node: Mapping[str, float]) -> int:
    """How many workers a node with such resources can have, if nothing else is there.

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
        raise ValueError(f"collector=ray: a worker could not begin ({in_a_line(error, last=True)}).") from error


def check_nodes(share: WorkersConfig, make_env: Callable[[], EnvBase], policy: DreamerPolicy) -> None:
    """Refuse nodes that could not have a worker: Ray would begin one there again and again, without a word.

    Args:
        share: of each worker.
        make_env: makes its worlds; every node must be able to.
        policy: what flies them; every node must be able to unpickle it.

    Raises:
        ValueError: the message names the node, and what is wrong there.
    """
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
            found = ray.get(answer, timeout=TRY)
        except ray.exceptions.GetTimeoutError:
            ray.cancel(answer, force=True)
            logger.warning("node %s had no room within %.0f s to see whether a worker can be had there", name, TRY)
            continue
        except ray.exceptions.RayError as error:
            raise ValueError(
                f"collector=ray: node {name} cannot have a worker ({in_a_line(error, last=True)}). Every node of the "
                "cluster needs this project in the same version at the same path, and all that worlds are made of "
                "here, e.g. a renderer (env.renderer=)."
            ) from error
        check_versions(name, found, here)


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


def _try_out(make_env: Callable[[], EnvBase], policy: DreamerPolicy) -> dict[str, str | None]:
    """Make the worlds of a worker, where the policy could be unpickled, too; return versions."""
    make_env().close()
    return versions()


def _await_room(workers: int, share: WorkersConfig) -> None:
    """Check resources, once those of a run that has just ended are back."""
    for left in reversed(range(10)):
        try:
            check_resources(workers, share, *resources())
        except ValueError:
            if not left:
                raise
            time.sleep(0.5)
        else:
            return


def in_a_line(error: Exception, last: bool = False) -> str:
    """The first words of an error's message, or its last line, where a traceback ends."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))  # colours
    lines = [line.strip() for line in plain.splitlines() if line.strip()]
    return (lines[-1] if last else " ".join(lines))[:300].rstrip(".") if lines else type(error).__name__
