import torch

from dreamer_racing.losses import imagine
from dreamer_racing.losses.imagination import choose_starts
from dreamer_racing.modules import SIZES
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import Interface


def test_imagination_starts_where_told():
    agent = Agent(SIZES["debug"], Interface())
    belief, state = torch.randn(5, 32, requires_grad=True), torch.zeros(5, 16)
    features, action = imagine(agent.world_model.rssm, agent.actor, belief, state, horizon=3)
    assert features.shape == (4, 5, 48)
    assert action.shape == (3, 5, 4)
    assert torch.equal(features[0], torch.cat((belief, state), -1))
    assert features.requires_grad


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
