import math

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.losses import ReinforceLoss
from dreamer_racing.modules import SIZES
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import Interface


def make_agent() -> Agent:
    torch.manual_seed(0)
    agent = Agent(SIZES["debug"], Interface())
    with torch.no_grad():
        agent.world_model.reward_head.mlp.output.weight.normal_(std=0.01)
        agent.critic.head.mlp.output.weight.normal_(std=0.01)
    return agent


def make_loss(agent: Agent, **options) -> ReinforceLoss:
    return ReinforceLoss(agent.world_model, agent.actor, agent.critic, horizon=5, **options)


def make_starts(count: int = 6, terminated: tuple[int, ...] = ()) -> TensorDict:
    flags = torch.zeros(count, 1, dtype=torch.bool)
    flags[list(terminated)] = True
    return TensorDict(
        {
            "belief": torch.randn(count, 32, requires_grad=True),
            "state": torch.zeros(count, 16, requires_grad=True),
            "terminated": flags,
        },
        [count],
    )


def always_continue(agent: Agent, probability: float = 1.0) -> None:
    output = agent.world_model.continue_head.mlp.output
    with torch.no_grad():
        output.weight.zero_()
        output.bias.fill_(1e4 if probability == 1.0 else math.log(probability / (1 - probability)))


def test_keys_and_shapes():
    losses = make_loss(make_agent())(make_starts())
    assert set(losses.keys()) == set(make_loss(make_agent()).out_keys)
    imagination = losses["imagination"]
    assert imagination.batch_size == (5, 6)
    assert imagination["features"].shape == (5, 6, 48)
    assert imagination["lambda_return"].shape == imagination["weight"].shape == (5, 6, 1)
    assert all(value.shape == () for key, value in losses.items() if key != "imagination")


def test_only_the_actor_gets_a_gradient():
    agent, starts = make_agent(), make_starts()
    make_loss(agent)(starts)["loss_actor"].backward()
    assert all(parameter.grad is None for parameter in agent.world_model.parameters())
    assert all(parameter.grad is None for parameter in agent.critic.parameters())
    assert starts["belief"].grad is None
    assert all(parameter.grad.abs().sum() > 0 for parameter in agent.actor.parameters())


def test_terminal_starts_get_no_weight_by_their_true_continuation():
    """However sure the model is that the episode goes on, a start that was terminal counts for nothing."""
    agent = make_agent()
    always_continue(agent)
    weight = make_loss(agent)(make_starts(terminated=(0, 3)))["imagination", "weight"]
    assert torch.equal(weight[:, [0, 3]], torch.zeros(5, 2, 1))
    assert (weight[:, [1, 2, 4, 5]] > 0.98).all()


def test_weight_is_the_discounted_chance_of_getting_there():
    agent = make_agent()
    always_continue(agent, 0.5)
    weight = make_loss(agent, discount=0.9)(make_starts())["imagination", "weight"]
    expected = torch.tensor([0.45**step for step in range(5)]).view(5, 1, 1).expand(5, 6, 1)
    torch.testing.assert_close(weight, expected)


def test_return_scale_moves_towards_the_percentiles_and_is_at_least_one():
    loss = make_loss(make_agent())
    assert loss.return_normalizer.scale().item() == 1.0
    returns = torch.linspace(0, 1000, 101).view(-1, 1)
    loss.return_normalizer.update(returns)
    # One percent of the way from 0 to 50 and to 950.
    assert loss.return_normalizer.scale().item() == pytest.approx(9.0, rel=1e-3)
    loss.eval()
    loss(make_starts())
    assert loss.return_normalizer.scale().item() == pytest.approx(9.0, rel=1e-3)


def test_loss_is_minus_the_entropy_bonus_where_nothing_is_to_be_gained():
    torch.manual_seed(0)
    agent = Agent(SIZES["debug"], Interface())  # reward and critic are exactly zero
    always_continue(agent)
    losses = make_loss(agent, entropy_scale=0.5, discount=1.0)(make_starts())
    torch.testing.assert_close(losses["loss_actor"], -0.5 * losses["entropy"])


def test_reinforcing_moves_the_policy_to_the_rewarded_action():
    """With a reward that grows with the first action's mean effect, that mean rises."""
    torch.manual_seed(0)
    agent = Agent(SIZES["debug"], Interface())
    always_continue(agent)
    # The reward head reads the belief's first unit, which here is the action's first dimension.
    agent.world_model.rssm.cell.project_action = lambda action: action
    agent.world_model.rssm.cell.forward = lambda belief, state, action: torch.cat((action, belief[:, 4:]), -1)
    agent.world_model.reward_head.mean = lambda features: features[..., :1]
    optimizer = torch.optim.Adam(agent.actor.parameters(), lr=1e-2)
    loss = make_loss(agent)
    starts = make_starts(64)
    for _ in range(60):
        optimizer.zero_grad()
        loss(starts)["loss_actor"].backward()
        optimizer.step()
    features = torch.cat((starts["belief"], starts["state"]), -1)
    mean = agent.actor(features).mean.mean(0)
    assert mean[0] > 0.5
    assert mean[1:].abs().max() < mean[0]
