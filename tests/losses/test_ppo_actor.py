"""PPO on imagined rollouts: the objective by hand, when the actor moves, and what survives a checkpoint."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal, kl_divergence

from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import ActorPPOConfig, PPOActorLoss, imagine
from dreamer_racing.losses.clipped_actor import Minibatch, clipped_objective, normalised
from dreamer_racing.modules.actor import ActionDistribution
from tests.dreamers import learner_of

PPO = ActorPPOConfig(updates=3, epochs=2, minibatch=16, learning_rate=1e-2)
CONFIG = {"horizon": 4, "actor": "ppo", "ppo": PPO, "learning_rate": 1e-3, "warmup_updates": 0, "entropy_scale": 0.0}


def make_starts(number: int = 6) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    state = torch.eye(4)[torch.randint(4, (number, 4), generator=generator)].flatten(1)
    return TensorDict(
        {
            "belief": torch.rand(number, 32, generator=generator) * 2 - 1,
            "state": state,
            "terminated": torch.zeros(number, 1, dtype=torch.bool),
        },
        [number],
    )


def make_learner(**changes) -> DreamerLearner:
    """With heads that say something: fresh ones predict zero, and nothing is better than anything else."""
    learner = learner_of(seed=0, **CONFIG | changes)
    generator = torch.Generator().manual_seed(0)
    for head in (learner.agent.world_model.reward_head, learner.agent.critic.head):
        torch.nn.init.normal_(head.mlp.output.weight, generator=generator)
    return learner


def kept_by(loss: PPOActorLoss) -> Minibatch:
    return Minibatch(*(loss.get_buffer(name).flatten(0, 2) for name in Minibatch._fields))


def one_action(mean: float, std: float, number: int = 1) -> ActionDistribution:
    return ActionDistribution(torch.full((number, 1), mean), torch.full((number, 1), std))


@pytest.mark.parametrize(
    ("advantage", "shift", "expected"),
    [
        (1.0, 0.0, 1.0),  # the old policy: the ratio is 1
        (1.0, 0.5, 1.2),  # likelier than the clip allows: no more to gain
        (-1.0, 0.5, -math.exp(0.375)),  # likelier and bad: counted in full, exp((1² − 0.5²) / 2)
        (1.0, -0.5, math.exp(-0.625)),  # less likely and good: counted in full, exp((1² − 1.5²) / 2)
        (-1.0, -0.5, -0.8),  # less likely than the clip asks: no more to gain
    ],
)
def test_objective_by_hand(advantage, shift, expected):
    """The action lies one deviation above the old mean; the new mean is ``shift`` nearer to it."""
    batch = Minibatch(
        features=torch.zeros(1, 1),
        action=torch.ones(1, 1),
        old=torch.tensor([[0.0, 1.0]]),
        advantage=torch.full((1, 1), advantage),
        weight=torch.full((1, 1), 0.5),
    )
    loss, metrics = clipped_objective(one_action(shift, 1.0), batch, clip_epsilon=0.2, entropy_scale=0.1)
    entropy = 0.5 * math.log(2 * math.pi * math.e)
    assert loss.item() == pytest.approx(-0.5 * (expected + 0.1 * entropy), abs=1e-5)
    assert metrics["ppo/kl"].item() == pytest.approx(shift**2 / 2, abs=1e-6)
    assert metrics["ppo/clipped"].item() == (abs(shift) > 0)


def test_divergence_is_that_of_torch():
    torch.manual_seed(0)
    old, new = (ActionDistribution(torch.randn(5, 3), torch.rand(5, 3) + 0.1) for _ in range(2))
    reference = kl_divergence(*(Independent(Normal(policy.mean, policy.std), 1) for policy in (old, new)))
    torch.testing.assert_close(old.divergence(new).squeeze(-1), reference)


def test_the_actor_stands_still_until_the_rollouts_are_there():
    learner = make_learner(ppo=replace(PPO, kl_stop=1e9))
    loss, starts = learner.losses["actor"], make_starts()
    for update in (1, 2, 3):
        before = copy.deepcopy(learner.agent.actor.state_dict())
        written = loss(starts)
        assert written["loss_actor"].item() == 0.0 and not written["loss_actor"].requires_grad
        metrics = loss.improve(update)
        moved = any(not torch.equal(value, before[name]) for name, value in learner.agent.actor.state_dict().items())
        assert moved == bool(metrics) == (update == 3)
    assert set(metrics) == {"ppo/loss", "ppo/kl", "ppo/clipped", "ppo/epochs", "ppo/pace", "gradient_norm/actor"}
    assert metrics["ppo/epochs"].item() == PPO.epochs
    others = (*learner.agent.world_model.parameters(), *learner.agent.critic.parameters())
    assert all(parameter.grad is None for parameter in others)


def test_an_improvement_stops_where_the_policy_has_moved_far():
    learner = make_learner(ppo=replace(PPO, kl_stop=1e-9, learning_rate=1e-3))
    loss = learner.losses["actor"]
    for update in (1, 2, 3):
        loss(make_starts())
        metrics = loss.improve(update)
    # The first minibatch still sees the old policy, the second one that has moved.
    assert metrics["ppo/epochs"].item() == pytest.approx(2 / 5)  # of the 5 minibatches that 3 · 4 · 6 steps make


@pytest.mark.parametrize(
    ("target", "begin", "paces"),
    [(1e-9, 1.0, [1.0, 0.8, 0.64]), (1e9, 0.5, [0.5, 0.625, 0.78125]), (1e9, 0.9, [0.9, 1.0, 1.0]),
     (None, 0.5, [1.0, 1.0, 1.0])],
    ids=["slower", "faster", "not above the full rate", "no target"],
)  # fmt: skip
def test_the_learning_rate_follows_a_target_for_the_divergence(target, begin, paces):
    learner = make_learner(ppo=replace(PPO, updates=1, kl_stop=1e9, kl_target=target, learning_rate=1e-3))
    loss = learner.losses["actor"]
    loss.pace.fill_(begin)
    found = []
    for update in (1, 2, 3):
        loss(make_starts())
        found.append(loss.improve(update)["ppo/pace"].item())
    assert found == pytest.approx(paces)
    assert loss.optimizer.param_groups[0]["lr"] == 1e-3  # what is scheduled stays as it is


def test_a_divergence_about_its_target_changes_no_rate():
    learner = make_learner(ppo=replace(PPO, updates=1, kl_stop=1e9, kl_target=0.01))
    loss = learner.losses["actor"]
    loss.pace.fill_(0.5)
    for kl, pace in ((0.0149, 0.5), (0.0067, 0.5), (0.0151, 0.4), (0.0066, 0.5), (float("nan"), 0.4)):
        loss._set_pace(torch.tensor(kl))
        assert loss.pace.item() == pytest.approx(pace)
    loss.pace.fill_(0.011)
    for _ in range(2):
        loss._set_pace(torch.tensor(1.0))
    assert loss.pace.item() == pytest.approx(0.01)


def test_a_target_on_a_schedule_is_the_one_that_is_steered_to():
    learner = make_learner(ppo=replace(PPO, updates=1, kl_stop=1e9, kl_target=0.01))
    loss = learner.losses["actor"]
    for target, pace in ((0.01, 1.0), (0.001, 0.8)):
        learner.adjust(kl_target=target)
        loss._set_pace(torch.tensor(0.01))
        assert loss.pace.item() == pytest.approx(pace)
    learner.adjust()
    assert loss.kl_target == 0.001


def test_the_pace_is_that_of_the_steps():
    """Adam's first step moves each weight by the learning rate, whatever the gradient."""
    moved = []
    for pace in (1.0, 0.25):
        learner = make_learner(ppo=replace(PPO, updates=1, epochs=1, minibatch=10_000, kl_target=1.0))
        loss, weights = learner.losses["actor"], learner.agent.actor.mlp.output.weight
        loss.pace.fill_(pace)
        before = weights.detach().clone()
        loss(make_starts())
        loss.improve(1)
        moved.append((weights - before).abs().max().item())
    assert moved[1] / moved[0] == pytest.approx(0.25, rel=0.05)


def test_what_is_rewarded_becomes_likelier():
    """Advantages that are the first dimension of the sampled action: its mean rises, the others' stay."""
    torch.manual_seed(0)
    learner = make_learner(ppo=replace(PPO, updates=1, minibatch=64, epochs=4))
    loss, agent, starts = learner.losses["actor"], learner.agent, make_starts(64)
    loss.prepare(64)
    for update in range(1, 31):
        with torch.no_grad():
            features, action = imagine(agent.world_model.rssm, agent.actor, starts["belief"], starts["state"], 4)
            policy = agent.actor(features[:-1])
        loss._keep(
            features=features[:-1],
            action=action,
            old=torch.cat((policy.mean, policy.std), -1),
            advantage=action[..., :1],
            weight=torch.ones_like(action[..., :1]),
        )
        loss.improve(update)
    mean = agent.actor(torch.cat((starts["belief"], starts["state"]), -1)).mean
    assert mean[:, 0].mean() > 0.5
    assert (mean[:, 0] > 0.5).float().mean() > mean[:, 1:].gt(0.5).float().mean() + 0.3


def test_advantages_are_normalised_under_their_weights():
    learner = make_learner()
    loss = learner.losses["actor"]
    for _ in range(3):
        loss(make_starts())
    loss.weight.uniform_()
    loss.advantage.normal_(mean=3.0)
    records = kept_by(loss)
    advantage = normalised(records.advantage, records.weight)
    share = records.weight / records.weight.sum()
    mean = (share * advantage).sum()
    assert mean.item() == pytest.approx(0.0, abs=1e-4)
    assert (share * (advantage - mean).square()).sum().item() == pytest.approx(1.0, abs=1e-3)


def test_no_advantage_counts_for_more_than_the_clip(monkeypatch):
    loss = make_learner().losses["actor"]
    for _ in range(3):
        loss(make_starts())
    loss.weight.uniform_()
    loss.advantage.normal_(mean=3.0)
    loss.advantage[0, 0, 0], loss.weight[0, 0, 0] = 1e6, 1e-6  # rare, so that it does not stretch the deviation
    made = []
    monkeypatch.setattr(loss, "_make_epochs", lambda records: made.append(records) or {"ppo/kl": torch.zeros(())})
    loss._improve_on(kept_by(loss))
    assert made[0].advantage.max().item() == PPO.advantage_clip


def test_a_checkpoint_between_two_improvements_loses_nothing():
    from tests.learners.test_dreamer import make_batch

    numbers = replace(PPO, kl_target=1e-9)
    learner = make_learner(ppo=numbers)
    for _ in range(4):
        learner.update(make_batch())
    resumed = make_learner(ppo=numbers)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, resumed):
        torch.manual_seed(5)
        for _ in range(3):
            each.update(make_batch())
    for name, value in learner.agent.state_dict().items():
        assert torch.equal(value, resumed.agent.state_dict()[name]), name


def test_the_learning_rate_of_the_actor_falls_with_the_others():
    learner = make_learner()
    learner.adjust(rates=0.25)
    assert learner.losses["actor"].optimizer.param_groups[0]["lr"] == pytest.approx(0.25 * PPO.learning_rate)


def test_rollouts_of_another_number_of_starts_begin_anew():
    """Places that were never written hold no policy: an improvement waits until all are."""
    learner = make_learner()
    loss = learner.losses["actor"]
    loss(make_starts(6))
    for update in (2, 3, 4):
        loss(make_starts(9))
        assert bool(loss.improve(update)) == (update == 6)
    for update in (5, 6):
        loss(make_starts(9))
        metrics = loss.improve(update)
    assert metrics["gradient_norm/actor"].isfinite()


@pytest.mark.parametrize("changes", [{"ppo": replace(PPO, updates=2)}, {"ppo": replace(PPO, updates=7)},
                                     {"horizon": 3}], ids=["fewer", "more", "shorter"])  # fmt: skip
def test_a_checkpoint_of_other_rollouts_is_continued_without_them(changes):
    from tests.learners.test_dreamer import make_batch

    learner = make_learner()
    for _ in range(4):
        learner.update(make_batch())
    resumed = make_learner(**changes)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for _ in range(10):
        metrics = resumed.update(make_batch())
        assert all(value.isfinite() for value in metrics.values())


def test_a_gradient_that_is_not_finite_leaves_the_actor_as_it_was():
    from dreamer_racing.learners.finite_guard import NonFiniteLossError
    from tests.learners.test_dreamer import make_batch

    learner = make_learner()
    for _ in range(2):
        learner.update(make_batch())
    learner.losses["actor"].advantage[0, 0, 0] = math.nan
    before = copy.deepcopy(learner.agent.actor.state_dict())
    with pytest.raises(NonFiniteLossError, match="of the actor's improvement") as error:
        learner.update(make_batch())
    assert error.value.batch["advantage"].isnan().any(), "what is kept of it shows why"
    for name, value in learner.agent.actor.state_dict().items():
        assert torch.equal(value, before[name]), name
