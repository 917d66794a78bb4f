"""The learner of a configuration, and what a run measures of it beside its updates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from composing.arena import Environment
from composing.saved import SEEN, read_yaml
from composing.schema import (
    LatentPPORunConfig,
    PPORunConfig,
    RunConfig,
    SACRunConfig,
    WorldModelRunConfig,
)
from dreamer_racing import parallel
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.evaluation.held_out import SEEN as OBSERVED
from dreamer_racing.evaluation.held_out import held_out_metrics, world_model_metrics
from dreamer_racing.experience.replay import StreamReplay
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
from dreamer_racing.training.model_lag import ModelLag
from dreamer_racing.training.session import Session

WINDOWS, RECORDS = 32, 2_000
"""Windows of records held out that are measured at a time, from the newest records of a world."""


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
        for name in SEEN:
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
    if isinstance(config, WorldModelRunConfig):
        kind = LatentPPO if isinstance(config, LatentPPORunConfig) else DreamerV3
        return kind.make(size_of(config), interface, config.loss, config.model, device=device, seed=seed)
    if isinstance(config, PPORunConfig):
        return PPOLearner(NetworkSize(config.network.layers, config.network.units), interface, config.ppo, device, seed)
    if isinstance(config, SACRunConfig):
        return SACLearner(NetworkSize(config.network.layers, config.network.units), interface, config.sac, device, seed)
    raise NotImplementedError(f"make_learner() knows no learner of a {type(config).__name__}: add a branch for it.")


def measure(
    session: Session, learner: WorldModelLearner, replay: StreamReplay, scheduled: Mapping[str, float]
) -> dict[str, Tensor | float]:
    """Return hyperparameters as they are now, and what the model makes of the newest records not trained on."""
    groups = zip(("world_model", "behavior"), learner.optimizer.param_groups, strict=True)
    numbers: dict[str, Any] = {f"schedule/{name}": value for name, value in scheduled.items()}
    numbers |= {f"learning_rate/{name}": group["lr"] for name, group in groups}
    windows = replay.held_out(WINDOWS, OBSERVED + learner.config.imagination_horizon, RECORDS)
    if windows is None or not session.counters["updates"]:
        return numbers
    with session.undisturbed():
        return numbers | held_out_metrics(learner, windows)


def measure_lag(
    session: Session, config: WorldModelRunConfig, learner: WorldModelLearner, replay: StreamReplay, lag: ModelLag
) -> dict[str, Tensor | float]:
    """Measure whether the model knows the records of the newest flights, before they are learned from."""
    length = config.model.batch_length
    if config.replay.context:  # begins warm: the newest rollout alone
        length = min(length, config.rollout_steps)
    if (windows := replay.newest(length)) is None:
        return {}
    with session.undisturbed():
        return lag.measured(parallel.averaged(world_model_metrics(learner, windows)))
