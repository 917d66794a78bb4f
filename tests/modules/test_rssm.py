"""The recurrent state-space model."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dreamer_racing.modules import RSSM, SIZES, join_features
from dreamer_racing.modules.recurrent_cells import BlockGRUCell
from dreamer_racing.modules.rssm import mix_uniform, sample_one_hot
from tests.dreamers import rssm_of

KINDS = [
    {"recurrence": "dense", "norm": "layer", "learned_initial": False},
    {"recurrence": "dense", "norm": "layer", "learned_initial": True},
    {"recurrence": "block", "norm": "rms", "learned_initial": False},
    {"recurrence": "block", "norm": "rms", "learned_initial": True},
]


def make_rssm(**kind) -> RSSM:
    torch.manual_seed(0)
    rssm = rssm_of(blocks=4, **kind)
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
    """Acting and training give the same latents and gradients for a history, also across a reset inside the window."""
    rssm = make_rssm(**kind)
    embedding, action, is_init = make_sequence()
    noise, weight = torch.rand(6, 2, 3, 1), torch.randn(6, 2, 28)
    parameters = {name: parameter for name, parameter in rssm.named_parameters() if parameter.requires_grad}
    monkeypatch.setattr(rssm, "draw_noise", lambda *batch: noise)
    posterior = rssm.observe(embedding, action, is_init, deterministic=deterministic)
    features = join_features(posterior.belief, posterior.state).transpose(0, 1)
    unrolled = torch.autograd.grad((features * weight).sum(), list(parameters.values()), allow_unused=True)

    belief, state = (value.expand(2, -1) for value in rssm.initial())
    total = torch.zeros(())
    for step in range(6):
        monkeypatch.setattr(rssm, "draw_noise", lambda *batch, step=step: noise[step])
        belief, state = rssm.observe_step(
            embedding[:, step], action[:, step], is_init[:, step], belief, state, deterministic
        )
        torch.testing.assert_close(belief, posterior.belief[:, step])
        torch.testing.assert_close(state, posterior.state[:, step])
        total = total + (join_features(belief, state) * weight[step]).sum()
    stepped = torch.autograd.grad(total, list(parameters.values()), allow_unused=True)
    for name, one, other in zip(parameters, unrolled, stepped, strict=True):
        assert (one is None) == (other is None), name
        if one is not None:
            assert (one - other).norm() <= 1e-5 * other.norm() + 1e-7, name
    assert sum(gradient is not None and bool(gradient.any()) for gradient in unrolled) > 8


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
    cell = BlockGRUCell(replace(SIZES["size1m"], belief=8, latents=2, classes=3, hidden=5, blocks=2), action=4)
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


def test_unknown_recurrences_are_refused():
    with pytest.raises(ValueError, match=r"recurrence=lstm: must be one of block, dense"):
        rssm_of(recurrence="lstm")
