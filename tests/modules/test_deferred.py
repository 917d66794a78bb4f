"""Weight gradients that come after a time loop are those that come at every step."""

from __future__ import annotations

import pytest
import torch

from dreamer_racing.modules.layers import BlockLinear, linear, unrolled


def roll(layers: torch.nn.Module, inputs: torch.Tensor, deferred: bool) -> torch.Tensor:
    hidden = inputs
    if not deferred:
        for _ in range(4):
            hidden = torch.tanh(layers(hidden))
        return hidden
    with unrolled(layers):
        for _ in range(4):
            hidden = torch.tanh(layers(hidden))
        layers(hidden)  # a step whose output nothing needs
    return hidden


def make_layers() -> torch.nn.Module:
    torch.manual_seed(0)
    return torch.nn.Sequential(linear(6, 6), BlockLinear(6, 6, blocks=2), linear(6, 6, bias=False)).double()


def gradients(deferred: bool) -> list[torch.Tensor]:
    layers = make_layers()
    inputs = torch.linspace(-1, 1, 18, dtype=torch.float64).view(3, 6).requires_grad_()
    roll(layers, inputs, deferred).square().sum().backward()
    return [inputs.grad, *(parameter.grad for parameter in layers.parameters())]


def test_gradients_are_the_same() -> None:
    for found, expected in zip(gradients(True), gradients(False), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_a_backward_pass_that_does_not_want_the_weights_leaves_nothing_behind() -> None:
    layers = make_layers()
    inputs = torch.ones(3, 6, dtype=torch.float64, requires_grad=True)
    loss = roll(layers, inputs, deferred=True).square().sum()
    torch.autograd.grad(loss, inputs, retain_graph=True)
    loss.backward()
    plain = make_layers()
    roll(plain, torch.ones(3, 6, dtype=torch.float64), deferred=False).square().sum().backward()
    for found, expected in zip(layers.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(found.grad, expected.grad)


@pytest.mark.parametrize("enabled", [False, True])
def test_under_autocast_products_are_bfloat16_and_gradients_float32(enabled: bool) -> None:
    layer = linear(6, 6)
    with torch.autocast("cpu", torch.bfloat16, enabled=enabled), unrolled(layer):
        outputs = layer(torch.ones(3, 6))
    assert outputs.dtype == (torch.bfloat16 if enabled else torch.float32)
    outputs.float().sum().backward()
    assert layer.weight.grad.dtype == layer.bias.grad.dtype == torch.float32
    torch.testing.assert_close(layer.weight.grad, torch.full((6, 6), 3.0))


def test_without_gradients_and_after_the_loop_nothing_is_deferred() -> None:
    layer = linear(6, 6)
    with torch.no_grad(), unrolled(layer):
        assert layer.deferred is None
    with unrolled(layer):
        assert layer.deferred is not None
    assert layer.deferred is None
