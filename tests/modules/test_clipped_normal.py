"""The mean of clipped samples: by quadrature, by symmetry, and in the limits."""

from __future__ import annotations

import pytest
import torch

from dreamer_racing.modules.clipped_normal import clipped_mean


@pytest.mark.parametrize("mean", [-3.0, -0.4, 0.0, 0.9, 1.0, 2.5])
@pytest.mark.parametrize("std", [0.05, 0.4, 2.0])
def test_it_is_the_integral(mean: float, std: float) -> None:
    deviations = torch.linspace(-10.0, 10.0, 200_001, dtype=torch.float64)
    density = torch.exp(-0.5 * deviations.square()) / (2.0 * torch.pi) ** 0.5
    integral = torch.trapezoid((mean + std * deviations).clamp(-1.0, 1.0) * density, deviations)
    found = clipped_mean(torch.tensor(mean, dtype=torch.float64), torch.tensor(std, dtype=torch.float64))
    assert found.item() == pytest.approx(integral.item(), abs=1e-6)


def test_without_noise_it_is_the_clipped_mean_and_never_beyond() -> None:
    mean = torch.linspace(-4.0, 4.0, 81)
    torch.testing.assert_close(clipped_mean(mean, torch.tensor(1e-6)), mean.clamp(-1.0, 1.0))
    for std in (1e-3, 0.3, 5.0):
        found = clipped_mean(mean, torch.tensor(std))
        assert found.abs().max() <= 1.0 + 1e-6
        torch.testing.assert_close(found, -found.flip(0), atol=1e-6, rtol=0.0)


def test_shapes_go_together() -> None:
    assert clipped_mean(torch.zeros(5, 3, 4), torch.ones(4)).shape == (5, 3, 4)
