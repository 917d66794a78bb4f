"""`benchmarks/learning_signal.py`: what it makes of rollouts and gradients that can be worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from tests.running_recipes import module_of

learning_signal = module_of("benchmarks", "learning_signal")


def column(*numbers: float) -> torch.Tensor:
    """Numbers of one start or world by step, ``(H, 1, 1)``."""
    return torch.tensor(numbers).view(-1, 1, 1)


def test_returns_and_what_is_reached_end_with_a_crash() -> None:
    rollout = learning_signal.Rollout(column(1.0, 2.0, 4.0), column(1.0, 0.0, 1.0), column(9.0, 10.0, 20.0, 30.0))
    learner = SimpleNamespace(discount=0.5, loss_config=SimpleNamespace(lambda_=1.0))
    assert rollout.returns(learner).flatten().tolist() == [1.0 + 0.5 * 2.0, 2.0, 4.0 + 0.5 * 30.0]
    assert rollout.reached().flatten().tolist() == [1.0, 1.0, 0.0, 0.0]
    learner.loss_config.lambda_ = 0.0
    assert rollout.returns(learner).flatten().tolist() == [1.0 + 0.5 * 10.0, 2.0, 4.0 + 0.5 * 30.0]


def test_what_was_paid_is_summed_to_the_end_of_an_episode() -> None:
    done = torch.tensor([False, True, False]).view(3, 1, 1)
    flight = TensorDict({"reward": column(1.0, 2.0, 4.0), "done": done}, [3, 1])
    assert learning_signal.monte_carlo(flight, 0.5).flatten().tolist() == [2.0, 2.0, 4.0]


@pytest.mark.parametrize(("share", "signal"), [(0.0, 0.0), (1.0, 1.0), (3.0, 9.0)])
def test_signal_and_noise_are_told_apart(share: float, signal: float) -> None:
    """Signal of a known power, noise of power 1, by many gradients."""
    noise = torch.randn(400, 1000) / 1000**0.5
    found = learning_signal.noise_of(noise + share * torch.nn.functional.normalize(torch.ones(1000), dim=0))
    assert found["signal"] == pytest.approx(signal, abs=0.02 + 0.02 * signal)
    assert found["cosine"] == pytest.approx(signal / (1 + signal), abs=0.02)
