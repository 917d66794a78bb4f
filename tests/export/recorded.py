"""Agents to export, and recorded flights: what the policy does about observations that are given."""

from __future__ import annotations

import functools

import numpy as np
import torch

from dreamer_racing.export.parity import MIN_STEPS, RecordedFlight
from dreamer_racing.modules import Agent, DreamerPolicy, Interface, ModelSize, get_size


@functools.cache
def make_agent(size: ModelSize | str = "debug", interface: Interface | None = None) -> Agent:
    """An agent of random weights, all of which matter and none is zero: an untrained actor's last layer nearly is."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        agent = Agent(get_size(size), interface or Interface(), decode=False)
        for parameter in agent.actor.mlp.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
        agent.world_model.rssm.initial_belief.add_(torch.randn_like(agent.world_model.rssm.initial_belief))
        for parameter in agent.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    return agent.requires_grad_(False)


@functools.cache
def make_flight(agent: Agent, steps: int = MIN_STEPS) -> RecordedFlight:
    """The deterministic policy sees random observations; episodes begin every 40 steps, and once two in a row."""
    random = np.random.default_rng(0)
    interface = agent.interface
    if interface.pixels:
        observations = random.integers(0, 256, (steps, *interface.image_shape), np.uint8)
    else:
        observations = random.normal(size=(steps, interface.vector_dim)).astype(np.float32)
    is_init = np.arange(steps) % 40 == 0
    is_init[121] = True
    policy = DreamerPolicy(agent.world_model, agent.actor, deterministic=True)
    (key,) = interface.observation_keys[:1]
    belief, state = (value.detach() for value in agent.world_model.rssm.initial())
    action, actions = torch.zeros(1, interface.action_dim), []
    for seen, begins in zip(observations, is_init, strict=True):
        known = {key: torch.as_tensor(seen)[None], "is_init": torch.tensor([bool(begins)])}
        action, belief, state = policy.act(known | {"belief": belief, "state": state, "previous_action": action})
        actions.append(action[0].numpy())
    return RecordedFlight(observations, is_init, np.stack(actions))
