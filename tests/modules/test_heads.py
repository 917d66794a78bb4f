import math

import pytest
import torch
from torchrl.modules import SymExpTwoHot
from torchrl.objectives.dreamer_v3 import two_hot_cross_entropy

from dreamer_racing.modules.heads import MLP, ContinueHead, TwoHot, TwoHotHead, symexp, symlog


def test_symlog_and_symexp_are_known_and_inverse():
    values = torch.tensor([0.0, 1.0, -1.0, math.e - 1, -100.0])
    torch.testing.assert_close(symlog(values)[3], torch.tensor(1.0))
    torch.testing.assert_close(symlog(values)[1:3], torch.tensor([math.log(2), -math.log(2)]))
    torch.testing.assert_close(symexp(symlog(values)), values)


def test_two_hot_puts_a_number_between_its_neighbours():
    # Five bins: symexp of -20, -10, 0, 10, 20.
    two_hot = TwoHot(5)
    ten = math.expm1(10.0)
    index, weight = two_hot.encode(torch.tensor([[0.25 * ten], [-0.25 * ten], [0.0], [ten]]))
    dense = torch.zeros(4, 5).scatter_add_(-1, index, weight)
    expected = torch.tensor([[0, 0, 0.75, 0.25, 0], [0, 0.25, 0.75, 0, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0]])
    torch.testing.assert_close(dense, expected.float())


def test_two_hot_agrees_with_torchrl():
    torch.manual_seed(0)
    two_hot, oracle = TwoHot(255), SymExpTwoHot(255)
    target = symexp(torch.linspace(-21, 21, 101)).unsqueeze(-1)
    logits = torch.randn(101, 255)
    index, weight = two_hot.encode(target)
    dense = torch.zeros(101, 255).scatter_add_(-1, index, weight)
    torch.testing.assert_close(dense, oracle.encode(target.squeeze(-1)), atol=1e-4, rtol=1e-4)
    expected = two_hot_cross_entropy(logits, target, two_hot.values).unsqueeze(-1)
    torch.testing.assert_close(two_hot.cross_entropy(logits.log_softmax(-1), target), expected)
    torch.testing.assert_close(two_hot.decode(logits).squeeze(-1), oracle.decode(logits), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("value", [0.0, 0.01, -3.7, 25.0, -1234.5])
def test_two_hot_decodes_what_it_encodes(value):
    two_hot = TwoHot(255)
    index, weight = two_hot.encode(torch.tensor([[value]]))
    logits = torch.full((1, 255), -1e9).scatter(-1, index, weight.clamp_min(1e-30).log())
    torch.testing.assert_close(two_hot.decode(logits), torch.tensor([[value]]), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bins", [1, 4])
def test_two_hot_refuses_an_even_or_tiny_number_of_bins(bins):
    with pytest.raises(ValueError, match="odd number"):
        TwoHot(bins)


def test_new_two_hot_head_predicts_exactly_zero():
    head = TwoHotHead(8, layers=2, units=16)
    assert torch.equal(head.mean(torch.randn(7, 8)), torch.zeros(7, 1))


@pytest.mark.parametrize("norm", ["rms", "layer"])
def test_mlp_and_continue_head_shapes(norm):
    features = torch.randn(2, 3, 8)
    assert MLP(8, 5, layers=2, units=16, norm=norm)(features).shape == (2, 3, 5)
    probability = ContinueHead(8, layers=1, units=16, norm=norm).probability(features)
    assert probability.shape == (2, 3, 1)
    assert ((probability > 0) & (probability < 1)).all()


def test_values_keep_their_precision_under_autocast():
    two_hot, values = TwoHot(255), torch.tensor([[53.2], [0.333], [-17.77]])
    index, weight = two_hot.encode(values)
    logits = torch.zeros(3, 255).scatter_(-1, index, weight).clamp_min(1e-30).log()
    with torch.autocast("cpu", torch.bfloat16):
        decoded = two_hot.decode(logits)
    assert decoded.dtype == torch.float32
    torch.testing.assert_close(decoded, values, rtol=1e-5, atol=1e-5)
