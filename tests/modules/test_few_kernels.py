"""What is computed in fewer kernels, or later."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.losses import Imagination, imagine
from dreamer_racing.modules import ModelSize, get_size, layers
from dreamer_racing.modules.layers import BlockLinear, LayerNorm, RMSNorm, autocast, cast_once, linear, unrolled
from dreamer_racing.modules.recurrent_cells import GatedUpdate, gate_shift, next_belief
from tests.dreamers import imagine_from, latent_ppo_of, learner_of
from tests.launches import launches
from tests.learners.test_dreamer_v3 import make_batch

SMALL = {"belief": 32, "hidden": 16, "latents": 4, "classes": 4, "units": 16}
SIZES = {  # mostly of states that are not drawn: noise drawn ahead is other noise
    "dense": replace(get_size("paper_small"), **SMALL, cnn_depth=2, sampled=False),
    "block": replace(get_size("size1m"), **SMALL, cnn_depth=8, sampled=False),
    "sampled": replace(get_size("debug"), state_std=False),
}


def gradients(learner: DreamerV3, loss: str = "loss") -> dict[str, Tensor]:
    """Gradients of all losses, by the parameter's name, and the loss."""
    torch.manual_seed(0)
    metrics = learner._backward(make_batch())
    found = {name: p.grad for name, p in learner.agent.named_parameters() if p.grad is not None}
    return {"loss": metrics[loss], **found}


@pytest.fixture
def same_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same noise of actions in every imagined step, whether it is drawn ahead or not."""

    def noise(shape: torch.Size) -> Tensor:
        return torch.arange(float(shape.numel())).sin().view(shape)

    monkeypatch.setattr(torch, "randn_like", lambda like: noise(like.shape))
    monkeypatch.setattr(torch, "randn", lambda *shape, **_: noise(torch.Size(shape[1:])).expand(shape))


def make_pair(size: ModelSize, **settings: object) -> list[DreamerV3]:
    learners = [learner_of(size, few_kernels=few, horizon=3, seed=0, **settings) for few in (False, True)]
    for learner in learners:  # its first output is zero, and so would be the gradients of what reads it
        nn.init.normal_(learner.agent.critic.head.mlp.output.weight, generator=torch.Generator().manual_seed(0))
    return learners


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize("size", [name for name in SIZES if name != "sampled"])
@pytest.mark.parametrize("actor", ["reinforce", "dynamics"])
def test_gradients_are_the_same_in_float32(size: str, actor: str) -> None:
    few, plain = (gradients(learner) for learner in make_pair(SIZES[size], actor=actor)[::-1])
    assert few.keys() == plain.keys()
    for name, value in plain.items():
        assert (few[name] - value).norm() <= 3e-4 * value.norm() + 3e-7, name


@pytest.mark.usefixtures("same_noise")
@pytest.mark.parametrize(("size", "world_model"), [("block", "reconstruction"), ("dense", "decoder_free")])
def test_gradients_are_the_same_in_bfloat16_but_for_its_rounding(
    monkeypatch: pytest.MonkeyPatch, size: str, world_model: str
) -> None:
    """Network by network within three times plain bfloat16's own error: another rounding of some 16 units each.

    Where the others do not decode images, it is because bfloat16 by itself leaves little of that gradient there: half
    of it is rounding, in a network so small. Gains of layer norms stay in float32, because a CPU, unlike CUDA, would
    keep the statistics in the type of the gains.
    """
    monkeypatch.setattr(layers, "LAYERS", tuple(kind for kind in layers.LAYERS if kind is not LayerNorm))
    exact = gradients(make_pair(SIZES[size], world_model=world_model)[0])
    plain, few = (gradients(of) for of in make_pair(SIZES[size], world_model=world_model, mixed_precision=True))
    assert all(value.dtype == torch.float32 for value in few.values())
    parts = sorted({".".join(name.split(".")[:2]) for name in exact if name != "loss"})
    errors = {part: [relative_error(found, exact, part) for found in (plain, few)] for part in parts}
    fine = {part: pair for part, pair in errors.items() if pair[0] < 0.1}  # of coarser ones nothing can be said
    spared = 0 if torch.__version__ >= "2.13" else 1  # before, a seed means other weights
    assert len(fine) >= len(parts) - spared, errors
    assert all(with_few < 3 * as_usual + 0.005 for as_usual, with_few in fine.values()), fine


def relative_error(found: dict[str, Tensor], exact: dict[str, Tensor], part: str) -> float:
    """Of the gradient of a part of the networks."""
    one, other = (torch.cat([of[name].flatten() for name in exact if name.startswith(part)]) for of in (found, exact))
    return float((one - other).norm() / other.norm())


def test_samples_are_drawn_by_the_same_noise() -> None:
    few, plain = (latent_ppo_of(SIZES["sampled"], seed=0, few_kernels=few) for few in (True, False))
    of_each = []
    for learner in (few, plain):
        torch.manual_seed(0)
        learner._backward(make_batch())
        of_each.append((learner.latents, [p.grad for p in learner.agent.world_model.parameters()]))
    torch.testing.assert_close(of_each[0][0]["state"], of_each[1][0]["state"], rtol=0, atol=1e-6)
    for one, other in zip(of_each[0][1], of_each[1][1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.usefixtures("same_noise")
def test_by_the_same_noise_imagination_goes_to_the_same_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """With states that are drawn; and where the noise was other it goes elsewhere."""
    learner = learner_of(SIZES["sampled"], seed=0)
    actor, rssm = learner.agent.actor, learner.agent.world_model.rssm
    generator = torch.Generator().manual_seed(1)
    for output in (actor.mlp.output, rssm.prior[-1]):  # an untrained actor always does the same
        nn.init.normal_(output.weight, generator=generator)
    start = torch.rand(64, 32, generator=generator), torch.zeros(64, 16)

    def imagined(few: bool, shift: float) -> Imagination:
        draws = torch.rand(64, 4, 1, generator=torch.Generator().manual_seed(2)).add(shift).frac()
        monkeypatch.setattr(rssm, "draw_noise", lambda *batch: draws.expand(*batch, 4, 1))
        rssm.few_kernels = few
        return imagine(rssm, actor, *start, horizon=8)

    with torch.no_grad():
        plain, few, other = imagined(False, 0.0), imagined(True, 0.0), imagined(True, 0.5)
    torch.testing.assert_close(few.features, plain.features)
    torch.testing.assert_close(few.action, plain.action)
    assert (plain.features[1:] - plain.features[:-1]).abs().amax((1, 2)).min() > 0.5, "each step changes a latent"
    assert (other.features - plain.features).abs().max() > 0.5


def test_the_update_by_hand_has_the_gradients_of_autograd() -> None:
    generator = torch.Generator().manual_seed(0)
    gates = torch.randn(3, 2, 3, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    belief = torch.rand(3, 8, generator=generator, dtype=torch.float64, requires_grad=True)
    shift = gate_shift().double()
    single = (gates.float(), shift.float(), belief.float())
    torch.testing.assert_close(next_belief(*single, few_kernels=True), next_belief(*single, few_kernels=False))
    assert torch.autograd.gradcheck(lambda *inputs: GatedUpdate.apply(inputs[0], shift, inputs[1]), (gates, belief))


def test_weights_are_cast_by_one_kernel_and_come_back() -> None:
    module = nn.Sequential(nn.Linear(4, 8), LayerNorm(8), nn.Linear(8, 2))
    before, inputs = list(module.parameters()), torch.randn(3, 4)

    def run(once: bool) -> list[Tensor]:
        module.zero_grad()
        with autocast(torch.device("cpu"), True), cast_once(module, torch.bfloat16) if once else nullcontext():
            assert all((parameter.dtype == torch.bfloat16) == once for parameter in module.parameters())
            module(inputs).float().square().sum().backward()
        return [parameter.grad for parameter in module.parameters()]

    for one, other in zip(run(True), run(False), strict=True):
        assert one.dtype == torch.float32
        bound = 0.02 * float(other.abs().max())  # of 300 seeds the worst is 0.015; an element alone may cancel
        torch.testing.assert_close(one, other, rtol=0.0, atol=bound)
    casts = {once: launches(lambda once=once: run(once)).kernels for once in (True, False)}
    assert casts[True]["_foreach_copy_"] == 2, "there and back"
    assert casts[True]["_to_copy"] < casts[False]["_to_copy"]
    assert all(one is other for one, other in zip(module.parameters(), before, strict=True))


@pytest.mark.parametrize("norm", [LayerNorm, RMSNorm])
def test_norms_keep_the_type_that_comes_in_where_autocast_would_not(norm: type[nn.Module]) -> None:
    """On the meta device, which goes the way of CUDA."""
    layer = norm(8).to("meta")
    assert layer(torch.empty(3, 8, dtype=torch.bfloat16, device="meta")).dtype == torch.bfloat16


@pytest.mark.parametrize("actor", ["reinforce", "dynamics"])
def test_the_actors_loss_moves_nothing_but_the_actor(actor: str) -> None:
    learner = learner_of("debug", seed=0, horizon=3, actor=actor, few_kernels=True, mixed_precision=True)
    with learner.autocast(), cast_once(learner.modules, torch.bfloat16):
        imagine_from(learner, torch.zeros(4, 32), torch.zeros(4, 16))[0]["loss_actor"].backward()
    touched = {name for name, part in learner.agent.named_children() for p in part.parameters() if p.grad is not None}
    assert touched == {"actor"}


def test_it_is_not_the_default_of_a_cpu() -> None:
    learner = learner_of("debug")
    assert not learner.agent.world_model.rssm.few_kernels and not learner._casts_once


# Weight gradients that come after a time loop are those that come at every step.


def roll(layers: nn.Module, inputs: Tensor, deferred: bool) -> Tensor:
    hidden = inputs
    with unrolled(layers) if deferred else nullcontext():
        for _ in range(4):
            hidden = torch.tanh(layers(hidden))
        layers(hidden)  # a step whose output nothing needs
    return hidden.square().sum()


@pytest.mark.parametrize("inputs_alone_before", [False, True])
def test_deferred_gradients_are_the_same_also_after_a_pass_that_does_not_want_the_weights(
    inputs_alone_before: bool,
) -> None:
    found = []
    for deferred in (True, False):
        torch.manual_seed(0)
        layers = nn.Sequential(linear(6, 6), BlockLinear(6, 6, blocks=2), linear(6, 6, bias=False)).double()
        inputs = torch.linspace(-1, 1, 18, dtype=torch.float64).view(3, 6).requires_grad_()
        loss = roll(layers, inputs, deferred)
        if inputs_alone_before:
            torch.autograd.grad(loss, inputs, retain_graph=True)
        loss.backward()
        found.append([inputs.grad, *(parameter.grad for parameter in layers.parameters())])
    torch.testing.assert_close(*found, rtol=1e-12, atol=1e-12)


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
