"""Divide a run among the processes that torchrun started, or its collection among workers on a Ray cluster."""

from __future__ import annotations

import copy
from functools import partial
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import TensorDictPrimer, TransformedEnv

from composing.building import Environment, make_collector, make_env, worlds_device
from composing.schema import CollectorKind, LatentPPORunConfig, WorldModelRunConfig, is_race, worker_settings
from dreamer_racing import parallel
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.experience import ray_cluster
from dreamer_racing.experience.ray_rollouts import RayRollouts
from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.modules import DreamerPolicy

DIVIDED = ("env.num_envs", "model.batch_size", "model.imagination_starts")
DIVIDED_PPO = ("loss.ppo.steps", "loss.ppo.minibatch")
"""Settings that are divided equally among the processes; `DIVIDED_PPO` in latent PPO only."""
ROUNDED_DOWN = ("replay.capacity", "replay.recent_records")  # divided too, but may leave a remainder
SEEDS_APART = 1_000_000  # of two processes; initial weights have the run's seed in all of them


def share_of(config: WorldModelRunConfig) -> WorldModelRunConfig:
    """Return this process's share of a resolved and checked configuration; a single process has all of it."""
    processes = parallel.num_processes()
    if processes == 1:
        return config
    parallel.check_devices({"device": config.device, "env.device": config.env.device})
    if not isinstance(config, LatentPPORunConfig) and config.model.cuda_graph:
        raise ValueError(
            f"model.cuda_graph=true: {config.algorithm} exchanges imagined returns between {processes} processes "
            "during an update. Set it to false, or use recipes/latent_ppo.py, which does not imagine."
        )
    shared = OmegaConf.structured(config)
    for name in DIVIDED + (DIVIDED_PPO if isinstance(config, LatentPPORunConfig) else ()) + ROUNDED_DOWN:
        whole = OmegaConf.select(shared, name)
        if whole is None:
            continue
        if whole % processes and name not in ROUNDED_DOWN:
            raise ValueError(
                f"{name}={whole} cannot be shared equally by {processes} processes: make it a multiple of {processes}, "
                f"e.g. {name}={-(-whole // processes) * processes}, or change --nproc-per-node."
            )
        OmegaConf.update(shared, name, whole // processes)
    own = cast(WorldModelRunConfig, OmegaConf.to_object(shared))
    assert config.replay.held_out is not None, "resolve() sets it"
    if config.replay.held_out >= own.env.num_envs:
        raise ValueError(
            f"replay.held_out={config.replay.held_out}: the first process has only {own.env.num_envs} of "
            f"env.num_envs={config.env.num_envs} worlds: hold out fewer, or raise env.num_envs."
        )
    own.replay.held_out = config.replay.held_out if parallel.is_first() else 0
    own.seed = (config.seed + parallel.rank() * SEEDS_APART) % 2**32
    own.device, own.env.device = (parallel.own_device(device) for device in (config.device, config.env.device))
    print(f"processes: {processes}, each with {own.env.num_envs} worlds and {own.model.batch_size} windows of a batch;")
    print(f"  process r uses seed {config.seed} + {SEEDS_APART:,} r")
    return own


NUM_WORKERS = 2
SYNCED_RACE_ATTRIBUTES = ("body_rate_weight", "worlds.start_on_line")
"""Attributes of a race's environment that the curriculum and a schedule change during the run."""


def resolve_workers(config: DictConfig) -> None:
    """Fill in the number of workers; a run that is resumed without workers loses their settings, which is printed."""
    if config.collector is CollectorKind.ray:
        config.num_workers = NUM_WORKERS if config.num_workers is None else config.num_workers
    elif config.resume:
        if left_out := worker_settings(config):
            print(f"workers: none (collector={config.collector.value}); ignored: {', '.join(left_out)}")
        config.num_workers, config.workers = None, OmegaConf.structured(ray_cluster.WorkersConfig)


def make_own_env(config: WorldModelRunConfig) -> Environment:
    """Make this process's environment: its worlds, or if workers collect, a single one that the learner is made for."""
    return make_env(config, num_envs=1 if config.collector is CollectorKind.ray else None)


def make_rollouts(config: WorldModelRunConfig, env: Environment, learner: WorldModelLearner) -> Rollouts:
    """Make the source of rollouts: a collector in this process, or workers."""
    policy = learner.policy()
    if config.collector is CollectorKind.ray:
        return make_workers(config, env, policy)
    return Rollouts(make_collector(config, env, policy))


def make_workers(config: WorldModelRunConfig, env: Environment, policy: DreamerPolicy) -> RayRollouts:
    """Start workers on a Ray cluster, each with its share of the worlds."""
    asked, workers, own = config.workers, cast(int, config.num_workers), copy.deepcopy(config)
    own.env.num_envs = config.env.num_envs // workers
    own.env.device = worlds_device(torch.device(asked.device), config.env)
    print(
        f"workers: {workers} on Ray (workers.address={asked.address}), each with {own.env.num_envs} worlds on "
        f"{own.env.device}, {asked.cpus:g} CPUs and {asked.gpus:g} GPUs; weights at most {config.weight_interval:,} "
        "env_steps old; starting them takes half a minute",
        flush=True,
    )
    flying = copy.deepcopy(policy).cpu()  # the collector moves it to the worker's device
    joined = ray_cluster.join(asked.address)
    worlds, frames = own.env.device, own.env.num_envs * config.rollout_steps
    make_worlds = partial(make_worker_env, own, flying.make_primer())
    collector = ray_cluster.start_workers(
        make_worlds, flying, workers=workers, share=asked, env_device=worlds, frames=frames, seed=config.seed
    )
    synced, oldest = SYNCED_RACE_ATTRIBUTES if is_race(config) else (), config.weight_interval
    return RayRollouts(collector, policy, env, synced, weight_interval=oldest, patience=asked.patience, leaves=joined)


def make_worker_env(config: WorldModelRunConfig, primer: TensorDictPrimer) -> TransformedEnv:
    """Make a worker's environment, in the worker's process."""
    return with_memory(make_env(config, num_threads=max(1, int(config.workers.cpus))), primer)
