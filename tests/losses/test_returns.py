"""λ-returns by hand, and against TorchRL's own."""

import pytest
import torch
from torchrl.objectives.dreamer_v3 import _replay_value_target
from torchrl.objectives.value.functional import td_lambda_return_estimate

from dreamer_racing.losses import lambda_return, replay_return, rollout_return


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


def test_lambda_return_ends_are_sums_and_one_step_targets():
    reward, next_value, discount = torch.randn(3, 5, 7, 1).unbind(0)
    one_step = lambda_return(reward, next_value, discount, 0.0)
    torch.testing.assert_close(one_step, reward + discount * next_value)
    whole = lambda_return(torch.ones(5, 1), torch.zeros(5, 1), torch.ones(5, 1), 1.0)
    torch.testing.assert_close(whole, torch.tensor([5.0, 4, 3, 2, 1]).unsqueeze(-1))


def test_lambda_return_agrees_with_torchrl():
    torch.manual_seed(0)
    reward, next_value = torch.randn(2, 9, 6, 1).unbind(0)
    terminated = torch.rand(9, 6, 1) < 0.2
    ours = lambda_return(reward, next_value, 0.997 * (~terminated).float(), 0.95)
    batch_first = [value.transpose(0, 1) for value in (next_value, reward, terminated, terminated)]
    oracle = td_lambda_return_estimate(0.997, 0.95, *batch_first[:2], done=batch_first[2], terminated=batch_first[3])
    torch.testing.assert_close(ours, oracle.transpose(0, 1))


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
