"""Heads, critic, actor and the actor's distribution."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Independent, Normal
from torchrl.modules import SymExpTwoHot
from torchrl.objectives.dreamer_v3 import two_hot_cross_entropy

from dreamer_racing.modules.heads import (
    FIRST_STD,
    MLP,
    ActionDistribution,
    Actor,
    ContinueHead,
    Critic,
    TwoHot,
    clipped_mean,
    symexp,
    symlog,
)


def test_symlog_and_symexp_are_known_and_inverse():
    values = torch.tensor([0.0, 1.0, -1.0, math.e - 1, -100.0])
    torch.testing.assert_close(symlog(values)[3], torch.tensor(1.0))
    torch.testing.assert_close(symlog(values)[1:3], torch.tensor([math.log(2), -math.log(2)]))
    torch.testing.assert_close(symexp(symlog(values)), values)


def test_two_hot_puts_a_number_between_its_neighbours():
    # Five bins: symexp of -20, -10, 0, 10, 20.
    two_hot = TwoHot(5)
    ten = math.expm1(10.0)
    index, weight = two_hot.encode(torch.tensor([[0.25 * ten], [-0.25 * ten], [0.0], [ten]]))
    dense = torch.zeros(4, 5).scatter_add_(-1, index, weight)
    expected = torch.tensor([[0, 0, 0.75, 0.25, 0], [0, 0.25, 0.75, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]])
    torch.testing.assert_close(dense, expected.float())


def test_two_hot_agrees_with_torchrl():
    torch.manual_seed(0)
    two_hot, oracle = TwoHot(255), SymExpTwoHot(255)
    target = symexp(torch.linspace(-21, 21, 101)).unsqueeze(-1)
    logits = torch.randn(101, 255)
    index, weight = two_hot.encode(target)
    dense = torch.zeros(101, 255).scatter_add_(-1, index, weight)
    torch.testing.assert_close(dense, oracle.encode(target.squeeze(-1)), atol=1e-4, rtol=1e-4)
    expected = two_hot_cross_entropy(logits, target, two_hot.values).unsqueeze(-1)
    torch.testing.assert_close(two_hot.cross_entropy(logits.log_softmax(-1), target), expected)
    torch.testing.assert_close(two_hot.decode(logits).squeeze(-1), oracle.decode(logits), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("bins", [1, 4])
def test_two_hot_refuses_an_even_or_tiny_number_of_bins(bins):
    with pytest.raises(ValueError, match="odd number"):
        TwoHot(bins)


@pytest.mark.parametrize("norm", ["rms", "layer"])
def test_mlp_and_continue_head_shapes(norm):
    features = torch.randn(2, 3, 8)
    assert MLP(8, 5, layers=2, units=16, norm=norm)(features).shape == (2, 3, 5)
    probability = ContinueHead(8, layers=1, units=16, norm=norm).probability(features)
    assert probability.shape == (2, 3, 1)
    assert ((probability > 0) & (probability < 1)).all()


@pytest.mark.parametrize("enabled", [False, True], ids=["float32", "autocast"])
def test_two_hot_decodes_what_it_encodes_and_keeps_its_precision_under_autocast(enabled):
    two_hot, values = TwoHot(255), torch.tensor([[0.0], [0.01], [0.333], [-3.7], [-17.77], [25.0], [53.2], [-1234.5]])
    index, weight = two_hot.encode(values)
    logits = torch.zeros(len(values), 255).scatter_(-1, index, weight).clamp_min(1e-30).log()
    with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
        decoded = two_hot.decode(logits)
    assert decoded.dtype == torch.float32
    torch.testing.assert_close(decoded, values, rtol=1e-5, atol=1e-5)


def test_slow_copy_moves_by_the_rate_and_never_trains():
    critic = Critic(4, layers=1, units=8)
    fast, slow = critic.head.mlp.output.bias, critic.slow_head.mlp.output.bias
    with torch.no_grad():
        fast.fill_(1.0)
    assert torch.equal(slow, torch.zeros_like(slow))
    critic.update_slow(0.25)
    torch.testing.assert_close(slow, torch.full_like(slow, 0.25))
    critic.update_slow(0.25)
    torch.testing.assert_close(slow, torch.full_like(slow, 0.4375))
    assert not any(parameter.requires_grad for parameter in critic.slow_head.parameters())


def test_new_critic_expects_nothing():
    critic = Critic(4, layers=1, units=8)
    features = torch.randn(3, 5, 4)
    assert torch.equal(critic.value(features), torch.zeros(3, 5, 1))
    assert torch.equal(critic.slow_value(features), torch.zeros(3, 5, 1))
    assert not critic.slow_value(features).requires_grad


# The mean of clipped samples: by quadrature, by symmetry, and in the limits.


@pytest.mark.parametrize("mean", [-3.0, -0.4, 0.0, 0.9, 1.0, 2.5])
@pytest.mark.parametrize("std", [0.05, 0.4, 2.0])
def test_it_is_the_integral(mean: float, std: float) -> None:
    deviations = torch.linspace(-10.0, 10.0, 200_001, dtype=torch.float64)
    density = torch.exp(-0.5 * deviations.square()) / (2.0 * torch.pi) ** 0.5
    integral = torch.trapezoid((mean + std * deviations).clamp(-1.0, 1.0) * density, deviations)
    found = clipped_mean(torch.tensor(mean, dtype=torch.float64), torch.tensor(std, dtype=torch.float64))
    assert found.item() == pytest.approx(integral.item(), abs=1e-6)


def test_without_noise_it_is_the_clipped_mean_and_never_beyond() -> None:
    mean = torch.linspace(-4.0, 4.0, 81)
    torch.testing.assert_close(clipped_mean(mean, torch.tensor(1e-6)), mean.clamp(-1.0, 1.0))
    for std in (1e-3, 0.3, 5.0):
        found = clipped_mean(mean, torch.tensor(std))
        assert found.abs().max() <= 1.0 + 1e-6
        torch.testing.assert_close(found, -found.flip(0), atol=1e-6, rtol=0.0)
    assert clipped_mean(torch.zeros(5, 3, 4), torch.ones(4)).shape == (5, 3, 4)


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


def test_samples_have_mean_and_std_and_the_deterministic_action_is_their_clipped_mean():
    torch.manual_seed(0)
    policy = ActionDistribution(torch.tensor([-1.0, 0.3, 0.97]), torch.tensor([0.15, 0.15, 0.05]))
    samples = ActionDistribution(*(part.expand(100_000, 3) for part in policy)).sample()
    torch.testing.assert_close(samples.mean(0), policy.mean, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(samples.std(0), policy.std, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(policy.clipped_mean(), samples.clamp(-1.0, 1.0).mean(0), atol=2e-3, rtol=0.0)
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
