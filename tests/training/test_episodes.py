"""Episodes that end in rollouts, and the share of flights that pass each gate."""

from __future__ import annotations

from enum import IntEnum

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from dreamer_racing.training.episodes import (
    KNOWN_PASS_RATE,
    MEMORY,
    MIN_PROGRESS_RATE,
    EpisodeTracker,
    GatePassRate,
)


class Cause(IntEnum):
    NONE = 0
    GROUND = 1
    GATE = 2


def race(num_envs: int, steps: int, end: float, seed: int = 0) -> TensorDict:
    """A rollout in which so large a share of the steps ends an episode."""
    rand = torch.rand(4, num_envs, steps, 1, generator=torch.Generator().manual_seed(seed))
    done = rand[0] < end
    crash = torch.where(done, (rand[1] * 3).long(), 0)
    facts = {"gates_passed": (rand[2] * 10).long(), "crash": crash, "finished": crash < 0}
    arrived = {"reward": rand[3], "done": done, "truncated": done & (crash == 0), "race": facts}
    return TensorDict({"is_init": torch.zeros_like(done), "next": arrived}, [num_envs, steps])


def counted(rollouts: list[TensorDict]) -> list[dict]:
    """The episodes, step by step."""
    num_envs = len(rollouts[0])
    returns, lengths, episodes = [0.0] * num_envs, [0] * num_envs, []
    for step in (step for rollout in rollouts for step in rollout["next"].unbind(1)):
        for env in range(num_envs):
            returns[env] += step["reward"][env].item()
            lengths[env] += 1
            if step["done"][env]:
                facts = {name: step["race", name][env].item() for name in ("gates_passed", "crash")}
                episodes.append({"env": env, "return": returns[env], "length": lengths[env], **facts})
                returns[env], lengths[env] = 0.0, 0
    return episodes


@settings(deadline=None, max_examples=25)
@given(
    num_envs=st.integers(1, 4),
    steps=st.lists(st.integers(1, 12), min_size=1, max_size=4),
    end=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    seed=st.integers(0, 100),
)
def test_episodes_equal_a_step_by_step_count(num_envs, steps, end, seed):
    rollouts = [race(num_envs, count, end, seed + 1000 * number) for number, count in enumerate(steps)]
    tracker, found = EpisodeTracker(num_envs), []
    for rollout in rollouts:
        resumed = EpisodeTracker(num_envs)
        resumed.load_state_dict(tracker.state_dict())
        tracker = resumed
        found += [{key: value.item() for key, value in episode.items()} for episode in tracker.update(rollout)]
    expected = counted(rollouts)
    assert len(found) == len(expected)
    for actual, episode in zip(found, expected, strict=True):
        assert {key: actual[key] for key in episode} == pytest.approx(episode, rel=1e-5)


def test_interrupted_episodes_are_forgotten():
    tracker = EpisodeTracker(2)
    tracker.update(race(2, 5, 0.0))
    rollout = race(2, 3, 0.0)
    rollout["is_init"][0, 0] = True  # environment 0 was reset, as on resuming
    rollout["next", "done"][:, -1] = True
    assert tracker.update(rollout)["length"].tolist() == [3, 8]


def test_episodes_are_summarised_with_what_a_race_says_of_them():
    tracker, rollout = EpisodeTracker(4, crash_causes=Cause), race(4, 1, 1.0)
    rollout["next", "race", "crash"] = torch.tensor([0, 1, 1, 2]).view(4, 1, 1)
    rollout["next", "race", "gates_passed"] = torch.tensor([1, 2, 3, 6]).view(4, 1, 1)
    rollout["next", "reward"] = torch.tensor([1.0, 2.0, 3.0, 4.0]).view(4, 1, 1)
    of_any_task = {"episode/return": 2.5, "episode/length": 1.0}
    of_a_race = {"episode/gates_passed": 3.0, "crash/ground": 0.5, "crash/gate": 0.25}
    assert tracker.summary(tracker.update(rollout)) == of_any_task | of_a_race
    del rollout["next", "race"]
    assert tracker.summary(tracker.update(rollout)) == of_any_task
    rollout["next", "done"][:] = False
    assert tracker.summary(tracker.update(rollout)) == {}


# The share of flights that pass the hardest gate, by hand.


def episodes(gates: list[int], targets: list[int], crashes: list[int]) -> TensorDict:
    columns = {"gates_passed": gates, "target_gate": targets, "crash": crashes}
    return TensorDict({name: torch.tensor(column, dtype=torch.int64) for name, column in columns.items()}, [len(gates)])


@pytest.mark.parametrize(
    ("ended", "shares", "lowest"),
    [
        (([3], [0], [1]), [0.0, 1.0, 1.0], 0),  # from gate 0 on: 0 does not count, 1 and 2 are passed, crash before 0
        # also a crash before the first gate, and time that ran out after it
        (([3, 0, 1], [0, 1, 1], [1, 1, 0]), [0.0, 1.0, 1.0], 0),
        (([7, 1, 1], [2, 1, 1], [0, 2, 3]), [1.0, 2 / 4, 1.0], 1),  # 1, then 2 0 1 2 0 1; twice 0 and a crash at 1
    ],
)
def test_an_episode_counts_each_pass_and_crash_after_its_first_gate(ended, shares, lowest):
    passes = GatePassRate(3)
    assert passes.share == passes.update(episodes([], [], []), 0) == 0.0
    assert passes.update(episodes(*ended), 0) == passes.share == min(shares)
    assert passes.shares.tolist() == shares and passes.lowest_rate_gate == lowest
    passes.update(episodes([], [], []), 0)
    assert passes.shares.tolist() == shares


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
    passes.best = 0.3
    assert passes.progress(900, 1000) == 0.3 and passes.known_since is None
    for _ in range(4):
        passes.update(episodes([150, 149], [0, 1], [0, 1]), 500)  # past both, but for a crash now and then
    assert passes.best > KNOWN_PASS_RATE and passes.known_since == 500
    passes.best = 0.5
    passes.update(episodes([2], [0], [0]), 700)
    assert passes.known_since == 500
    passes.best = 0.5
    assert passes.progress(510, 1000) == 0.5  # 0.43 by time
    assert passes.progress(600, 1000) == pytest.approx(KNOWN_PASS_RATE + 0.1 * MIN_PROGRESS_RATE)
    resumed = GatePassRate(0)
    resumed.load_state_dict(passes.state_dict())
    for each in (passes, resumed):
        each.update(episodes([5, 3], [1, 0], [0, 1]), 800)
    assert resumed.shares.tolist() == passes.shares.tolist() and resumed.best == passes.best
    assert resumed.progress(600, 1000) == passes.progress(600, 1000)


def test_old_attempts_are_forgotten():
    passes = GatePassRate(2)
    for _ in range(MEMORY):
        passes.update(episodes([11], [0], [0]), 0)
    before = passes.share
    for _ in range(MEMORY):
        passes.update(episodes([1], [0], [1]), 0)
    assert before == 1.0 and 0.2 < passes.share < 0.6
