"""What a linear map and a probe do not tell of latents: nothing, all, or only what is tangled."""

from __future__ import annotations

import pytest
import torch

from dreamer_racing.modules.heads import symexp
from tests.running_recipes import module_of

state_estimation = module_of("benchmarks", "state_estimation")


def shown(number: int, tangled: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Latents, probabilities among them, and a state that is linear in them or in products of them."""
    latents = torch.randn(number, 4)
    state = latents[:, :2] * latents[:, 2:] if tangled else latents[:, :2] + 2.0 * latents[:, 2:]
    return torch.cat((latents, torch.softmax(torch.randn(number, 3), -1)), 1), symexp(state)


@pytest.mark.parametrize(("tangled", "least", "most"), [(False, 0.0, 1e-6), (True, 0.95, 1.1)])
def test_a_linear_map_tells_what_is_linear(tangled: bool, least: float, most: float) -> None:
    torch.manual_seed(0)
    assert least <= state_estimation.linear_share(shown(4000, tangled), shown(1000, tangled)) <= most


def test_a_probe_that_learns_on_tells_what_is_tangled() -> None:
    torch.manual_seed(0)
    learned, measured = shown(4000, tangled=True), shown(1000, tangled=True)
    probe = state_estimation.Probe(7, 2)
    late = state_estimation.settle(probe, learned, measured, 20)["share"]
    assert state_estimation.settle(probe, learned, measured, 400)["share"] < 0.5 * late
