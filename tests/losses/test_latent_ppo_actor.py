"""PPO on what was flown with a critic of the latents: what it sees and learns; no state, and nothing imagined."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import ActorPPOConfig, LatentPPOActorLoss
from dreamer_racing.modules import join_features
from tests.dreamers import learner_of
from tests.learners.test_dreamer import make_batch
from tests.losses.test_flown_ppo_actor import CONFIG, PPO, N, T, make_rollout


def make_learner(**changes) -> DreamerLearner:
    return learner_of("debug", seed=0, **{**CONFIG, "actor": "latent_ppo", **changes})


def actor_loss(learner: DreamerLearner) -> LatentPPOActorLoss:
    return learner.losses["actor"]


def test_values_are_those_of_the_latents_at_which_the_action_was_chosen():
    learner = make_learner(ppo=replace(PPO, flown=N * T))
    loss, rollout = actor_loss(learner), make_rollout(learner)
    torch.nn.init.normal_(loss.latent_critic.mlp.output.weight)
    loss.watch(rollout)
    seen = join_features(rollout["next", "belief"], rollout["next", "state"]).transpose(0, 1)
    before = loss._value()
    torch.testing.assert_close(before, loss.latent_critic.mean(seen))
    torch.nn.init.normal_(loss.critic.head.mlp.output.weight)
    assert torch.equal(loss._value(), before), "the agent's critic has no say"


def test_evaluations_ask_the_critic_that_teaches_the_actor():
    """At the latents that the policy made of what it saw, not those that it remembered."""
    learner = make_learner()
    critic, size = actor_loss(learner).latent_critic, learner.agent.world_model.size
    torch.nn.init.normal_(critic.mlp.output.weight)
    remembered = TensorDict({"belief": torch.randn(3, size.belief), "state": torch.rand(3, size.state)}, [3])
    seen = make_batch()[:3, 0].select(*learner.agent.world_model.encoder.keys, "is_init", "previous_action")
    with torch.no_grad():
        acted = learner.evaluation_policy()(remembered.clone().update(seen))
    value = learner.value_function()(acted)
    assert value.shape == (3, 1) and not value.requires_grad
    assert torch.equal(value, critic.mean(join_features(acted["next", "belief"], acted["next", "state"])))
    assert not torch.allclose(value, critic.mean(join_features(remembered["belief"], remembered["state"])))


def test_an_improvement_moves_actor_and_latent_critic_and_nothing_else():
    learner = make_learner()
    loss = actor_loss(learner)
    parts = {"actor": learner.agent.actor, "own": loss.latent_critic}
    others = {"model": learner.agent.world_model, "critic": learner.agent.critic}
    before = {name: copy.deepcopy(part.state_dict()) for name, part in (parts | others).items()}
    for _ in range(2):
        learner.watch(make_rollout(learner))
    metrics = loss.improve(1)
    for name, part in (parts | others).items():
        moved = any(not torch.equal(value, before[name][key]) for key, value in part.state_dict().items())
        assert moved == (name in parts), name
    assert {"ppo/critic_loss", "ppo/explained_variance", "entropy", "ppo/kl", "gradient_norm/actor"} <= set(metrics)
    assert metrics["gradient_norm/own_critic"] > 0
    assert all(parameter.grad is None for part in others.values() for parameter in part.parameters())


def test_the_critic_learns_what_the_latents_pay():
    """Rewards that a latent tells: after some improvements it explains nearly all of the returns."""
    torch.manual_seed(0)
    learner = make_learner(ppo=ActorPPOConfig(flown=512, epochs=4, minibatch=64), discount=0.0)
    for number in range(40):
        rollout = make_rollout(learner, 64, 8)
        rollout["next", "belief"].normal_()
        rollout["next", "reward"] = 3.0 * rollout["next", "belief"][..., :1]
        learner.watch(rollout)
        metrics = actor_loss(learner).improve(number)
        if number == 0:
            assert metrics["ppo/explained_variance"].item() == pytest.approx(0.0, abs=0.05)
    assert metrics["ppo/explained_variance"].item() > 0.8


def test_nothing_is_imagined(monkeypatch):
    learner = make_learner()
    monkeypatch.setattr(learner.agent.world_model.rssm, "imagine_step", None)
    metrics = learner.update(make_batch())
    assert "loss_replay_critic" in metrics
    assert not {"loss_actor", "loss_critic", "imagined_reward"} & set(metrics)


def test_a_checkpoint_between_two_improvements_loses_nothing():
    torch.manual_seed(0)
    learner = make_learner()
    rollouts, batch = [make_rollout(learner) for _ in range(4)], make_batch()
    for rollout in rollouts[:3]:  # one improvement, and half of the steps of the next
        learner.watch(rollout)
        learner.update(batch)
    resumed = make_learner()
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, resumed):
        torch.manual_seed(5)
        each.watch(rollouts[3])
        assert "ppo/kl" in each.update(batch)
    for part in (lambda it: it.agent.state_dict(), lambda it: it.losses["actor"].state_dict()):
        for (name, value), other in zip(part(learner).items(), part(resumed).values(), strict=True):
            assert torch.equal(value, other), name


def test_the_rates_of_both_fall_with_the_others():
    learner = make_learner(ppo=replace(PPO, learning_rate=1e-2, critic_learning_rate=1e-3))
    learner.adjust(rates=0.5)
    assert [group["lr"] for group in actor_loss(learner).optimizer.param_groups] == pytest.approx([5e-3, 5e-4])
