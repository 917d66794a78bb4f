"""The share that each process has of a run, where `torchrun` started several to train one agent.

A configuration says what all of them do together, and is kept so: env_steps, batch, replay and improvements of a run do
not depend on how many processes there are, and a run may go on with another number of them.
"""

from __future__ import annotations

import os
from typing import cast

import torch
from omegaconf import OmegaConf

from composing.schema import LatentPPORunConfig, WorldModelRunConfig
from dreamer_racing import parallel

DIVIDED = ("env.num_envs", "model.batch_size", "model.imagination_starts")
OF_PPO = ("loss.ppo.steps", "loss.ppo.minibatch")
"""What is divided among the processes, and must be divisible; the latter of actors that learn on-policy."""
ROUNDED_DOWN = ("replay.capacity", "replay.recent_records")
"""What is divided too, by worlds anyway."""
SEEDS_APART = 1_000_000
"""Between the seeds of two processes' worlds, samples and actions; initial weights have that of the run."""


def share_of(config: WorldModelRunConfig) -> WorldModelRunConfig:
    """What this process does of a run that is resolved and checked; of a single process, all of it.

    Raises:
        ValueError: what is to be shared does not divide, or the devices do not suffice.
    """
    processes = parallel.count()
    if processes == 1:
        return config
    check_devices(config)
    if not isinstance(config, LatentPPORunConfig) and config.model.cuda_graph:
        raise ValueError(
            f"model.cuda_graph=true: {config.algorithm} exchanges imagined returns of {processes} processes "
            "in the midst of an update. Set it to false, or use recipes/latent_ppo.py, which imagines nothing."
        )
    shared = OmegaConf.structured(config)
    for name in DIVIDED + (OF_PPO if isinstance(config, LatentPPORunConfig) else ()) + ROUNDED_DOWN:
        whole = OmegaConf.select(shared, name)
        if whole is None:
            continue
        if whole % processes and name not in ROUNDED_DOWN:
            raise ValueError(
                f"{name}={whole} cannot be shared equally by {processes} processes: make it a multiple of "
                f"{processes}, e.g. {name}={-(-whole // processes) * processes}, or start another number of them "
                "by --nproc-per-node."
            )
        OmegaConf.update(shared, name, whole // processes)
    own = cast(WorldModelRunConfig, OmegaConf.to_object(shared))
    assert config.replay.held_out is not None, "resolve() says"
    if config.replay.held_out >= own.env.num_envs:
        raise ValueError(
            f"replay.held_out={config.replay.held_out} worlds are of the first process, which has {own.env.num_envs} "
            f"of env.num_envs={config.env.num_envs}: hold out fewer, or raise env.num_envs."
        )
    own.replay.held_out = config.replay.held_out if parallel.is_first() else 0
    own.seed = (config.seed + parallel.rank() * SEEDS_APART) % 2**32
    own.device, own.env.device = (_own_device(device) for device in (config.device, config.env.device))
    print(f"processes: {processes}, each with {own.env.num_envs} worlds and {own.model.batch_size} windows of a batch;")
    print(f"  process r draws from seed {config.seed} + {SEEDS_APART:,} r")
    return own


def check_devices(config: WorldModelRunConfig) -> None:
    """Refuse more processes than CUDA devices on this machine, and to have them all on one."""
    here, there = parallel.count_here(), torch.cuda.device_count()
    for name, device in (("device", config.device), ("env.device", config.env.device)):
        if not device.startswith("cuda"):
            continue
        if ":" in device:
            raise ValueError(
                f"{name}={device} would have all {parallel.count()} processes on one device: with {name}=cuda each has "
                "its own; CUDA_VISIBLE_DEVICES chooses which."
            )
        if here > there:
            raise ValueError(
                f"{name}={device} needs a CUDA device for each of the {here} processes on this machine, which has "
                f"{there}: start torchrun with --nproc-per-node={max(there, 1)}, or set {name}=cpu."
            )


def _own_device(device: str) -> str:
    """The device of this process, of a kind."""
    return f"cuda:{os.environ['LOCAL_RANK']}" if device.startswith("cuda") else device
