import math

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.losses import critic_loss, replay_critic_loss
from dreamer_racing.modules import Critic


def make_critic() -> Critic:
    return Critic(4, layers=1, units=8)


def make_batch() -> TensorDict:
    never = torch.zeros(2, 6, 1, dtype=torch.bool)
    flags = {"is_init": never, "terminated": never, "truncated": never}
    return TensorDict({"reward": torch.randn(2, 6, 1), **flags}, [2, 6])


def test_a_new_critic_is_uniform():
    """Cross entropy of a uniform prediction with two targets: the return and the slow value."""
    critic, features = make_critic(), torch.randn(2, 6, 4)
    loss, _ = critic_loss(critic, features, torch.randn(2, 6, 1), slow_scale=1.0)
    assert loss.shape == (2, 6, 1)
    torch.testing.assert_close(loss, torch.full_like(loss, 2 * math.log(255)))
    replayed = replay_critic_loss(critic, features, make_batch(), torch.tensor(0.9), 0.95, slow_scale=1.0)
    assert replayed.item() == pytest.approx(2 * math.log(255) * 5 / 6, rel=1e-5)


def test_gradient_reaches_the_critic_and_the_features_and_the_slow_copy_never():
    critic, features = make_critic(), torch.randn(2, 6, 4, requires_grad=True)
    torch.nn.init.normal_(critic.head.mlp.output.weight)
    replay_critic_loss(critic, features, make_batch(), torch.tensor(0.9), 0.95, slow_scale=1.0).backward()
    assert critic.head.mlp.output.weight.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in critic.slow_head.parameters())
    assert features.grad.abs().sum() > 0


def test_critic_learns_the_mean_of_a_random_return():
    torch.manual_seed(0)
    critic = Critic(4, layers=1, units=32, norm="layer")
    optimizer = torch.optim.Adam(critic.head.parameters(), lr=3e-2)
    features = torch.ones(3, 64, 4)
    for _ in range(150):
        returns = torch.randint(0, 2, (3, 64, 1)) * 10.0
        optimizer.zero_grad()
        critic_loss(critic, features, returns, slow_scale=0.0)[0].mean().backward()
        optimizer.step()
    assert critic.value(features).mean().item() == pytest.approx(5.0, abs=0.7)


def test_regularised_towards_the_slow_copy_not_the_critic_itself():
    critic, features = make_critic(), torch.randn(3, 4)
    with torch.no_grad():
        critic.slow_head.mlp.output.bias[200] = 60.0  # the slow copy is sure of bin 200
        critic.head.mlp.output.bias[127] = 5.0  # and the critic of bin 127, which is zero
    log_probabilities = critic.head.mlp.output.bias.detach().log_softmax(-1)
    expected = -(log_probabilities[127] + log_probabilities[200]).item()
    loss, _ = critic_loss(critic, features, torch.zeros(3, 1), slow_scale=1.0)
    assert loss.mean().item() == pytest.approx(expected, rel=1e-4)


def test_a_bootstrap_stands_for_the_critic_s_own_values():
    """At a window's last record but one the return is the reward and what the last is said to be worth."""
    critic, batch, features = make_critic(), make_batch(), torch.randn(2, 6, 4)
    losses = [
        replay_critic_loss(critic, features, batch, torch.tensor(0.9), 0.95, 0.0, bootstrap)
        for bootstrap in (None, torch.zeros(2, 6, 1))
    ]
    assert losses[0] == losses[1], "a new critic says zero"
    with torch.no_grad():
        critic.head.mlp.output.bias[130] = 5.0
    apart = [
        replay_critic_loss(critic, features, batch, torch.tensor(0.9), 0.95, 0.0, bootstrap)
        for bootstrap in (None, torch.zeros(2, 6, 1))
    ]
    assert apart[0] != apart[1]
