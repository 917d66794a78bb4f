"""What a collector carries from rollout to rollout, as a part of a checkpoint."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.experience.collector_state import CollectorState


def collector(num_envs: int, value: float) -> SimpleNamespace:
    """What of a collector is read: the step that it goes on from."""
    columns = {
        "belief": torch.full((num_envs, 2), value),
        "is_init": torch.zeros(num_envs, 1, dtype=torch.bool),
        "collector": TensorDict({"traj_ids": torch.arange(num_envs)}, [num_envs]),
    }
    return SimpleNamespace(_carrier=TensorDict(columns, [num_envs]))


def test_a_collector_goes_on_from_where_another_was():
    saved, other = CollectorState(collector(3, 1.0)).state_dict(), collector(3, 0.0)
    assert set(saved) == {"belief", "is_init"}, "trajectories are counted anew"
    CollectorState(other).load_state_dict(saved)
    assert torch.equal(other._carrier["belief"], torch.ones(3, 2))


def test_another_number_of_environments_is_refused_with_the_right_one():
    with pytest.raises(ValueError, match=r"of 3 environments, this run has 2: set env\.num_envs=3"):
        CollectorState(collector(2, 0.0)).load_state_dict(CollectorState(collector(3, 1.0)).state_dict())
