"""A recorded flight for comparisons: what the policy does about observations that are given."""

from __future__ import annotations

import numpy as np
import torch

from dreamer_racing.export.parity import RecordedFlight
from dreamer_racing.modules import Agent, DreamerPolicy


def answered(agent: Agent, observations: np.ndarray, is_init: np.ndarray) -> RecordedFlight:
    """The flight in which the deterministic policy sees these, ``(T, ...)``, and episodes begin there, ``(T,)``."""
    policy = DreamerPolicy(agent.world_model, agent.actor, deterministic=True)
    (key,) = agent.interface.observation_keys[:1]
    belief, state = (value.detach() for value in agent.world_model.rssm.initial())
    action, actions = torch.zeros(1, agent.interface.action_dim), []
    for seen, begins in zip(observations, is_init, strict=True):
        known = {key: torch.as_tensor(seen)[None], "is_init": torch.tensor([bool(begins)])}
        action, belief, state = policy.act(known | {"belief": belief, "state": state, "previous_action": action})
        actions.append(action[0].numpy())
    return RecordedFlight(observations, is_init, np.stack(actions))
