"""Overlapped collection: with a fake collector whose pace the test sets, and with TorchRL's."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.experience.overlapped import OverlappedRollouts, acting_copy
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of

PATIENCE = 30.0  # seconds, after which a test has failed


class Weight(nn.Module):
    """A policy of one number."""

    def __init__(self) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.zeros(()))


class PacedCollector:
    """Yields the number of the rollout and the policy's weight at its begin and its end, always in the same memory.

    A rollout does not end before `let_end` is released for it.
    """

    def __init__(self, policy: Weight, rollouts: int) -> None:
        self.policy, self.rollouts = policy, rollouts
        self.begun, self.let_end = threading.Semaphore(0), threading.Semaphore(0)
        self.ended = 0

    def __iter__(self) -> Iterator[TensorDict]:
        rollout = TensorDict({name: torch.zeros(()) for name in ("number", "begin", "end")})
        for number in range(self.rollouts):
            rollout["number"].fill_(number)
            rollout["begin"].copy_(self.policy.value.detach())
            self.begun.release()
            if not self.let_end.acquire(timeout=PATIENCE):
                raise TimeoutError
            rollout["end"].copy_(self.policy.value.detach())
            self.ended = number + 1
            yield rollout


class Overlapped:
    """`OverlappedRollouts` of a `PacedCollector`, one rollout of which is always under way after `take`."""

    def __init__(self, rollouts: int = 50) -> None:
        self.policy = Weight()
        acting = acting_copy(self.policy)
        self.collector = PacedCollector(acting, rollouts)
        self.rollouts = OverlappedRollouts(self.collector, acting, self.policy)
        assert not acting.value.requires_grad and self.policy.value.requires_grad
        self.begun = 0

    def take(self) -> TensorDict:
        """Let the rollout under way end, return it, and wait until the next one has begun."""
        self.collector.let_end.release()
        rollout = next(self.rollouts)
        for _ in range(2 if self.begun == 0 else 1):
            assert self.collector.begun.acquire(timeout=PATIENCE)
            self.begun += 1
        return rollout


def test_every_rollout_arrives_once_and_in_order() -> None:
    overlapped = Overlapped()
    arrived = [overlapped.take() for _ in range(10)]
    assert [int(rollout["number"]) for rollout in arrived] == list(range(10)), "the next is not written over the last"
    overlapped.collector.let_end.release()
    overlapped.rollouts.close()


def test_who_acts_has_the_weights_from_before_the_last_updates() -> None:
    overlapped = Overlapped()
    seen = []
    for update in range(5):
        rollout = overlapped.take()
        seen.append((float(rollout["begin"]), float(rollout["end"])))
        overlapped.policy.value.data.fill_(update + 1.0)  # while the next rollout is under way
    assert seen == [(0, 0), (0, 0), (1, 1), (2, 2), (3, 3)]
    overlapped.collector.let_end.release()
    overlapped.rollouts.close()


def test_who_waits_loses_nothing_and_finds_no_one_acting() -> None:
    overlapped = Overlapped()
    overlapped.rollouts.wait()
    arrived = [overlapped.take()]
    threading.Timer(0.2, overlapped.collector.let_end.release).start()
    overlapped.rollouts.wait()
    assert overlapped.collector.ended == 2
    assert not overlapped.collector.begun.acquire(timeout=0.1), "the next waits to be asked for"
    overlapped.collector.let_end.release()  # of the third, which the next `take` begins
    rollout = next(overlapped.rollouts)
    assert [int(arrived[0]["number"]), int(rollout["number"])] == [0, 1]
    overlapped.rollouts.close()


def test_after_drain_nothing_is_under_way_and_nothing_is_lost() -> None:
    overlapped = Overlapped()
    assert overlapped.rollouts.drain() is None
    arrived = [overlapped.take()]
    overlapped.collector.let_end.release()
    drained = overlapped.rollouts.drain()
    assert drained is not None
    assert overlapped.rollouts.drain() is None
    assert not overlapped.collector.begun.acquire(timeout=0.1), "the next waits to be asked for"
    overlapped.begun = 0  # as at the first: taken at once, and one more begun
    arrived += [drained, overlapped.take()]
    assert [int(rollout["number"]) for rollout in arrived] == [0, 1, 2]
    overlapped.collector.let_end.release()
    overlapped.rollouts.close()


def test_close_waits_for_the_rollout_under_way() -> None:
    overlapped = Overlapped()
    overlapped.take()
    assert overlapped.collector.ended == 1
    threading.Timer(0.2, overlapped.collector.let_end.release).start()
    overlapped.rollouts.close()
    assert overlapped.collector.ended == 2
    with pytest.raises(RuntimeError, match="shutdown"):
        next(overlapped.rollouts)


def test_an_error_of_the_collector_is_not_lost() -> None:
    class Broken:
        def __iter__(self) -> Iterator[TensorDict]:
            yield TensorDict({})
            raise ValueError("the simulator broke")

    policy = Weight()
    rollouts = OverlappedRollouts(Broken(), acting_copy(policy), policy)
    next(rollouts)
    with pytest.raises(ValueError, match="the simulator broke"):
        next(rollouts)
    rollouts.close()


def test_rollouts_of_a_race_follow_each_other() -> None:
    env = DroneRacingEnv("circle", 2, from_pixels=False, privileged=False, seed=0, episode_steps=7, num_threads=1)
    policy = learner_of("debug", Interface.of(env), seed=0).policy()
    acting = acting_copy(policy)
    flying = TransformedEnv(env, Compose(InitTracker(), policy.make_primer()))
    collector = Collector(flying, acting, frames_per_batch=2 * 5, total_frames=-1)
    rollouts = OverlappedRollouts(collector, acting, policy)
    with torch.no_grad():
        before = [parameter.clone() for parameter in acting.parameters()]
        first = next(rollouts)
        for parameter in policy.parameters():
            parameter.add_(0.1)
    assert all(torch.equal(*pair) for pair in zip(acting.parameters(), before, strict=True))
    flown = torch.cat([first, *(next(rollouts) for _ in range(3))], 1)  # [2, 20]
    assert all(torch.equal(*pair) for pair in zip(acting.parameters(), policy.parameters(), strict=True))
    rollouts.close()
    collector.shutdown()
    goes_on = ~flown["next", "done"][:, :-1, 0]
    assert goes_on.sum() > 20 and not goes_on.all()
    for key in ("vector", "belief", "state", "previous_action"):
        assert torch.equal(flown["next", key][:, :-1][goes_on], flown[key][:, 1:][goes_on]), key
    assert torch.equal(flown["is_init"][:, 1:, 0], ~goes_on)
