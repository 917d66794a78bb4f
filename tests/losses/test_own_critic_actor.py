"""PPO on what was flown with a critic of its own, of whatever it sees: what moves, what is saved, what is not done."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import ModuleType

import pytest
import torch

from tests.losses import test_asymmetric_ppo_actor as asymmetric
from tests.losses import test_latent_ppo_actor as latent
from tests.losses.test_flown_ppo_actor import PPO

of_each = pytest.mark.parametrize("kind", [latent, asymmetric], ids=["latent", "asymmetric"])


@of_each
def test_an_improvement_moves_actor_and_own_critic_and_nothing_else(kind: ModuleType):
    learner = kind.make_learner()
    loss = kind.actor_loss(learner)
    parts = {"actor": learner.agent.actor, "own": loss.own_critic}
    others = {"model": learner.agent.world_model, "critic": learner.agent.critic}
    before = {name: copy.deepcopy(part.state_dict()) for name, part in (parts | others).items()}
    for _ in range(2):
        learner.watch(kind.make_rollout(learner))
    metrics = loss.improve(1)
    for name, part in (parts | others).items():
        moved = any(not torch.equal(value, before[name][key]) for key, value in part.state_dict().items())
        assert moved == (name in parts), name
    assert {"ppo/critic_loss", "ppo/explained_variance", "entropy", "ppo/kl", "gradient_norm/actor"} <= set(metrics)
    assert metrics["gradient_norm/own_critic"] > 0
    assert all(value.shape == () for value in metrics.values())
    assert all(parameter.grad is None for part in others.values() for parameter in part.parameters())


@of_each
def test_nothing_is_imagined(kind: ModuleType, monkeypatch: pytest.MonkeyPatch):
    learner = kind.make_learner()
    monkeypatch.setattr(learner.agent.world_model.rssm, "imagine_step", None)
    metrics = learner.update(asymmetric.make_seen_batch())
    assert "loss_replay_critic" in metrics
    assert not {"loss_actor", "loss_critic", "imagined_reward"} & set(metrics)
    assert learner.latents is not None, "the replay's context is refreshed all the same"


@of_each
def test_a_checkpoint_between_two_improvements_loses_nothing(kind: ModuleType):
    torch.manual_seed(0)
    learner = kind.make_learner()
    rollouts, batch = [kind.make_rollout(learner) for _ in range(4)], asymmetric.make_seen_batch()
    for rollout in rollouts[:3]:  # one improvement, and half of the steps of the next
        learner.watch(rollout)
        learner.update(batch)
    resumed = kind.make_learner()
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, resumed):
        torch.manual_seed(5)
        each.watch(rollouts[3])
        assert "ppo/kl" in each.update(batch)
    for part in (lambda it: it.agent.state_dict(), lambda it: it.losses["actor"].state_dict()):
        for (name, value), other in zip(part(learner).items(), part(resumed).values(), strict=True):
            assert torch.equal(value, other), name


@of_each
def test_the_rates_of_both_fall_with_the_others(kind: ModuleType):
    learner = kind.make_learner(ppo=replace(PPO, learning_rate=1e-2, critic_learning_rate=1e-3))
    learner.adjust(rates=0.5)
    rates = [group["lr"] for group in kind.actor_loss(learner).optimizer.param_groups]
    assert rates == pytest.approx([5e-3, 5e-4])
