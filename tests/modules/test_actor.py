import math

import pytest
import torch
from torch.distributions import Independent, Normal

from dreamer_racing.modules.actor import FIRST_STD, ActionDistribution, Actor


def test_entropy_of_a_normal_in_closed_form():
    policy = ActionDistribution(torch.zeros(1, 2), torch.tensor([[0.1, 1.0]]))
    expected = math.log(0.1) + 2 * 0.5 * math.log(2 * math.pi * math.e)
    torch.testing.assert_close(policy.entropy(), torch.tensor([[expected]]))


def test_log_prob_and_entropy_agree_with_torch():
    torch.manual_seed(0)
    policy = Actor(6, 4, layers=1, units=8)(torch.randn(5, 6))
    oracle = Independent(Normal(policy.mean, policy.std), 1)
    action = policy.sample()
    torch.testing.assert_close(policy.log_prob(action), oracle.log_prob(action).unsqueeze(-1))
    torch.testing.assert_close(policy.entropy(), oracle.entropy().unsqueeze(-1))


def test_mean_and_std_stay_within_their_bounds():
    actor = Actor(6, 4, layers=1, units=8)
    with torch.no_grad():
        actor.mlp.output.weight.mul_(1e5)
    policy = actor(torch.randn(64, 6))
    assert policy.mean.abs().max() <= 1
    assert policy.std.min() >= 0.1
    assert policy.std.max() <= 1.0 + 1e-6
    assert (policy.clipped_mean().abs() <= policy.mean.abs()).all()  # noise keeps it off the bounds


def test_the_deterministic_action_is_the_mean_of_what_an_environment_gets():
    torch.manual_seed(0)
    policy = ActionDistribution(torch.tensor([-1.0, 0.3, 0.97]), torch.tensor([0.15, 0.15, 0.05]))
    flown = policy.sample(torch.randn(100_000, 3)).clamp(-1.0, 1.0).mean(0)
    torch.testing.assert_close(policy.clipped_mean(), flown, atol=2e-3, rtol=0.0)
    assert policy.clipped_mean()[0].item() == pytest.approx(-1.0 + 0.15 / math.sqrt(2 * math.pi), abs=1e-6)


def test_new_actor_explores_around_zero():
    policy = Actor(6, 4, layers=1, units=8)(torch.randn(64, 6))
    assert policy.mean.abs().max() < 0.1
    expected = 0.1 + 0.9 / (1 + math.exp(-2))
    torch.testing.assert_close(policy.std, torch.full_like(policy.std, expected), atol=0.02, rtol=0)


def test_a_deviation_of_its_own_is_the_same_in_all_states_and_learned():
    actor = Actor(6, 4, layers=1, units=8, min_std=0.05, state_std=False)
    policy = actor(torch.randn(64, 6))
    torch.testing.assert_close(policy.std, torch.full_like(policy.std, FIRST_STD))
    policy.entropy().mean().backward()
    assert (actor.raw_std.grad > 0).all()
    assert all(parameter.grad is None for parameter in actor.mlp.parameters())
    with torch.no_grad():
        actor.raw_std[0] = -100.0
    assert actor(torch.randn(1, 6)).std[0, 0].item() == pytest.approx(0.05)


@pytest.mark.parametrize("min_std", [0.6, 0.9, 1.0])
def test_a_deviation_of_its_own_begins_within_its_bounds(min_std):
    policy = Actor(6, 4, layers=1, units=8, min_std=min_std, state_std=False)(torch.randn(3, 6))
    assert policy.std.isfinite().all() and policy.std.min() >= min_std and policy.std.max() <= 1.0


def test_samples_have_the_mean_and_std():
    torch.manual_seed(0)
    samples = ActionDistribution(torch.full((20000, 1), 0.5), torch.full((20000, 1), 0.2)).sample()
    torch.testing.assert_close(samples.mean(), torch.tensor(0.5), atol=0.01, rtol=0)
    torch.testing.assert_close(samples.std(), torch.tensor(0.2), atol=0.01, rtol=0)
