"""The guard against losses that are not finite, alone; with a learner it is in ``test_dreamer_v3.py``."""

from __future__ import annotations

import math

import pytest
import torch

from dreamer_racing.learners.finite_guard import FiniteGuard, NonFiniteLossError


def test_a_lagging_guard_names_the_batch_that_was_bad():
    guard, names = FiniteGuard(lag=2), ("loss", "reward_error", "gradient_norm/actor")
    metrics = {name: torch.tensor(1.0) for name in names} | {"agreement": torch.tensor(math.nan)}
    for number in range(4):
        guard.check(metrics, number)
    guard.check(metrics | {"gradient_norm/actor": torch.tensor(math.inf)}, "bad")
    guard.check(metrics, 5)
    with pytest.raises(NonFiniteLossError) as error:
        guard.check(metrics, 6)
    assert error.value.batch == "bad"
