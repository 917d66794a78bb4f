"""PPO on flown rollouts: what is kept of them, what the advantages are, when the actor moves, and what is saved."""

import copy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import ActorPPOConfig, FlownPPOActorLoss
from dreamer_racing.modules.actor import ActionDistribution
from tests.dreamers import learner_of

PPO = ActorPPOConfig(flown=24, epochs=4, minibatch=16, learning_rate=1e-2, kl_stop=1e9)
CONFIG = {"horizon": 4, "actor": "flown_ppo", "ppo": PPO, "discount": 0.9, "lambda_": 0.8, "entropy_scale": 0.0}
N, T = 3, 4


def make_learner(**changes) -> DreamerLearner:
    learner = learner_of(seed=0, **CONFIG | changes)
    torch.nn.init.normal_(learner.agent.critic.head.mlp.output.weight, generator=torch.Generator().manual_seed(0))
    return learner


def make_rollout(learner: DreamerLearner, number: int = N, steps: int = T) -> TensorDict:
    """As a collector yields it, with the latents that the policy saw under ``next``; nothing ends."""
    belief = torch.rand(number, steps, 32) * 2 - 1
    state = torch.rand(number, steps, 16).unflatten(-1, (4, 4)).softmax(-1).flatten(-2)
    policy = learner.agent.actor(torch.cat((belief, state), -1))
    action = policy.sample().detach().clamp(-1.0, 1.0)
    done, terminated = torch.zeros(2, number, steps, 1, dtype=torch.bool)
    came = {"reward": torch.randn(number, steps, 1), "done": done, "terminated": terminated}
    root = {"action": action, "loc": policy.mean.detach(), "scale": policy.std.detach()}
    return TensorDict({**root, "next": {"belief": belief, "state": state, **came}}, [number, steps])


def actor_loss(learner: DreamerLearner) -> FlownPPOActorLoss:
    return learner.losses["actor"]


@pytest.mark.parametrize("mean", [-1.0, 0.3, 0.95])
@pytest.mark.parametrize("std", [0.05, 0.4, 1.0])
def test_the_probability_of_clipped_actions_adds_up_to_one(mean, std):
    policy = ActionDistribution(torch.full((1, 1), mean).double(), torch.full((1, 1), std).double())
    inside = torch.linspace(-1, 1, 200_001).double()[1:-1, None]
    density = policy.log_prob_clipped(inside).exp()
    bounds = policy.log_prob_clipped(torch.tensor([[-1.0], [1.0]]).double()).exp()
    assert (density.sum() * 1e-5 + bounds.sum()).item() == pytest.approx(1.0, abs=1e-4)


def test_the_probability_of_a_clipped_action_has_a_gradient_far_beyond_the_bound():
    mean = torch.full((1, 1), -9.0, requires_grad=True)
    ActionDistribution(mean, torch.full((1, 1), 0.1)).log_prob_clipped(torch.ones(1, 1)).backward()
    assert mean.grad.isfinite().all() and mean.grad.item() > 0


def test_advantages_by_hand():
    """Two rollouts of two steps in one environment: a crash after the second step; nothing is kept after the last."""
    learner = make_learner(ppo=replace(PPO, flown=4))
    loss = actor_loss(learner)
    first, second = make_rollout(learner, 1, 2), make_rollout(learner, 1, 2)
    first["next", "done"][0, 1] = first["next", "terminated"][0, 1] = True
    loss.watch(first)
    loss.watch(second)
    reward = torch.cat((first["next", "reward"], second["next", "reward"]), 1)[0, :, 0]
    value = loss.critic.value(loss.features)[:, 0, 0]
    assert value.std() > 0.01, "or there is nothing to see"
    expected = torch.zeros(4)
    expected[3] = reward[3] + 0.9 * value[3] - value[3]
    expected[2] = reward[2] + 0.9 * (0.2 * value[3] + 0.8 * (expected[3] + value[3])) - value[2]
    expected[1] = reward[1] - value[1]
    expected[0] = reward[0] + 0.9 * (0.2 * value[1] + 0.8 * reward[1]) - value[0]
    torch.testing.assert_close((loss._return(loss._value()) - loss._value())[:, 0, 0], expected)


def test_where_time_runs_out_the_value_stands_for_what_comes():
    learner = make_learner(ppo=replace(PPO, flown=2))
    loss, rollout = actor_loss(learner), make_rollout(learner, 1, 2)
    rollout["next", "done"][0, 0] = True
    loss.watch(rollout)
    value, reward = loss.critic.value(loss.features)[0, 0, 0], rollout["next", "reward"][0, 0, 0]
    torch.testing.assert_close(loss._return(loss._value())[0, 0, 0], reward + 0.9 * value)


def test_an_episode_that_was_broken_off_ends_at_its_last_step():
    """As of a lost worker, whose worlds begin anew with the next rollout; here of the second environment."""
    learner = make_learner(ppo=replace(PPO, flown=8))
    loss = actor_loss(learner)
    first, second = make_rollout(learner, 2, 2), make_rollout(learner, 2, 2)
    begins = torch.zeros(2, 2, 1, dtype=torch.bool)
    loss.watch(first.set("is_init", begins))
    loss.watch(second.set("is_init", begins.index_fill(0, torch.tensor(1), True)))
    assert loss.done[:, :, 0].tolist() == [[False, False], [False, True], [False, False], [False, False]]
    value = loss.critic.value(loss.features)
    advantage = loss._return(loss._value()) - loss._value()
    torch.testing.assert_close(advantage[1, 1], first["next", "reward"][1, 1] + 0.9 * value[1, 1] - value[1, 1])


def test_the_actor_stands_still_until_enough_was_flown():
    learner = make_learner()
    loss = actor_loss(learner)
    assert loss.improve(1) == {}
    for number in (1, 2):  # 12 steps each of 24
        before = copy.deepcopy(learner.agent.actor.state_dict())
        learner.watch(make_rollout(learner))
        metrics = loss.improve(number)
        moved = any(not torch.equal(value, before[name]) for name, value in learner.agent.actor.state_dict().items())
        assert moved == bool(metrics) == (number == 2)
    assert all(not torch.equal(value, before[name]) for name, value in learner.agent.actor.named_parameters())
    assert set(metrics) == {"ppo/loss", "ppo/kl", "ppo/clipped", "ppo/epochs", "ppo/pace", "gradient_norm/actor"}
    assert loss.improve(3) == {}, "what was learned from is not learned from again"
    others = (*learner.agent.world_model.parameters(), *learner.agent.critic.parameters())
    assert all(parameter.grad is None for parameter in others)


def test_what_is_full_before_the_actor_may_move_keeps_the_newest():
    learner = make_learner()
    rollouts = [make_rollout(learner) for _ in range(3)]
    for rollout in rollouts:
        learner.watch(rollout)
    loss = actor_loss(learner)
    assert loss.flown.item() == 2 * T
    for place, rollout in ((slice(0, T), rollouts[1]), (slice(T, 2 * T), rollouts[2])):
        assert torch.equal(loss.reward[place], rollout["next", "reward"].transpose(0, 1))
        assert torch.equal(loss.action[place], rollout["action"].transpose(0, 1))
    assert loss.improve(1)


def test_an_actor_that_waits_stands_still_while_the_model_learns_and_then_learns_from_the_newest():
    from tests.learners.test_dreamer import make_batch

    learner = make_learner(warmup_updates=0)
    for _ in range(3):
        learner.watch(newest := make_rollout(learner))
    learner.actor_waits = True
    before = copy.deepcopy(learner.agent.state_dict())
    assert "ppo/kl" not in learner.update(make_batch())
    moved = {name for name, value in learner.agent.state_dict().items() if not torch.equal(value, before[name])}
    assert any(name.startswith("world_model.") for name in moved)
    assert not any(name.startswith("actor.") for name in moved)
    assert torch.equal(actor_loss(learner).reward[-T:], newest["next", "reward"].transpose(0, 1))
    learner.actor_waits = False
    assert "ppo/kl" in learner.update(make_batch())


def test_what_pays_becomes_likelier():
    """Rewards that are the first dimension of the action: its mean rises, the others' stay."""
    torch.manual_seed(0)
    learner = make_learner(ppo=replace(PPO, flown=512, minibatch=64), discount=0.0)
    torch.nn.init.zeros_(learner.agent.critic.head.mlp.output.weight)
    loss = actor_loss(learner)
    for number in range(30):
        rollout = make_rollout(learner, 64, 8)
        rollout["next", "reward"] = rollout["action"][..., :1].clone()
        learner.watch(rollout)
        assert loss.improve(number)
    mean = learner.agent.actor(loss.features).mean
    assert mean[..., 0].mean() > 0.5
    assert mean[..., 1:].mean(dim=(0, 1)).abs().max() < 0.3


def test_the_ratio_is_one_before_the_first_step():
    """The first gradient step sees the policy that flew: nothing is clipped, nothing has diverged."""
    learner = make_learner(ppo=replace(PPO, epochs=1, minibatch=1000), mixed_precision=True)
    for _ in range(2):
        learner.watch(make_rollout(learner))
    with learner.autocast():
        metrics = actor_loss(learner).improve(1)
    assert metrics["ppo/kl"].item() == pytest.approx(0.0, abs=1e-6)
    assert metrics["ppo/clipped"].item() == 0.0


def test_a_checkpoint_between_two_improvements_loses_nothing():
    from tests.learners.test_dreamer import make_batch

    torch.manual_seed(0)
    learner = make_learner()
    rollouts = [make_rollout(learner) for _ in range(3)]
    learner.watch(rollouts[0])
    learner.update(make_batch())
    resumed = make_learner()
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, resumed):
        torch.manual_seed(5)
        each.watch(rollouts[1])
        assert "ppo/kl" in each.update(make_batch())
        each.watch(rollouts[2])
    for (name, value), (_, other) in zip(
        learner.state_dict()["losses"]["actor"].items(), resumed.state_dict()["losses"]["actor"].items(), strict=True
    ):
        assert torch.equal(value, other), name
    for name, value in learner.agent.state_dict().items():
        assert torch.equal(value, resumed.agent.state_dict()[name]), name


def test_steps_of_another_kind_are_forgotten_with_their_number():
    """A full memory of a loss that keeps less: nothing is there to improve on, instead of a count without steps."""
    learner, other = make_learner(), make_learner()
    while actor_loss(learner)._flown < len(actor_loss(learner).reward) or not actor_loss(learner)._flown:
        learner.watch(make_rollout(learner))
    state = learner.state_dict()
    del state["losses"]["actor"]["old"]
    other.load_state_dict(state)
    assert actor_loss(other).improve(1) == {}


def test_flights_of_another_number_of_environments_begin_anew():
    learner = make_learner()
    learner.watch(make_rollout(learner, 3))
    learner.watch(make_rollout(learner, 6))
    assert actor_loss(learner).reward.shape == (4, 6, 1)
    assert actor_loss(learner).improve(1)


def test_flights_of_another_length_begin_anew_where_they_do_not_add_up_to_whole_ones():
    learner = make_learner()
    learner.watch(make_rollout(learner, steps=4))
    learner.watch(make_rollout(learner, steps=8))  # room for 8 steps either way, and 4 are kept
    assert actor_loss(learner).improve(1)


def test_a_rollout_without_the_policy_is_refused():
    learner = make_learner()
    with pytest.raises(KeyError, match=r"FlownPPOActorLoss needs \['loc'\]"):
        learner.watch(make_rollout(learner).exclude("loc"))
