import torch
from tensordict import TensorDict
from torchrl.objectives.value.functional import td_lambda_return_estimate

from dreamer_racing.losses import imagine, lambda_return
from dreamer_racing.losses.imagination import choose_starts
from dreamer_racing.modules import SIZES
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import Interface


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


def test_imagination_starts_where_told():
    agent = Agent(SIZES["debug"], Interface())
    belief, state = torch.randn(5, 32, requires_grad=True), torch.zeros(5, 16)
    features, action = imagine(agent.world_model.rssm, agent.actor, belief, state, horizon=3)
    assert features.shape == (4, 5, 48)
    assert action.shape == (3, 5, 4)
    assert torch.equal(features[0], torch.cat((belief, state), -1))
    assert features.requires_grad


def test_imagination_begins_from_all_latents_or_from_recent_ones_first():
    belief = torch.arange(6.0).view(2, 3, 1)  # [B, T], D = 1: each tells its place
    context = TensorDict({"belief": belief.requires_grad_(), "state": 10 * belief}, [2, 3])
    terminated = (belief == 4).detach()
    starts = choose_starts(context, terminated)
    assert starts["belief"].flatten().tolist() == [0, 1, 2, 3, 4, 5] and not starts["belief"].requires_grad
    assert starts["terminated"].flatten().tolist() == [False, False, False, False, True, False]
    recent = torch.tensor([False, True]).view(2, 1, 1).expand(2, 3, 1)
    for number, allowed in ((2, {3, 4, 5}), (3, {3, 4, 5}), (5, {0, 1, 2, 3, 4, 5})):
        chosen = choose_starts(context, terminated, number, recent)
        places = chosen["belief"].flatten().tolist()
        assert len(set(places)) == number and set(places) <= allowed
        assert len({3, 4, 5} & set(places)) == min(number, 3), "recent ones first"
        assert chosen["state"].flatten().tolist() == [10 * place for place in places]
        assert chosen["terminated"].flatten().tolist() == [place == 4 for place in places]
    assert len(choose_starts(context, terminated, 99)) == 6, "no more than there are"
