"""Objectives of the policy, and how far it drifts."""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.losses import (
    OBJECTIVES,
    Latents,
    Trajectory,
    clipped_surrogate,
    dynamics,
    find_objective,
    normalized,
    policy_drift,
    reinforce,
)
from dreamer_racing.modules import SIZES, Actor
from dreamer_racing.modules.heads import ActionDistribution
from dreamer_racing.modules.rssm import CONTEXT
from tests.dreamers import learner_of
from tests.learners.test_dreamer_v3 import make_batch
from tests.modules.test_agent import collected, streams_of

H, N, A, F = 3, 4, 2, 5


def make_trajectory(**changes: object) -> Trajectory:
    generator = torch.Generator().manual_seed(0)
    mean = (torch.rand(H, N, A, generator=generator) - 0.5).requires_grad_()
    std = torch.rand(H, N, A, generator=generator) * 0.5 + 0.3
    one = torch.rand(H, N, 1, generator=generator)
    trajectory = Trajectory(
        policy=ActionDistribution(mean, std),
        features=torch.randn(H, N, F, generator=generator),
        action=torch.rand(H, N, A, generator=generator) - 0.5,
        previous_action=torch.zeros(H, N, A),
        behavior=ActionDistribution(mean.detach(), std),
        lambda_return=one + 1.0,
        value=one,
        advantage=torch.randn(H, N, 1, generator=generator),
        weight=torch.rand(H, N, 1, generator=generator),
        scale=torch.tensor(2.0),
    )
    return dataclasses.replace(trajectory, **changes)


def log_density(policy: ActionDistribution, action: Tensor) -> Tensor:
    normal = torch.distributions.Normal(policy.mean, policy.std)
    return normal.log_prob(action).sum(-1, keepdim=True)


def entropy_of(policy: ActionDistribution) -> Tensor:
    return torch.distributions.Normal(policy.mean, policy.std).entropy().sum(-1, keepdim=True)


def test_action_change_by_hand_pulls_neighbouring_means_together():
    trajectory = make_trajectory()
    mean, weight = trajectory.policy.mean, trajectory.weight
    change = trajectory.action_change()
    expected = sum(weight[t] * (mean[t] - mean[t - 1]).square().sum(-1, keepdim=True) for t in range(1, H)).sum()
    torch.testing.assert_close(change, expected / (H * N))
    change.backward()
    nearer = mean.detach() - 0.1 * mean.grad
    assert (nearer[1:] - nearer[:-1]).norm() < (mean[1:] - mean[:-1]).norm()
    first = make_trajectory(policy=ActionDistribution(mean[:1], mean[:1]), weight=weight[:1])
    assert first.action_change() == 0.0, "one step follows none"


def test_reinforce_by_hand():
    trajectory = make_trajectory()
    loss, metrics = reinforce(trajectory, entropy_scale=torch.tensor(0.3))
    gain = log_density(trajectory.policy, trajectory.action) * trajectory.advantage
    expected = -(trajectory.weight * (gain + 0.3 * entropy_of(trajectory.policy))).sum() / (H * N)
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(metrics["entropy"], entropy_of(trajectory.policy).mean())


def test_dynamics_by_hand():
    returns = make_trajectory().lambda_return.requires_grad_()
    trajectory = make_trajectory(lambda_return=returns)
    loss, _ = dynamics(trajectory, entropy_scale=torch.tensor(0.3))
    expected = -(trajectory.weight * (returns / 2.0 + 0.3 * entropy_of(trajectory.policy))).sum() / (H * N)
    torch.testing.assert_close(loss, expected)
    loss.backward()
    torch.testing.assert_close(returns.grad, -trajectory.weight / 2.0 / (H * N))
    assert dynamics.through_dynamics and not hasattr(reinforce, "through_dynamics")


def test_the_surrogate_is_the_advantage_before_the_first_step():
    """The ratio is one: nothing is clipped, and the gradient is that of the plain policy gradient."""
    trajectory = make_trajectory()
    loss, metrics = clipped_surrogate(trajectory, entropy_scale=torch.tensor(0.0), clip_epsilon=0.2)
    torch.testing.assert_close(loss, -(trajectory.weight * trajectory.advantage).mean())
    assert metrics["ppo/clipped"] == 0.0


@pytest.mark.parametrize(("ratio", "advantage", "gain"), [(1.5, 1.0, 1.2), (0.5, 1.0, 0.5), (0.5, -1.0, -0.8)])
def test_a_ratio_beyond_the_clip_gains_nothing_more(ratio, advantage, gain):
    """By hand: the log-probability of the old policy is lower by log(ratio), through its deviation alone."""
    mean, std = make_trajectory().policy
    action = mean.detach()
    taken = make_trajectory(
        policy=ActionDistribution(action, std),
        behavior=ActionDistribution(action, std * math.exp(math.log(ratio) / A)),  # density at the mean is 1 / std
        action=action,
        advantage=torch.full((H, N, 1), advantage),
        weight=torch.ones(H, N, 1),
    )
    loss, metrics = clipped_surrogate(taken, entropy_scale=torch.tensor(0.0), clip_epsilon=0.2)
    assert loss.item() == pytest.approx(-gain, rel=1e-5)
    assert metrics["ppo/clipped"] == 1.0


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


def test_normalized_advantages_have_mean_zero_and_deviation_one():
    found = normalized(torch.randn(50, 1) * 7 + 3)
    assert found.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert found.square().mean().item() == pytest.approx(1.0, rel=1e-4)


def test_a_mean_of_anything_but_a_number_for_each_step_is_refused():
    trajectory = make_trajectory()
    with pytest.raises(ValueError, match=rf"values of shape \({H}, {N}\): must be \({H}, {N}, 1\).*keepdim=True"):
        trajectory.mean(trajectory.advantage.squeeze(-1))


def test_drift_is_the_divergence_of_the_two_policies_and_trains_the_latents_alone():
    torch.manual_seed(0)
    actor = Actor(F, A, layers=1, units=8)
    torch.nn.init.normal_(actor.mlp.output.weight)
    before, after = torch.randn(2, 3, F, requires_grad=True), torch.randn(2, 3, F, requires_grad=True)
    weight = torch.tensor([[[1.0], [0.0], [1.0]], [[1.0], [1.0], [0.0]]])
    drift = policy_drift(actor, before, after, weight)
    old, new = (torch.distributions.Normal(*actor(features)) for features in (before, after))
    divergence = torch.distributions.kl_divergence(old, new).sum(-1, keepdim=True)
    torch.testing.assert_close(drift, (weight * divergence).sum() / 6)  # of all records, as other losses
    drift.backward()
    assert before.grad is None and after.grad.abs().sum() > 0
    assert all(parameter.grad is None and parameter.requires_grad for parameter in actor.parameters())
    assert policy_drift(actor, before, after, torch.zeros_like(weight)) == 0.0


def test_an_objective_is_found_by_its_name_or_in_a_module_of_ones_own(tmp_path, monkeypatch):
    assert find_objective("reinforce") is reinforce and set(OBJECTIVES) == {"reinforce", "dynamics", "clipped"}
    with pytest.raises(ValueError, match=r"Unknown objective 'reinforced' \(did you mean reinforce\?\).*: reinforce"):
        find_objective("reinforced")
    (tmp_path / "my_objectives.py").write_text(
        "from dreamer_racing.losses import dynamics, reinforce as mine\nother = 3\n"
    )
    monkeypatch.chdir(tmp_path)  # not on PYTHONPATH: the folder that one starts from is enough
    assert find_objective("my_objectives:mine") is reinforce
    with pytest.raises(
        ValueError, match=r"loss.actor=my_objectives:dynamics needs imagination's gradient: .*dreamer_v3"
    ):
        find_objective("my_objectives:dynamics", collected=True)
    with pytest.raises(ValueError, match="module 'my_objectives' has no 'missing'"):
        find_objective("my_objectives:missing")
    with pytest.raises(ValueError, match="'my_objectives:other' is not a function of a Trajectory"):
        find_objective("my_objectives:other")


def test_an_objective_that_is_not_found_says_where_it_was_looked_for_and_what_to_set(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    searched = rf"there is no nowhere\.py in {tmp_path}, nor on PYTHONPATH \(/somewhere\)"
    with pytest.raises(ValueError, match=f"{searched}.* set PYTHONPATH to that folder"):
        find_objective("nowhere:mine")
    (tmp_path / "imports_nothing.py").write_text("import that_is_not_there\n")
    with pytest.raises(ValueError, match="cannot be imported: No module named 'that_is_not_there'"):
        find_objective("imports_nothing:mine")


# Holding the policy where it was while the world model learns: what counts, who learns from it, and that it holds.


NO_DRAWS = replace(SIZES["debug"], sampled=False)


def make_learner(**numbers) -> DreamerV3:
    """Of latents that are not drawn, and an actor that tells them apart: a fresh one hardly does."""
    learner = learner_of(NO_DRAWS, seed=0, horizon=3, **numbers)
    nn.init.normal_(learner.agent.actor.mlp.output.weight, generator=torch.Generator().manual_seed(0))
    return learner


def latents_of(learner: DreamerV3, batch: TensorDictBase) -> Latents:
    return Latents(*(value.detach() for value in learner.world_model_loss(batch)[1]))


def stored_by(learner: DreamerV3) -> TensorDict:
    """A batch whose context is what the model makes of it now, of the record before, as a collector stores it."""
    batch = make_batch()
    batch["is_init"][:, 0] = True  # so that windows begin alike with a context and without
    seen = latents_of(learner, batch)
    before = (torch.roll(value, 1, 1) for value in seen)
    batch[CONTEXT] = learner.latent_format.pack(*before)
    return batch


def test_what_was_just_flown_has_not_drifted():
    """At every record of every window, whether the next one follows it or begins an episode."""
    learner = make_learner(drift_scale=1.0)
    streams, followed = streams_of(collected(learner.policy()), learner.latent_format), []
    for own in streams:
        for start in range(len(own) - 1):
            window = own[start:].unsqueeze(0)
            before, after, same = learner.stored_and_current_features(latents_of(learner, window), window)
            followed.append(same.flatten())
            torch.testing.assert_close(before[same.squeeze(-1)], after[same.squeeze(-1)], atol=2e-3, rtol=0)
    assert torch.cat(followed).any() and not torch.cat(followed).all()
    assert min(map(len, followed)) == 1 and max(map(len, followed)) > 10


def test_the_actor_of_an_update_learns_as_without_it():
    gradients = {}
    for scale in (0.0, 5.0):
        learner = make_learner(drift_scale=scale)
        batch = stored_by(learner)
        torch.manual_seed(0)  # of what is imagined
        learner._backward(batch)
        gradients[scale] = [parameter.grad.clone() for parameter in learner.agent.actor.parameters()]
    assert all(map(torch.equal, gradients[0.0], gradients[5.0])) and any(gradient.any() for gradient in gradients[0.0])


def test_what_has_not_changed_is_no_drift_nor_what_an_episode_begins_after():
    """The latents that the first record of an episode has stored are not those that its predecessor was seen with."""
    learner = make_learner(drift_scale=2.0)
    batch = stored_by(learner)
    losses = learner.compute_losses(batch)
    assert losses["policy_drift"] < 1e-3  # what float16 leaves
    assert losses["loss_drift"] == 2.0 * losses["policy_drift"]
    odd = copy.deepcopy(batch)
    odd[CONTEXT, "belief"][0, 3] = 1.0  # make_batch begins an episode there
    assert learner.compute_losses(odd)["policy_drift"] == losses["policy_drift"]
    odd[CONTEXT, "belief"][0, 2] = 1.0
    assert learner.compute_losses(odd)["policy_drift"] > 10 * losses["policy_drift"]


def test_records_without_latents_are_refused():
    with pytest.raises(KeyError, match=r"drift_scale=1 .* no 'context': store latents \(replay.context=true\), or set"):
        make_learner(drift_scale=1.0).update(make_batch())
    assert "loss_drift" not in make_learner().update(make_batch())


@pytest.mark.parametrize("few_kernels", [False, True])
def test_a_policy_that_is_held_moves_less_while_the_model_learns(few_kernels: bool):
    """The actor stands still, so what moves its actions on the same records is the model alone."""
    moved = {}
    for scale in (0.0, 3.0):
        learner = make_learner(drift_scale=scale, learning_rate=3e-3, warmup_updates=0, few_kernels=few_kernels)
        for group in learner.optimizer.param_groups[1:]:  # actor and critic
            group["lr"] = 0.0
        batch = stored_by(learner)
        actor = learner.agent.actor
        with torch.no_grad():
            before = actor(latents_of(learner, batch).features)
        for _ in range(20):
            learner.update(batch)
        with torch.no_grad():
            moved[scale] = before.divergence(actor(latents_of(learner, batch).features)).mean()
    assert moved[3.0] < 0.2 * moved[0.0]
