"""Who flies to learn: this process, in turns with learning or beside it, or workers on a Ray cluster."""

import copy
from functools import partial
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.envs import TensorDictPrimer, TransformedEnv

from composing.arena import Environment, make_env, worlds_device
from composing.building import make_collector
from composing.learners import make_agent
from composing.schema import CollectorKind, WorldModelRunConfig, is_race
from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.experience import ray_cluster
from dreamer_racing.experience.overlapped import OverlappedRollouts, acting_copy
from dreamer_racing.experience.ray_rollouts import RayRollouts
from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.learners.learner import seeded
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.modules import DreamerPolicy, Interface

NUM_WORKERS = 2
OF_RACES = ("body_rate_weight", "worlds.start_on_line")
"""What a run changes in its race on the way, by the curriculum and by a schedule."""


def resolve_workers(config: DictConfig) -> None:
    """Say how many workers there are, where that is left open; a run that goes on without any needs no number."""
    if config.collector is CollectorKind.ray:
        config.num_workers = NUM_WORKERS if config.num_workers is None else config.num_workers
    elif config.resume:
        default = OmegaConf.structured(ray_cluster.WorkersConfig)
        left_out = [] if config.num_workers is None else [f"num_workers={config.num_workers}"]
        left_out += [f"workers.{name}={value}" for name, value in config.workers.items() if value != default[name]]
        if left_out:
            print(f"workers: none (collector={config.collector.value}); left out: {', '.join(left_out)}")
        config.num_workers, config.workers = None, default


def make_own_env(config: WorldModelRunConfig) -> Environment:
    """Make the environment of this process: its worlds to train in, or where workers fly, one to take their measure."""
    return make_env(config, num_envs=1 if config.collector is CollectorKind.ray else None)


def make_rollouts(config: WorldModelRunConfig, env: Environment, learner: WorldModelLearner) -> Rollouts:
    """Make what is collected.

    Raises:
        ValueError: workers cannot be had; the message says what was found.
    """
    policy = learner.policy()
    if config.collector is CollectorKind.ray:
        return make_workers(config, env, policy)
    if config.collector is CollectorKind.local:
        return Rollouts(make_collector(config, env, policy))
    acting = acting_copy(policy)
    return OverlappedRollouts(make_collector(config, env, acting), acting, policy)


def make_workers(config: WorldModelRunConfig, env: Environment, policy: DreamerPolicy) -> RayRollouts:
    """Start workers on a Ray cluster, each with its share of the worlds."""
    asked, workers, own = config.workers, cast(int, config.num_workers), share_of_worker(config)
    print(
        f"workers: {workers} on Ray (workers.address={asked.address}), each with {own.env.num_envs} worlds on "
        f"{own.env.device}, {asked.cpus:g} CPUs and {asked.gpus:g} GPUs; weights at most {config.weight_interval:,} "
        "env_steps old; they and their worlds take half a minute to begin",
        flush=True,
    )
    with seeded(config.seed):
        agent = make_agent(own, Interface.of(env))  # its weights come with the first request
    flying = DreamerPolicy(agent.world_model, agent.actor)
    joined = ray_cluster.join(asked.address)
    collector = ray_cluster.start_workers(
        partial(make_worker_env, own, flying.make_primer()),
        flying,
        workers=workers,
        share=asked,
        env_device=own.env.device,
        frames=own.env.num_envs * config.rollout_steps,
        seed=config.seed,
    )
    return RayRollouts(
        collector,
        policy,
        env,
        OF_RACES if is_race(config) else (),
        weight_interval=config.weight_interval,
        patience=asked.patience,
        leaves=joined,
    )


def share_of_worker(config: WorldModelRunConfig) -> WorldModelRunConfig:
    """What one worker has of a run."""
    own = copy.deepcopy(config)
    own.env.num_envs = config.env.num_envs // cast(int, config.num_workers)
    own.device = "cpu"  # where its policy comes from; the collector takes it to the worker's device
    own.env.device = worlds_device(torch.device("cuda" if config.workers.gpus else "cpu"), config.env)
    return own


def make_worker_env(config: WorldModelRunConfig, primer: TensorDictPrimer) -> TransformedEnv:
    """Make a worker's worlds, there."""
    return with_memory(make_env(config, num_threads=max(1, int(config.workers.cpus))), primer)
