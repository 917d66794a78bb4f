from dataclasses import replace

import pytest
import torch

from dreamer_racing.modules import Interface, WorldModel, get_size
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.parallel_rssm import LAYERS, TIME_CONSTANTS, DiagonalSSM, ParallelRSSM
from tests.modules.test_linear_recurrence import Counter

CPU = torch.device("cpu")


def make_rssm() -> ParallelRSSM:
    torch.manual_seed(0)
    rssm = ParallelRSSM(embedding=8, action=4, belief=16, latents=3, classes=4, hidden=8, learned_initial=True)
    torch.nn.init.normal_(rssm.initial_belief)
    return rssm


def make_window(batch: int = 3, time: int = 11) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return torch.randn(batch, time, 8), torch.rand(batch, time, 4) * 2 - 1, torch.zeros(batch, time, dtype=torch.bool)


def act(rssm, embedding, action, is_init, belief, state) -> tuple[torch.Tensor, torch.Tensor]:
    """Beliefs and states of a window, step by step, as acting makes them."""
    beliefs, states = [], []
    for seen, led, begins in zip(embedding.unbind(1), action.unbind(1), is_init.unbind(1), strict=True):
        belief, state = rssm.observe_step(seen, led, begins, belief, state, deterministic=True)
        beliefs.append(belief)
        states.append(state)
    return torch.stack(beliefs, 1), torch.stack(states, 1)


@pytest.mark.parametrize("reset", [*range(11), "everywhere", "nowhere"])
def test_a_window_is_acting_step_by_step_wherever_an_episode_begins(reset):
    """From latents that were carried, as a replay gives them."""
    rssm = make_rssm()
    embedding, action, is_init = make_window()
    if reset == "everywhere":
        is_init[:] = True
    elif reset != "nowhere":
        is_init[1, reset] = True
    carried = torch.rand(3, 16) * 2 - 1, torch.nn.functional.one_hot(torch.randint(4, (3, 3)), 4).flatten(1).float()
    window = rssm.observe(embedding, action, is_init, carried, deterministic=True)
    belief, state = act(rssm, embedding, action, is_init, *carried)
    torch.testing.assert_close(window.belief, belief)
    assert torch.equal(window.state, state)


def test_steps_under_autocast_are_the_window_too():
    """Decays and sums stay float32: layers round to bfloat16 alike, once a step and once a window."""
    rssm = make_rssm()
    embedding, action, is_init = make_window()
    is_init[0, 4] = True
    start = tuple(value.detach().expand(3, -1) for value in rssm.initial())
    exact = rssm.observe(embedding, action, is_init, start, deterministic=True)
    with autocast(CPU, enabled=True):
        window = rssm.observe(embedding, action, is_init, start, deterministic=True)
        belief, _ = act(rssm, embedding, action, is_init, *start)
    assert window.belief.dtype == belief.dtype == torch.float32
    torch.testing.assert_close(window.belief, belief, atol=2e-3, rtol=0)
    torch.testing.assert_close(window.belief, exact.belief, atol=3e-2, rtol=0)


def test_what_a_reset_forgets_need_not_be_a_number():
    rssm = make_rssm()
    embedding, action, is_init = make_window(time=2)
    is_init[:, 0] = True
    expected = rssm.observe(embedding, action, is_init, deterministic=True).belief
    garbage = torch.full((3, 16), torch.nan), torch.full((3, 12), torch.nan)
    assert torch.equal(rssm.observe(embedding, action, is_init, garbage, deterministic=True).belief, expected)


def test_the_posterior_sees_the_observation_alone():
    rssm = make_rssm()
    embedding, action, is_init = make_window()
    first = rssm.observe(embedding, action, is_init, deterministic=True)
    other = rssm.observe(embedding, -action, is_init, (torch.ones(3, 16), torch.zeros(3, 12)), deterministic=True)
    assert torch.equal(first.posterior_logits, other.posterior_logits)
    assert not torch.equal(first.prior_logits, other.prior_logits)


def test_a_belief_stays_within_the_bounds_of_its_stored_form():
    rssm = make_rssm()
    for parameter in rssm.cell.parameters():
        parameter.data.mul_(30.0)
    embedding, action, is_init = make_window(time=64)
    start = torch.ones(3, 16), torch.zeros(3, 12)
    assert rssm.observe(embedding, action, is_init, start).belief.abs().max() <= 1.0 + 1e-6


def test_a_fresh_layer_forgets_at_its_time_constants():
    """With inputs of zero a belief decays by 1 − 1/τ a step."""
    cell = DiagonalSSM(belief=16, state=6, action=4, hidden=8, norm="layer")
    for parameter in [*cell.inputs.parameters(), *cell.mixes.parameters()]:
        parameter.data.zero_()
    after = cell(torch.ones(1, 16), torch.zeros(1, 6), cell.project_action(torch.zeros(1, 4)))
    for part in after.chunk(LAYERS, -1):
        torch.testing.assert_close(1 / (1 - part[0, [0, -1]]), torch.tensor(TIME_CONSTANTS), rtol=1e-4, atol=0)
        assert (part.diff() > 0).all()


def test_the_second_layer_reads_the_first_and_teaches_it():
    rssm = make_rssm()
    second = rssm.observe(*make_window()).belief.chunk(LAYERS, -1)[1]
    second.square().sum().backward()
    assert rssm.cell.gates[0].weight.grad.abs().sum() > 0


def test_a_window_costs_a_few_calls_more_where_it_is_longer():
    rssm = make_rssm()
    calls = {}
    for time in (16, 32, 256):
        window = make_window(time=time)
        with Counter() as counter:
            rssm.observe(*window).prior_logits.sum().backward()
        calls[time] = counter.calls
    assert calls[256] - calls[32] == 3 * (calls[32] - calls[16]) < calls[16]


def test_sizes_choose_it_and_bad_ones_are_refused():
    assert isinstance(WorldModel("ssm_debug").rssm, ParallelRSSM)
    with pytest.raises(ValueError, match=r"belief=15 must divide into 2 layers"):
        DiagonalSSM(belief=15, state=6, action=4, hidden=8, norm="layer")
    with pytest.raises(ValueError, match=r"'mine' has recurrence='mamba'; there are block, dense, ssm"):
        WorldModel(replace(get_size("debug"), name="mine", recurrence="mamba"), Interface())
