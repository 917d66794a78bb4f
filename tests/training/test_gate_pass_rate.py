"""The share of flights that pass the hardest gate, by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.training.gate_pass_rate import KNOWN, MEMORY, PACE, GatePassRate


def episodes(gates: list[int], targets: list[int], crashes: list[int]) -> TensorDict:
    columns = {"gates_passed": gates, "target_gate": targets, "crash": crashes}
    return TensorDict({name: torch.tensor(column, dtype=torch.int64) for name, column in columns.items()}, [len(gates)])


def test_an_episode_counts_the_gates_after_its_first():
    passes = GatePassRate(3)
    assert passes.share == 0.0
    passes.update(episodes([3], [0], [1]), 0)  # from gate 0 on: 0 does not count, 1 and 2 are passed, crash before 0
    assert passes.shares.tolist() == [0.0, 1.0, 1.0]
    assert passes.share == 0.0 and passes.hardest_gate == 0
    passes.update(episodes([], [], []), 0)
    passes.update(episodes([0, 1], [0, 1], [1, 0]), 0)  # a crash before the first gate, and time that ran out after it
    assert passes.shares.tolist() == [0.0, 1.0, 1.0]


def test_laps_count_each_pass():
    passes = GatePassRate(3)
    passes.update(episodes([7, 1, 1], [2, 1, 1], [0, 2, 3]), 0)  # 1, then 2 0 1 2 0 1; twice 0 and a crash at 1
    assert passes.shares.tolist() == pytest.approx([1.0, 2 / 4, 1.0], abs=0.01)
    assert passes.share == pytest.approx(0.5, abs=0.01) and passes.hardest_gate == 1


def test_where_there_are_no_gates_the_share_stays_0():
    passes = GatePassRate(0)
    assert passes.update(TensorDict({}, [3]), 0) == 0.0 and passes.best == 0.0


def test_the_best_counts_once_each_gate_was_tried_and_never_goes_back():
    passes = GatePassRate(2)
    passes.update(episodes([150, 2], [0, 0], [0, 0]), 0)
    assert passes.best == 0.0  # 75 attempts at each
    for _ in range(4):
        passes.update(episodes([150], [0], [0]), 0)
    assert passes.best == 1.0
    passes.update(episodes([1] * 1000, [0] * 1000, [1] * 1000), 0)
    assert passes.share < 0.1 and passes.best == 1.0


def test_once_the_hardest_gate_is_known_its_clock_goes_on_by_itself():
    passes = GatePassRate(2)
    for _ in range(4):
        passes.update(episodes([150, 149], [0, 1], [0, 1]), 500)  # past both, but for a crash now and then
    assert passes.best > KNOWN and passes.known_since == 500
    passes.best = 0.5
    passes.update(episodes([2], [0], [0]), 700)
    assert passes.known_since == 500
    passes.best = 0.5
    assert passes.known(510, 1000) == 0.5  # 0.43 by time
    assert passes.known(600, 1000) == pytest.approx(KNOWN + 0.1 * PACE)
    resumed = GatePassRate(0)
    resumed.load_state_dict(passes.state_dict())
    assert resumed.known(600, 1000) == passes.known(600, 1000)


def test_before_that_the_clock_is_the_best_share():
    passes = GatePassRate(2)
    passes.best = 0.3
    assert passes.known(900, 1000) == 0.3 and passes.known_since is None


def test_old_attempts_are_forgotten_and_a_resumed_run_remembers_what_is_left():
    passes = GatePassRate(2)
    for _ in range(MEMORY):
        passes.update(episodes([11], [0], [0]), 0)
    before = passes.share
    for _ in range(MEMORY):
        passes.update(episodes([1], [0], [1]), 0)
    assert before == 1.0 and 0.2 < passes.share < 0.6
    resumed = GatePassRate(0)
    resumed.load_state_dict(passes.state_dict())
    assert (resumed.share, resumed.best, resumed.hardest_gate) == (passes.share, passes.best, 0)
