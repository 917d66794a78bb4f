"""The share of gates passed, by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.training.pass_share import MEMORY, PassShare


def episodes(gates: list[int], crashes: list[int]) -> TensorDict:
    return TensorDict({"gates_passed": torch.tensor(gates), "crash": torch.tensor(crashes)}, [len(gates)])


def test_an_episode_fails_at_most_at_one_gate():
    passes = PassShare()
    assert passes.share == 0.0
    assert passes.update(episodes([2, 0, 3], [1, 3, 0])) == pytest.approx(5 / 7)  # the last ran out of time
    assert passes.update(episodes([], [])) == pytest.approx(5 / 7)
    assert passes.update(TensorDict({}, [3])) == pytest.approx(5 / 7)  # episodes of no race


def test_the_best_counts_after_a_hundred_episodes_and_never_goes_back():
    passes = PassShare()
    passes.add(gates=99.0, crashes=0.0, episodes=99)
    assert passes.best == 0.0
    passes.add(gates=30.0, crashes=0.0, episodes=30)
    assert passes.best == 1.0
    passes.add(gates=0.0, crashes=1000.0, episodes=1000)
    assert passes.share < 0.1 and passes.best == 1.0


def test_old_episodes_are_forgotten():
    passes = PassShare()
    passes.add(gates=1000.0, crashes=0.0, episodes=1000)
    for _ in range(20):
        passes.add(gates=0.5 * MEMORY / 20, crashes=0.5 * MEMORY / 20, episodes=MEMORY // 20)
    assert 0.5 < passes.share < 0.95
    resumed = PassShare()
    resumed.load_state_dict(passes.state_dict())
    assert (resumed.share, resumed.best) == (passes.share, passes.best)
