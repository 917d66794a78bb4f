"""Returns, what the critic learns of them, and imagination."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.dreamer_v3 import _replay_value_target
from torchrl.objectives.value.functional import td_lambda_return_estimate

from dreamer_racing.losses import (
    choose_starts,
    critic_loss,
    lambda_return,
    replay_critic_loss,
    replay_return,
    rollout_return,
)
from dreamer_racing.modules import Critic


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool).view(1, -1, 1)


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(1, -1, 1)


NEVER = flags(0, 0, 0, 0)


def test_lambda_return_by_hand():
    reward, next_value = torch.tensor([1.0, 2.0]), torch.tensor([10.0, 20.0])
    # G_1 = 2 + 0.5·20 = 12; G_0 = 1 + 0.9·(0.5·10 + 0.5·12) = 10.9
    returns = lambda_return(reward, next_value, torch.tensor([0.9, 0.5]), 0.5)
    torch.testing.assert_close(returns, torch.tensor([10.9, 12.0]))


def test_lambda_return_agrees_with_torchrl():
    torch.manual_seed(0)
    reward, next_value = torch.randn(2, 9, 6, 1).unbind(0)
    terminated = torch.rand(9, 6, 1) < 0.2
    ours = lambda_return(reward, next_value, 0.997 * (~terminated).float(), 0.95)
    batch_first = [value.transpose(0, 1) for value in (next_value, reward, terminated, terminated)]
    oracle = td_lambda_return_estimate(0.997, 0.95, *batch_first[:2], done=batch_first[2], terminated=batch_first[3])
    torch.testing.assert_close(ours, oracle.transpose(0, 1))


@pytest.mark.parametrize(
    ("is_init", "terminated", "truncated", "returns", "weight"),
    [
        # G_3 = 40; G_2 = 3 + 0.5·40 = 23; G_1 = 2 + 0.5·(15 + 11.5) = 15.25; G_0 = 1 + 0.5·(10 + 7.625) = 9.8125
        (NEVER, NEVER, NEVER, (9.8125, 15.25, 23.0, 40.0), (1, 1, 1, 0)),
        # Record 1 crashed: its return is 0 and record 0's is its reward alone. Record 2 begins anew.
        (flags(0, 0, 1, 0), flags(0, 1, 0, 0), NEVER, (1.0, 0.0, 23.0, 40.0), (1, 1, 1, 0)),
        # A truncated record bootstraps from its own value, also where only the following ``is_init`` tells of the cut.
        (flags(0, 0, 1, 0), NEVER, flags(0, 1, 0, 0), (1 + 0.5 * 20, 20.0, 23.0, 40.0), (1, 0, 1, 0)),
        (flags(0, 0, 1, 0), NEVER, NEVER, (1 + 0.5 * 20, 20.0, 23.0, 40.0), (1, 0, 1, 0)),
    ],
    ids=["within an episode", "crash", "truncation", "cut"],
)
def test_replay_return_by_hand(is_init, terminated, truncated, returns, weight):
    ends = (is_init, terminated, truncated)
    found, weights = replay_return(numbers(9, 1, 2, 3), numbers(10, 20, 30, 40), *ends, discount=0.5, lambda_=0.5)
    torch.testing.assert_close(found, numbers(*returns))
    assert torch.equal(weights, numbers(*weight))


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


def test_rollout_return_by_hand():
    """Four steps of one environment: a crash after the second; what follows the last was not seen."""
    reward, value = torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([10.0, 20.0, 30.0, 40.0])
    ended = torch.tensor([False, True, False, False])
    shaped = (values.view(4, 1, 1) for values in (reward, value, ended, ended))
    returns = rollout_return(*shaped, discount=torch.tensor(0.9), lambda_=0.8).flatten()
    last = 4 + 0.9 * 40
    third = 3 + 0.9 * (0.2 * 40 + 0.8 * last)
    first = 1 + 0.9 * (0.2 * 20 + 0.8 * 2)
    torch.testing.assert_close(returns, torch.tensor([first, 2.0, third, last]))


def test_where_time_runs_out_the_value_of_the_step_stands_for_what_comes():
    reward, value = torch.tensor([1.0, 2.0]).view(2, 1, 1), torch.tensor([10.0, 20.0]).view(2, 1, 1)
    done = torch.tensor([True, False]).view(2, 1, 1)
    returns = rollout_return(reward, value, done, torch.zeros_like(done), torch.tensor(0.9), 0.8)
    assert returns[0].item() == pytest.approx(1 + 0.9 * 10)


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


def test_a_bootstrap_stands_for_the_critic_s_own_values():
    """At a window's last record but one the return is the reward and what the last is said to be worth."""
    critic, batch, features = make_critic(), make_batch(), torch.randn(2, 6, 4)

    def losses() -> list[float]:
        own_and_zero = (None, torch.zeros(2, 6, 1))
        numbers = (torch.tensor(0.9), 0.95, 0.0)
        return [replay_critic_loss(critic, features, batch, *numbers, bootstrap).item() for bootstrap in own_and_zero]

    own, zero = losses()
    assert own == zero, "a new critic says zero"
    with torch.no_grad():
        critic.head.mlp.output.bias[130] = 5.0
    own, zero = losses()
    assert own != zero


def test_imagination_begins_from_all_latents_or_from_some_drawn():
    belief = torch.arange(6.0).view(2, 3, 1).requires_grad_()  # [B, T], D = 1: each tells its place
    latents = (belief, 10 * belief, (belief == 4).detach(), -belief.detach())
    starts = choose_starts(*latents)
    assert starts.belief.flatten().tolist() == [0, 1, 2, 3, 4, 5] and not starts.belief.requires_grad
    assert starts.terminated.flatten().tolist() == [False, False, False, False, True, False]
    for number in (2, 5):
        chosen = choose_starts(*latents, number)
        places = chosen.belief.flatten().tolist()
        assert len(set(places)) == number and set(places) <= {0, 1, 2, 3, 4, 5}
        assert chosen.state.flatten().tolist() == [10 * place for place in places]
        assert chosen.terminated.flatten().tolist() == [place == 4 for place in places]
        assert chosen.previous_action.flatten().tolist() == [-place for place in places]
    assert len(choose_starts(*latents, 99).belief) == 6, "no more than there are"
