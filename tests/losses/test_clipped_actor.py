"""Steps with a mask, which a CUDA device makes without being asked: the same improvements as without."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.learners.launches import launches
from dreamer_racing.losses import clipped_actor
from dreamer_racing.losses.clipped_actor import ClippedActorLoss
from dreamer_racing.modules.actor import ActionDistribution
from tests.losses import test_asymmetric_ppo_actor as asymmetric
from tests.losses.test_flown_ppo_actor import PPO, N, T


def improved(learner: DreamerLearner, rollouts: list[Any]) -> list[dict[str, Tensor]]:
    """Metrics of an improvement after every two rollouts; with masks also the orders of steps left out are drawn."""
    metrics = []
    for seed, rollout in enumerate(rollouts):
        torch.manual_seed(seed)
        learner.watch(rollout)
        metrics.append(learner.losses["actor"].improve(1))
    return [found for found in metrics if found]


def make_pair(monkeypatch: pytest.MonkeyPatch, **ppo: Any) -> list[DreamerLearner]:
    """Learners without masks and with them."""
    learners = []
    for masked in (False, True):
        monkeypatch.setattr(clipped_actor, "masks_steps", lambda device, masked=masked: masked)
        learners.append(asymmetric.make_learner(ppo=replace(PPO, **ppo)))
    return learners


def same(first: torch.nn.Module, second: torch.nn.Module) -> None:
    for name, value in first.state_dict().items():
        torch.testing.assert_close(second.state_dict()[name], value, rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.parametrize(
    ("ppo", "epochs"),
    [({}, 4.0), ({"kl_stop": 1e-5}, 1.0), ({"kl_stop": 0.02, "kl_target": 0.01}, None)],
    ids=["all", "stopped at the second step", "paced"],
)
def test_masked_improvements_are_those_that_break_off(
    monkeypatch: pytest.MonkeyPatch, ppo: dict[str, float], epochs: float | None
) -> None:
    plain, masked = make_pair(monkeypatch, **ppo)
    rollouts = [asymmetric.make_rollout(plain) for _ in range(4)]
    of_each = [improved(learner, rollouts) for learner in (plain, masked)]
    assert len(of_each[0]) == 2 and of_each[0][0].keys() == of_each[1][0].keys()
    for one, other in zip(*of_each, strict=True):
        for name, value in one.items():
            torch.testing.assert_close(other[name], value, rtol=1e-4, atol=1e-5, msg=name)
    stopped = of_each[0][0]["ppo/epochs"].item()
    assert stopped == epochs if epochs else stopped < 4.0, "or the test sees no masks"
    same(plain.agent, masked.agent)
    same(plain.losses["actor"], masked.losses["actor"])


def test_a_gradient_that_is_no_number_leaves_weights_and_moments_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    for learner in make_pair(monkeypatch):
        loss: ClippedActorLoss = learner.losses["actor"]
        improved(learner, [asymmetric.make_rollout(learner) for _ in range(2)])  # there are moments
        before = copy.deepcopy((learner.agent.state_dict(), loss.optimizer.state_dict()))
        total = sum(parameter.sum() for parameter in learner.agent.actor.parameters())
        norm = loss._descend(total * float("nan"), learner.agent.actor)
        assert not norm.isfinite()
        after = (learner.agent.state_dict(), loss.optimizer.state_dict())
        torch.testing.assert_close(after, before, rtol=0, atol=0)


@pytest.mark.parametrize("actor", ["asymmetric_ppo", "latent_ppo", "flown_ppo"])
def test_a_masked_improvement_waits_for_nothing(monkeypatch: pytest.MonkeyPatch, actor: str) -> None:
    monkeypatch.setattr(clipped_actor, "masks_steps", lambda device: True)
    learner = asymmetric.make_learner(actor=actor, ppo=replace(PPO, flown=N * T, kl_target=0.01, kl_stop=0.02))
    loss = learner.losses["actor"]
    learner.watch(asymmetric.make_rollout(learner))
    loss.improve(1)
    learner.watch(asymmetric.make_rollout(learner))
    seen = launches(lambda: loss.improve(2))
    assert seen.kernels["_fused_adam_"] >= 4 and (seen.waits, seen.mixed) == ([], [])


def test_an_imagined_improvement_asks_once_whether_there_are_rollouts_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clipped_actor, "masks_steps", lambda device: True)
    learner = asymmetric.make_learner(actor="ppo", ppo=replace(PPO, updates=2))
    batch = asymmetric.make_seen_batch()
    learner.update(batch)
    loss = learner.losses["actor"]
    assert launches(lambda: loss.improve(2)).waits, "one of two is there"
    learner.update(batch)
    assert not launches(lambda: loss.improve(4)).waits
    loss.prepare(7)
    assert loss.improve(6) == {}, "begun anew, with room for other starts"


def test_a_checkpoint_goes_on_with_masks_or_without(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, masked = make_pair(monkeypatch)
    rollouts = [asymmetric.make_rollout(plain) for _ in range(4)]
    improved(plain, rollouts[:2])
    masked.load_state_dict(copy.deepcopy(plain.state_dict()))
    for learner in (plain, masked):
        improved(learner, rollouts[2:])
    same(plain.agent, masked.agent)
    back, _ = make_pair(monkeypatch)
    back.load_state_dict(copy.deepcopy(masked.state_dict()))
    assert [group["fused"] for group in back.losses["actor"].optimizer.param_groups] == [None, None]


@pytest.mark.parametrize(("number", "sizes"), [(32, [16, 16]), (36, [12, 12, 12]), (17, [9, 8]), (5, [5])])
def test_no_minibatch_is_a_small_rest(number: int, sizes: list[int]) -> None:
    """Each makes a step of full size, and the divergence of the last one sets the pace."""
    loss = asymmetric.make_learner(ppo=replace(PPO, minibatch=16)).losses["actor"]
    places = loss._shuffled(number)
    assert [len(each) for each in places] == sizes
    assert torch.cat(list(places)).sort().values.tolist() == list(range(number))


def test_a_bound_that_came_down_since_the_flight_is_no_divergence_of_the_steps() -> None:
    learner = asymmetric.make_learner(ppo=replace(PPO, kl_stop=0.05, kl_target=0.05, learning_rate=1e-5))
    loss = learner.losses["actor"]
    for _ in range(2):
        learner.watch(asymmetric.make_rollout(learner))
    learner.adjust(max_std=0.2)
    flown = ActionDistribution(*loss.old.flatten(0, 1).chunk(2, -1))
    with torch.no_grad():
        assert flown.divergence(loss.actor(loss.features.flatten(0, 1))).mean() > 1.0
    metrics = loss.improve(1)
    assert metrics["ppo/epochs"] == PPO.epochs and metrics["ppo/kl"] < 0.05
