import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.dreamer_v3 import _replay_value_target

from dreamer_racing.losses import CriticLoss, replay_return
from dreamer_racing.modules import Critic


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool).view(1, -1, 1)


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, -1, 1)


NEVER = flags(0, 0, 0, 0)


def test_replay_return_by_hand_within_an_episode():
    returns, weight = replay_return(
        numbers(9, 1, 2, 3), numbers(10, 20, 30, 40), NEVER, NEVER, NEVER, discount=0.5, lambda_=0.5
    )
    # G_3 = 40; G_2 = 3 + 0.5·40 = 23; G_1 = 2 + 0.5·(15 + 11.5) = 15.25; G_0 = 1 + 0.5·(10 + 7.625) = 9.8125
    torch.testing.assert_close(returns, numbers(9.8125, 15.25, 23.0, 40.0))
    assert torch.equal(weight, numbers(1, 1, 1, 0))


def test_nothing_follows_a_terminated_record():
    returns, weight = replay_return(
        numbers(9, 1, 0, 3),
        numbers(10, 20, 30, 40),
        flags(0, 0, 1, 0),
        flags(0, 1, 0, 0),
        NEVER,
        discount=0.5,
        lambda_=0.5,
    )
    # Record 1 crashed: its return is 0 and record 0's is its reward alone. Record 2 begins anew.
    torch.testing.assert_close(returns, numbers(1.0, 0.0, 23.0, 40.0))
    assert torch.equal(weight, numbers(1, 1, 1, 0))


@pytest.mark.parametrize("truncated", [flags(0, 1, 0, 0), NEVER])
def test_a_truncated_record_bootstraps_from_its_own_value(truncated):
    """Also where only the following ``is_init`` tells that the stream was cut."""
    returns, weight = replay_return(
        numbers(9, 1, 0, 3),
        numbers(10, 20, 30, 40),
        flags(0, 0, 1, 0),
        NEVER,
        truncated,
        discount=0.5,
        lambda_=0.5,
    )
    torch.testing.assert_close(returns, numbers(1 + 0.5 * 20, 20.0, 23.0, 40.0))
    assert torch.equal(weight, numbers(1, 0, 1, 0))


def test_replay_return_agrees_with_torchrl():
    torch.manual_seed(0)
    reward, bootstrap = torch.randn(2, 5, 12, 1).unbind(0)
    terminated, truncated = (torch.rand(5, 12, 1) < 0.15 for _ in range(2))
    truncated &= ~terminated
    done = terminated | truncated
    is_init = torch.cat((torch.zeros(5, 1, 1, dtype=torch.bool), done[:, :-1]), 1)
    ours, weight = replay_return(reward, bootstrap, is_init, terminated, truncated, 1 - 1 / 333, 0.95)
    oracle = _replay_value_target(reward, done, terminated, bootstrap, 333.0, 0.95)
    goes_on = ~done[:, :-1, 0]
    torch.testing.assert_close(ours[:, :-1, 0][goes_on], oracle[goes_on])
    assert (weight[:, :-1, 0][goes_on] == 1).all()


def make_input(critic_features: int = 4, horizon: int = 3, starts: int = 5) -> TensorDict:
    torch.manual_seed(0)
    imagination = TensorDict(
        {
            "features": torch.randn(horizon, starts, critic_features),
            "lambda_return": torch.randn(horizon, starts, 1),
            "weight": torch.ones(horizon, starts, 1),
        },
        [horizon, starts],
    )
    never = torch.zeros(2, 6, 1, dtype=torch.bool)
    return TensorDict(
        {
            "imagination": imagination,
            "belief": torch.randn(2, 6, critic_features - 1, requires_grad=True),
            "state": torch.randn(2, 6, 1, requires_grad=True),
            "reward": torch.randn(2, 6, 1),
            "is_init": never,
            "terminated": never,
            "truncated": never,
        },
        [],
    )


def test_a_new_critic_is_uniform():
    """Cross entropy of a uniform prediction with two targets: the return and the slow value."""
    loss = CriticLoss(Critic(4, layers=1, units=8))
    losses = loss(make_input())
    assert set(losses.keys()) == set(loss.out_keys)
    assert losses["loss_critic"].item() == pytest.approx(2 * math.log(255), rel=1e-5)
    assert losses["loss_replay_critic"].item() == pytest.approx(0.3 * 2 * math.log(255) * 5 / 6, rel=1e-5)


def test_imagined_weight_scales_the_loss():
    critic, inputs = Critic(4, layers=1, units=8), make_input()
    inputs["imagination", "weight"] *= 0
    assert CriticLoss(critic)(inputs)["loss_critic"].item() == 0.0


def test_gradient_reaches_the_critic_alone_and_the_slow_copy_never():
    critic, inputs = Critic(4, layers=1, units=8), make_input()
    CriticLoss(critic)(inputs)["loss_critic"].backward()
    assert critic.head.mlp.output.weight.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in critic.slow_head.parameters())
    assert inputs["belief"].grad is None


def test_critic_learns_the_mean_of_a_random_return():
    torch.manual_seed(0)
    critic = Critic(4, layers=1, units=32, norm="layer")
    optimizer = torch.optim.Adam(critic.head.parameters(), lr=3e-2)
    loss = CriticLoss(critic, replay_value_scale=0.0, slow_critic_scale=0.0)
    inputs = make_input(starts=64)
    features = inputs["imagination", "features"].fill_(1.0)
    for _ in range(150):
        inputs["imagination", "lambda_return"] = torch.randint(0, 2, (3, 64, 1)) * 10.0
        optimizer.zero_grad()
        loss(inputs)["loss_critic"].backward()
        optimizer.step()
    assert critic.value(features).mean().item() == pytest.approx(5.0, abs=0.7)


def test_regularised_towards_the_slow_copy_not_the_critic_itself():
    critic, inputs = Critic(4, layers=1, units=8), make_input()
    inputs["imagination", "lambda_return"] *= 0
    with torch.no_grad():
        critic.slow_head.mlp.output.bias[200] = 60.0  # the slow copy is sure of bin 200
        critic.head.mlp.output.bias[127] = 5.0  # and the critic of bin 127, which is zero
    log_probabilities = critic.head.mlp.output.bias.detach().log_softmax(-1)
    expected = -(log_probabilities[127] + log_probabilities[200]).item()
    assert CriticLoss(critic)(inputs)["loss_critic"].item() == pytest.approx(expected, rel=1e-4)
