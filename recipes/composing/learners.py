"""The learner of a configuration, and what of it a schedule moves."""

from dataclasses import replace

import torch

from composing.schema import DreamerConfig, PPORunConfig, RunConfig, SACRunConfig
from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.dreamer import make_dreamer
from dreamer_racing.learners.learner import Learner
from dreamer_racing.losses import WORLD_MODEL_LOSSES, find_loss
from dreamer_racing.modules import Agent, Interface, ModelSize, get_size
from dreamer_racing.training.pass_share import PassShare
from dreamer_racing.training.schedule import Clock


def clock_times(config: DreamerConfig, env_steps: int, passes: PassShare) -> dict[Clock, float]:
    """What the clocks of schedules say after so many env_steps of a run."""
    return {Clock.run: env_steps / config.total_env_steps, Clock.passes: passes.best}


def scheduled(config: DreamerConfig, times: dict[Clock, float]) -> dict[str, float]:
    """Arguments of `DreamerLearner.adjust` at what the clocks say."""
    schedule, loss = config.schedule, config.loss
    now = {
        "rates": (schedule.learning_rates, 1.0),
        "discount": (schedule.discount, loss.discount),
        "entropy_scale": (schedule.entropy_scale, loss.entropy_scale),
        "min_std": (schedule.min_std, loss.min_std),
        "noise_correlation": (schedule.noise_correlation, loss.noise_correlation),
    }
    return {name: ramp.at(value, times) for name, (ramp, value) in now.items()}


def size_of(config: DreamerConfig) -> ModelSize:
    """The networks' size, and what their states are."""
    return replace(get_size(config.model.size), sampled=config.model.sampled)


def make_agent(config: DreamerConfig, interface: Interface) -> Agent:
    """Make the networks of a resolved configuration, with initial weights from torch's generator."""
    decodes = find_loss(WORLD_MODEL_LOSSES, config.loss.world_model).decodes
    return Agent(size_of(config), interface, decodes, config.loss.min_std).to(config.device)


def make_learner(config: RunConfig, interface: Interface, device: torch.device | str) -> Learner:
    """Make the learner of a recipe's configuration."""
    if isinstance(config, DreamerConfig):
        model = config.model
        return make_dreamer(
            size_of(config),
            interface,
            config.loss,
            model,
            horizon=model.imagination_horizon,
            device=device,
            seed=config.seed,
        )
    assert isinstance(config, (PPORunConfig, SACRunConfig))
    size = NetworkSize(config.network.layers, config.network.units)
    if isinstance(config, SACRunConfig):
        return SACLearner(size, interface, config.sac, device, config.seed)
    return PPOLearner(size, interface, config.ppo, device, config.seed)
