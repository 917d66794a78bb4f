"""PPO on what was flown with a critic of the latents: what it sees and learns; no state, and nothing imagined."""

from __future__ import annotations

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
