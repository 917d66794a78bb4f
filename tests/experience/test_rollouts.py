"""Rollouts: flown, the episodes that end in them, stored, and gone on with."""

from __future__ import annotations

import copy
from enum import IntEnum
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.experience.rollouts import (
    KNOWN_PASS_RATE,
    MEMORY,
    MIN_PROGRESS_RATE,
    CollectorState,
    EpisodeTracker,
    GatePassRate,
    Rollouts,
    RolloutStorage,
)
from dreamer_racing.modules import Interface, symlog
from tests.dreamers import learner_of


def test_rollouts_of_a_race_follow_each_other() -> None:
    env = DroneRacingEnv("circle", 2, from_pixels=False, privileged=False, seed=0, episode_steps=7, num_threads=1)
    policy = learner_of("debug", Interface.of(env), seed=0).policy()
    flying = TransformedEnv(env, Compose(InitTracker(), policy.make_primer()))
    collector = Collector(flying, policy, frames_per_batch=2 * 5, total_frames=-1)
    rollouts = Rollouts(collector)
    with torch.no_grad():
        flown = torch.cat([next(rollouts).clone() for _ in range(4)], 1)  # [2, 20]
    collector.shutdown()
    goes_on = ~flown["next", "done"][:, :-1, 0]
    assert goes_on.sum() > 20 and not goes_on.all()
    for key in ("vector", "belief", "state", "previous_action"):
        assert torch.equal(flown["next", key][:, :-1][goes_on], flown[key][:, 1:][goes_on]), key
    assert torch.equal(flown["is_init"][:, 1:, 0], ~goes_on)


# Episodes that end in rollouts.


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


# What is kept of collected rollouts, in which order, and what is forgotten.


N, T, P = 3, 4, 5


def make_rollout(number: int = N, steps: int = T) -> TensorDict:
    """As a collector yields it; nothing ends."""
    shape = (number, steps)
    flags = torch.zeros(2, *shape, 1, dtype=torch.bool)
    came = {"reward": torch.randn(*shape, 1), "done": flags[0], "terminated": flags[1]}
    after = {"belief": torch.randn(*shape, 6), "state": torch.rand(*shape, 2), **came}
    root = {name: torch.rand(*shape, 4) for name in ("action", "previous_action", "loc", "scale")}
    return TensorDict({**root, "privileged": {"vector": torch.randn(*shape, P)}, "next": after}, shape)


def test_steps_are_kept_time_first_and_the_newest_where_it_is_full():
    storage = RolloutStorage(2 * N * T, privileged=True)
    assert not storage.full
    rollouts = [make_rollout() for _ in range(3)]
    for number, rollout in enumerate(rollouts):
        storage.extend(rollout)
        assert storage.full == (number > 0)
    assert storage.steps.batch_size == (2 * T, N)
    for place, rollout in ((slice(0, T), rollouts[1]), (slice(T, 2 * T), rollouts[2])):
        kept, came = storage.steps[place], rollout.transpose(0, 1)
        assert torch.equal(kept["reward"], came["next", "reward"])
        assert torch.equal(kept["action"], came["action"])
        assert torch.equal(kept["previous_action"], came["previous_action"])
        assert torch.equal(kept["features"], torch.cat((came["next", "belief"], came["next", "state"]), -1))
        assert torch.equal(kept["behavior"], torch.cat((came["loc"], came["scale"]), -1))
        assert torch.equal(kept["privileged"], symlog(came["privileged", "vector"]))
    storage.clear()
    assert not storage.full and "privileged" not in _stored(privileged=False)


def _stored(privileged: bool) -> TensorDict:
    storage = RolloutStorage(N * T, privileged=privileged)
    storage.extend(make_rollout())
    return storage.steps


def test_an_episode_that_was_broken_off_ends_at_its_last_step():
    """As of a lost worker, whose worlds begin anew with the next rollout; here of the second environment."""
    storage, begins = RolloutStorage(8), torch.zeros(2, 2, 1, dtype=torch.bool)
    storage.extend(make_rollout(2, 2).set("is_init", begins))
    storage.extend(make_rollout(2, 2).set("is_init", begins.index_fill(0, torch.tensor(1), True)))
    assert storage.steps["done"][:, :, 0].tolist() == [[False, False], [False, True], [False, False], [False, False]]


def test_another_number_of_environments_empties_the_storage():
    storage = RolloutStorage(2 * N * T)
    storage.extend(make_rollout(3))
    storage.extend(make_rollout(6))
    assert storage.steps.batch_size == (4, 6) and storage.full


def test_another_rollout_length_empties_the_storage_if_it_does_not_fit():
    storage = RolloutStorage(2 * N * T)
    storage.extend(make_rollout(steps=4))
    storage.extend(make_rollout(steps=8))  # room for 8 steps either way, and 4 are kept
    assert storage.full and storage.count == 8


def test_a_saved_storage_goes_on_as_if_never_saved():
    storage, restored = RolloutStorage(2 * N * T), RolloutStorage(2 * N * T)
    restored.load_state_dict(copy.deepcopy(storage.state_dict()))  # of one that is empty
    assert restored.steps is None
    first, second = make_rollout(), make_rollout()
    storage.extend(first)
    restored.load_state_dict(copy.deepcopy(storage.state_dict()))
    for each in (storage, restored):
        each.extend(second)
        assert each.full
    assert (storage.steps == restored.steps).all()


def test_a_rollout_that_lacks_something_is_refused_by_name():
    with pytest.raises(KeyError, match=r"The rollout lacks \['loc'\], which on-policy learning needs"):
        RolloutStorage(8).extend(make_rollout().exclude("loc"))
    with pytest.raises(KeyError, match=r"lacks \[\('privileged', 'vector'\)\]"):
        RolloutStorage(8, privileged=True).extend(make_rollout().exclude("privileged"))


# What a collector carries from rollout to rollout, as a part of a checkpoint.


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
    with pytest.raises(ValueError, match=r"has 3 environments, this run has 2: set env\.num_envs=3"):
        CollectorState(collector(2, 0.0)).load_state_dict(CollectorState(collector(3, 1.0)).state_dict())
