"""Recurrent state-space models, with a loop over time and without."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from dreamer_racing.modules import Interface, WorldModel, get_size
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.linear_recurrence import linear_recurrence
from dreamer_racing.modules.parallel_rssm import LAYERS, TIME_CONSTANTS, DiagonalSSM, ParallelRSSM
from dreamer_racing.modules.recurrent_cells import BlockGRUCell
from dreamer_racing.modules.rssm import RSSM, mix_uniform, sample_one_hot
from dreamer_racing.modules.world_model import RSSMS

KINDS = [
    {"recurrence": "dense", "norm": "layer", "learned_initial": False},
    {"recurrence": "dense", "norm": "layer", "learned_initial": True},
    {"recurrence": "block", "norm": "rms", "learned_initial": False},
    {"recurrence": "ssm", "norm": "layer", "learned_initial": False},
    {"recurrence": "ssm", "norm": "rms", "learned_initial": True},
]


def make_rssm(**kind) -> RSSM:
    torch.manual_seed(0)
    rssm = RSSMS[kind["recurrence"]](embedding=8, action=4, belief=16, latents=3, classes=4, hidden=8, blocks=4, **kind)
    if rssm.learned_initial:
        torch.nn.init.normal_(rssm.initial_belief)
    return rssm


def make_sequence(batch: int = 2, time: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    is_init = torch.zeros(batch, time, dtype=torch.bool)
    is_init[0, 0] = True
    is_init[1, 3] = True
    return torch.randn(batch, time, 8), torch.rand(batch, time, 4) * 2 - 1, is_init


def test_uniform_mixture_by_hand():
    probabilities = mix_uniform(torch.tensor([[0.0, math.log(3.0)]]), 0.01)
    torch.testing.assert_close(probabilities, torch.tensor([[0.99 * 0.25 + 0.005, 0.99 * 0.75 + 0.005]]))


def test_samples_follow_their_probabilities():
    torch.manual_seed(0)
    probabilities = torch.tensor([0.1, 0.2, 0.3, 0.4])
    samples = sample_one_hot(probabilities.expand(20000, 1, 4), torch.rand(20000, 1, 1))
    assert torch.equal(samples.sum(-1), torch.ones(20000, 1))
    torch.testing.assert_close(samples.mean((0, 1)), probabilities, atol=0.015, rtol=0)


def test_sample_survives_rounding_at_the_end_of_the_distribution():
    probabilities = torch.tensor([[0.5, 0.4999]])
    assert torch.equal(sample_one_hot(probabilities, torch.tensor([[0.99999]])), torch.tensor([[0.0, 1.0]]))
    assert torch.equal(sample_one_hot(probabilities, torch.tensor([[0.0]])), torch.tensor([[1.0, 0.0]]))


def test_sample_passes_the_gradient_straight_through():
    probabilities = torch.tensor([[0.25, 0.75]], requires_grad=True)
    weights = torch.tensor([[2.0, 5.0]])
    (sample_one_hot(probabilities, None) * weights).sum().backward()
    torch.testing.assert_close(probabilities.grad, weights)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("deterministic", [False, True])
def test_unroll_equals_acting_step_by_step(kind, deterministic, monkeypatch):
    """Acting and training give the same latents for the same history, also across a reset inside the window."""
    rssm = make_rssm(**kind)
    embedding, action, is_init = make_sequence()
    noise = torch.rand(6, 2, 3, 1)
    monkeypatch.setattr(rssm, "draw_noise", lambda *batch: noise)
    posterior = rssm.observe(embedding, action, is_init, deterministic=deterministic)
    belief, state = (value.expand(2, -1) for value in rssm.initial())
    for step in range(6):
        monkeypatch.setattr(rssm, "draw_noise", lambda *batch, step=step: noise[step])
        belief, state = rssm.observe_step(
            embedding[:, step], action[:, step], is_init[:, step], belief, state, deterministic
        )
        torch.testing.assert_close(belief, posterior.belief[:, step])
        torch.testing.assert_close(state, posterior.state[:, step])


@pytest.mark.parametrize("kind", KINDS)
def test_reset_forgets_everything_before_it(kind):
    rssm = make_rssm(**kind)
    embedding, action, is_init = make_sequence()
    whole = rssm.observe(embedding, action, is_init, deterministic=True)
    # Row 1 resets at record 3: a window that starts there must give the same, whatever its first action says.
    tail = rssm.observe(
        embedding[1:, 3:], torch.ones(1, 3, 4).copy_(action[1:, 3:]), is_init[1:, 3:], deterministic=True
    )
    torch.testing.assert_close(tail.belief, whole.belief[1:, 3:])
    changed = action.clone()
    changed[1, 3] = 0.7
    again = rssm.observe(embedding, changed, is_init, deterministic=True)
    torch.testing.assert_close(again.belief, whole.belief)


@pytest.mark.parametrize("kind", KINDS)
def test_continuing_from_a_state_equals_one_window(kind):
    rssm = make_rssm(**kind)
    embedding, action, is_init = make_sequence()
    whole = rssm.observe(embedding, action, is_init, deterministic=True)
    carried = (whole.belief[:, 1], whole.state[:, 1])
    rest = rssm.observe(embedding[:, 2:], action[:, 2:], is_init[:, 2:], carried, deterministic=True)
    torch.testing.assert_close(rest.belief, whole.belief[:, 2:])


@pytest.mark.parametrize("kind", KINDS)
def test_actions_beyond_the_bounds_count_as_the_bounds(kind):
    rssm = make_rssm(**kind)
    belief, state = torch.randn(5, 16), torch.zeros(5, 12)
    outside, inside = torch.full((5, 4), 3.0), torch.ones(5, 4)
    assert torch.equal(
        rssm.imagine_step(belief, state, outside, True)[0], rssm.imagine_step(belief, state, inside, True)[0]
    )


@pytest.mark.parametrize("kind", KINDS)
def test_imagining_is_the_same_recurrence_as_observing(kind):
    rssm = make_rssm(**kind)
    embedding, action, _ = make_sequence()
    posterior = rssm.observe(embedding, action, torch.zeros(2, 6, dtype=torch.bool), deterministic=True)
    belief, state = rssm.imagine_step(posterior.belief[:, 2], posterior.state[:, 2], action[:, 3], deterministic=True)
    torch.testing.assert_close(belief, posterior.belief[:, 3])
    mode = posterior.prior_logits[:, 3].argmax(-1)
    assert torch.equal(state.view(2, 3, 4).argmax(-1), mode)


def test_block_cell_equals_blocks_that_read_the_shared_inputs():
    """The reference concatenates the shared inputs to each block; here the two products are summed."""
    torch.manual_seed(0)
    cell = BlockGRUCell(belief=8, state=6, action=4, hidden=5, norm="rms", blocks=2)
    belief, inputs = torch.randn(3, 8), torch.randn(3, 15)
    ours = cell.hidden_shared(inputs) + cell.hidden_blocks(belief)
    for block in range(2):
        part = slice(4 * block, 4 * block + 4)
        weight = torch.cat((cell.hidden_blocks.weight[block], cell.hidden_shared.weight[part].T))
        expected = torch.cat((belief[:, part], inputs), -1) @ weight + cell.hidden_shared.bias[part]
        torch.testing.assert_close(ours[:, part], expected)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_reaches_the_first_record_but_not_across_a_reset(kind):
    rssm = make_rssm(**kind)
    embedding, action, is_init = make_sequence()
    embedding.requires_grad_()
    rssm.observe(embedding, action, is_init).belief[:, -1].sum().backward()
    assert embedding.grad[0, 0].abs().sum() > 0
    assert embedding.grad[1, :3].abs().sum() == 0
    assert embedding.grad[1, 3].abs().sum() > 0


@pytest.mark.parametrize("recurrence", ["dense", "ssm"])
def test_unknown_recurrences_are_refused(recurrence):
    with pytest.raises(ValueError, match=r"recurrence=lstm: must be one of "):
        RSSMS[recurrence](8, 4, 16, latents=3, classes=4, hidden=8, recurrence="lstm")


CPU = torch.device("cpu")


def make_parallel() -> ParallelRSSM:
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
    rssm = make_parallel()
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
    rssm = make_parallel()
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
    rssm = make_parallel()
    embedding, action, is_init = make_window(time=2)
    is_init[:, 0] = True
    expected = rssm.observe(embedding, action, is_init, deterministic=True).belief
    garbage = torch.full((3, 16), torch.nan), torch.full((3, 12), torch.nan)
    assert torch.equal(rssm.observe(embedding, action, is_init, garbage, deterministic=True).belief, expected)


def test_the_posterior_sees_the_observation_alone():
    rssm = make_parallel()
    embedding, action, is_init = make_window()
    first = rssm.observe(embedding, action, is_init, deterministic=True)
    other = rssm.observe(embedding, -action, is_init, (torch.ones(3, 16), torch.zeros(3, 12)), deterministic=True)
    assert torch.equal(first.posterior_logits, other.posterior_logits)
    assert not torch.equal(first.prior_logits, other.prior_logits)


def test_a_belief_stays_within_the_bounds_of_its_stored_form():
    rssm = make_parallel()
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
    rssm = make_parallel()
    second = rssm.observe(*make_window()).belief.chunk(LAYERS, -1)[1]
    second.square().sum().backward()
    assert rssm.cell.gates[0].weight.grad.abs().sum() > 0


def test_a_window_costs_a_few_calls_more_where_it_is_longer():
    rssm = make_parallel()
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
    with pytest.raises(ValueError, match=r"model size mine: recurrence=mamba: must be one of block, dense, ssm"):
        WorldModel(replace(get_size("debug"), name="mine", recurrence="mamba"), Interface())


class Counter(TorchDispatchMode):
    """Counts the calls of torch's operations."""

    calls = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.calls += 1
        return function(*args, **kwargs or {})


def loop(decay: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    found = [drive[:, 0]]
    for step in range(1, drive.shape[1]):
        found.append(decay[:, step] * found[-1] + drive[:, step])
    return torch.stack(found, 1)


def make_inputs(time: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    decay = torch.rand(2, time, 3, generator=generator)
    decay[1, time // 2] = 0.0
    return decay.requires_grad_(), torch.randn(2, time, 3, generator=generator).requires_grad_()


def test_a_constant_decay_makes_a_geometric_sum():
    found = linear_recurrence(torch.full((1, 40, 1), 0.75), torch.ones(1, 40, 1)).flatten()
    torch.testing.assert_close(found, (1 - 0.75 ** torch.arange(1, 41)) / 0.25)


@pytest.mark.parametrize("time", [1, 2, 3, 7, 8, 33])
def test_values_and_gradients_are_those_of_the_loop(time):
    inputs = make_inputs(time)
    weight = torch.randn(2, time, 3, generator=torch.Generator().manual_seed(1))
    found, expected = linear_recurrence(*inputs), loop(*inputs)
    torch.testing.assert_close(found, expected)
    ours = torch.autograd.grad((found * weight).sum(), inputs)
    theirs = torch.autograd.grad((expected * weight).sum(), inputs, allow_unused=True, materialize_grads=True)
    torch.testing.assert_close(ours, theirs)


def test_arguments_stay_as_they_were():
    decay, drive = (value.detach() for value in make_inputs(9))
    kept = decay.clone(), drive.clone()
    linear_recurrence(decay, drive)
    assert torch.equal(decay, kept[0]) and torch.equal(drive, kept[1])


@pytest.mark.parametrize("decay", [0.0, 1e-30, 1.0])
def test_extreme_decays_stay_finite_and_exact(decay):
    drive = torch.randn(2, 256, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found = linear_recurrence(torch.full((2, 256, 3), decay), drive)
    torch.testing.assert_close(found, drive.cumsum(1) if decay == 1.0 else drive, rtol=1e-5, atol=1e-5)
    found.sum().backward()
    assert drive.grad.isfinite().all()


def test_calls_grow_with_the_logarithm_of_the_length():
    calls = {}
    for time in (16, 32, 256):
        inputs = make_inputs(time)
        with Counter() as counter:
            linear_recurrence(*inputs).sum().backward()
        calls[time] = counter.calls
    a_round = calls[32] - calls[16]
    assert a_round > 0 and calls[256] == calls[16] + 4 * a_round
