"""Rollouts: flown, stored, and gone on with."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.experience.rollouts import CollectorState, Rollouts, RolloutStorage
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
