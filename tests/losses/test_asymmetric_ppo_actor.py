"""PPO on what was flown with a critic of the simulator's state: who sees what, and what it learns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import ActorPPOConfig, AsymmetricPPOActorLoss
from dreamer_racing.modules import Interface
from dreamer_racing.modules.heads import symlog
from tests.dreamers import learner_of
from tests.learners.test_dreamer import make_batch
from tests.losses.test_flown_ppo_actor import CONFIG, PPO, N, T
from tests.losses.test_flown_ppo_actor import make_rollout as make_blind_rollout

P = 5
STATE = Interface(privileged_dim=P)


def make_learner(**changes) -> DreamerLearner:
    return learner_of(
        "debug", STATE, seed=0, **{**CONFIG, "actor": "asymmetric_ppo", "world_model": "privileged", **changes}
    )


def make_rollout(learner: DreamerLearner, number: int = N, steps: int = T) -> TensorDict:
    rollout = make_blind_rollout(learner, number, steps)
    return rollout.set(("privileged", "vector"), torch.randn(number, steps, P))


def make_seen_batch() -> TensorDict:
    batch = make_batch()
    return batch.set(("privileged", "vector"), torch.randn(*batch.batch_size, P))


def actor_loss(learner: DreamerLearner) -> AsymmetricPPOActorLoss:
    return learner.losses["actor"]


def test_values_are_those_of_the_state_at_which_the_action_was_chosen():
    learner = make_learner(ppo=replace(PPO, flown=N * T))
    loss, rollout = actor_loss(learner), make_rollout(learner)
    torch.nn.init.normal_(loss.state_critic.mlp.output.weight)
    loss.watch(rollout)
    seen = symlog(rollout["privileged", "vector"]).transpose(0, 1)
    torch.testing.assert_close(loss._value(), loss.state_critic.mean(seen))
    before = loss._value()
    loss.features.normal_()
    torch.nn.init.normal_(loss.critic.head.mlp.output.weight)
    assert torch.equal(loss._value(), before), "neither latents nor their critic have a say"


def test_evaluations_ask_the_critic_of_the_state():
    learner = make_learner()
    torch.nn.init.normal_(actor_loss(learner).state_critic.mlp.output.weight)
    acted = TensorDict({"privileged": {"vector": torch.randn(3, P)}}, [3])
    expected = actor_loss(learner).state_critic.mean(symlog(acted["privileged", "vector"]))
    value = learner.value_function()(acted)
    assert value.shape == (3, 1) and not value.requires_grad and torch.equal(value, expected)


def test_the_critic_learns_what_the_state_pays():
    """Rewards that are the first privileged number: after some improvements it explains nearly all of the returns."""
    torch.manual_seed(0)
    learner = make_learner(ppo=ActorPPOConfig(flown=512, epochs=4, minibatch=64), discount=0.0)
    for number in range(40):
        rollout = make_rollout(learner, 64, 8)
        rollout["next", "reward"] = 3.0 * rollout["privileged", "vector"][..., :1]
        learner.watch(rollout)
        metrics = actor_loss(learner).improve(number)
        if number == 0:
            assert metrics["ppo/explained_variance"].item() == pytest.approx(0.0, abs=0.05)
    assert metrics["ppo/explained_variance"].item() > 0.8


def test_what_flies_needs_no_state():
    policy = make_learner().policy()
    assert not any("privileged" in str(key) for key in policy.in_keys)


def test_an_environment_without_the_state_is_refused():
    with pytest.raises(ValueError, match=r"AsymmetricPPOActorLoss needs privileged numbers .* privileged=True"):
        learner_of("debug", Interface(), **{**CONFIG, "actor": "asymmetric_ppo"})
    learner = make_learner()
    with pytest.raises(KeyError, match=r"AsymmetricPPOActorLoss needs \[\('privileged', 'vector'\)\]"):
        learner.watch(make_blind_rollout(learner))
