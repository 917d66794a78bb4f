"""The learner of a configuration, and what of it a schedule moves."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf

from composing.arena import Environment
from composing.saved import read_yaml
from composing.schema import (
    LOSS_RAMPS,
    DreamerV3RunConfig,
    LatentPPORunConfig,
    NetworkConfig,
    PPORunConfig,
    RunConfig,
    SACRunConfig,
    WorldModelRunConfig,
)
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.onnx_actor import CONTRACT, read_contract
from dreamer_racing.export.shipped_agent import check_env, is_agent, load_networks
from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.learners.learner import Learner
from dreamer_racing.learners.saved import check_size
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import find_targets
from dreamer_racing.modules import Agent, Interface, ModelSize, get_size
from dreamer_racing.training.checkpoint import load_state
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.schedule import Schedule

IN_CHECKPOINTS = ("min_std", "max_std")
"""Numbers of the losses that the networks hold: what a checkpoint brings of another run gives way to this one's."""


def make_schedule(config: WorldModelRunConfig, env: Environment | None = None) -> Schedule:
    """Make the schedule of what a learner's `adjust` takes, by its names, and of `start_on_line`.

    Args:
        config: resolved.
        env: whose gates some ramps go by; None, where what is restored has counted them.
    """
    schedule, loss = config.schedule, config.loss
    ramps = {"rates": (1.0, schedule.learning_rates), "world_model_rate": (1.0, schedule.world_model_rate)}
    for name in LOSS_RAMPS:
        ramp = getattr(schedule, name)
        if ramp.to is not None or name in IN_CHECKPOINTS:
            ramps[name] = (getattr(loss, name), ramp)
    if isinstance(config, LatentPPORunConfig) and (kl_target := config.loss.ppo.kl_target) is not None:
        ramps["kl_target"] = (kl_target, config.schedule.kl_target)
    if isinstance(config, DreamerV3RunConfig) and config.schedule.imagination_horizon.to is not None:
        ramps["imagination_horizon"] = (config.model.imagination_horizon, config.schedule.imagination_horizon)
    if schedule.start_on_line.to is not None:
        ramps["start_on_line"] = (config.env.start_on_line, schedule.start_on_line)
    num_gates = env.track.num_gates if isinstance(env, DroneRacingEnv) else 0
    return Schedule(ramps, config.total_env_steps, num_gates)


def move_starts(env: Environment, scheduled: dict[str, float]) -> dict[str, float]:
    """Set the share of episodes that begin on a line, if it is scheduled; return the other numbers."""
    numbers = dict(scheduled)
    if (share := numbers.pop("start_on_line", None)) is not None:
        cast(DroneRacingEnv, env).worlds.start_on_line = share
    return numbers


def size_of(config: WorldModelRunConfig) -> ModelSize:
    """The networks' size, and what their states are."""
    return replace(get_size(config.model.size), sampled=config.model.sampled, state_std=config.model.state_std)


def make_agent(config: WorldModelRunConfig, interface: Interface) -> Agent:
    """Make the networks of a resolved configuration, with initial weights from torch's generator."""
    decodes = any(target.decodes for target in find_targets(config.loss.world_model))
    return Agent(size_of(config), interface, decodes, config.loss.min_std, config.loss.max_std).to(config.device)


def begin_with(learner: WorldModelLearner, config: WorldModelRunConfig, env: Environment) -> str:
    """Give a new learner the weights that ``init_from`` names; return a line on what that was.

    Raises:
        FileNotFoundError: there is no such run, checkpoint or agent.
        ValueError: its networks are of another size, or were trained with another camera, control rate or loss; or its
            configuration is damaged.
    """
    source = str(config.init_from)
    folder = existing_agent_path("init_from", source)
    if not is_agent(folder):
        saved = read_yaml(RunDirectory.of(latest_checkpoint(folder)).config, DictConfig)
        for name in ("env.control_rate", "env.camera_rate", "env.camera_tilt", "env.imu", "env.vector"):
            there, here = OmegaConf.select(saved, name), OmegaConf.select(OmegaConf.structured(config), name)
            if there != here:
                raise ValueError(f"{name}={here}: init_from={source} was trained with {name}={there}; give that.")
        state, metadata = load_state(folder, "learner")
        unmatched = learner.adopt(state)
        kind = "the averaged ones" if "averaged" in state else "all those"
        line = f"weights: {kind} of {folder} at {metadata['env_steps']:,} env_steps (init_from=), heads and critic, too"
        if unmatched.anew:
            line += f"; {' and '.join(unmatched.anew)}, which that run had not, begins anew"
        return line + (f"; left behind: {' and '.join(unmatched.left)}" if unmatched.left else "")
    contract = read_contract(folder / CONTRACT)
    check_size(contract["model"], learner.size)
    if not isinstance(env, DroneRacingEnv):
        raise ValueError(f"init_from={source}: this agent races; there is no race here.")
    check_env(folder, contract, env)
    for agent in filter(None, (learner.agent, learner.averaged)):
        load_networks(folder, agent)
    return f"weights: encoder, RSSM and actor of {folder} (init_from=); heads and critic begin anew"


def make_learner(
    config: RunConfig, interface: Interface, device: torch.device | str, seed: int | None = None
) -> Learner:
    """Make the learner of a recipe's configuration, to train or to be restored.

    Args:
        config: resolved.
        interface: what is seen and done.
        device: where it computes.
        seed: of the initial weights; the run's if None.
    """
    seed = config.seed if seed is None else seed
    if isinstance(config, DreamerV3RunConfig):
        return DreamerV3.make(size_of(config), interface, config.loss, config.model, device=device, seed=seed)
    if isinstance(config, LatentPPORunConfig):
        return LatentPPO.make(size_of(config), interface, config.loss, config.model, device=device, seed=seed)
    if isinstance(config, PPORunConfig):
        return PPOLearner(network_size(config.network), interface, config.ppo, device, seed)
    if isinstance(config, SACRunConfig):
        return SACLearner(network_size(config.network), interface, config.sac, device, seed)
    raise NotImplementedError(f"make_learner() knows no learner of a {type(config).__name__}: add a branch for it.")


def network_size(config: NetworkConfig) -> NetworkSize:
    """The hidden layers of a resolved configuration."""
    return NetworkSize(config.layers, config.units)
