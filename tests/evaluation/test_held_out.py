"""Diagnostics: an exact case by hand with constant heads, and no trace left in networks or random numbers."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.evaluation.held_out import SEEN, correlation, held_out_metrics, world_model_metrics
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of

HORIZON, DISCOUNT = 2, 0.9
REWARD, VALUE, CONTINUATION = 0.25, 10.0, 0.5  # what the constant heads predict


def make_learner(**config) -> DreamerV3:
    config = dict(horizon=HORIZON, discount=DISCOUNT, **config)
    return learner_of("debug", Interface(pixels=False, vector_dim=3), seed=0, **config)


def make_batch(windows: int, length: int = SEEN + HORIZON) -> TensorDict:
    """Windows of one episode without an end, and a reward of 0."""
    generator, none = torch.Generator().manual_seed(0), torch.zeros(windows, length, 1)
    fields = {
        "vector": torch.randn(windows, length, 3, generator=generator),
        "previous_action": torch.rand(windows, length, 4, generator=generator) * 2 - 1,
        "reward": none,
        **{flag: none.bool() for flag in ("is_init", "terminated", "truncated")},
    }
    return TensorDict(fields, [windows, length])


def constant(value: float):
    return lambda features: torch.full((*features.shape[:-1], 1), value)


@pytest.fixture
def predictable(monkeypatch: pytest.MonkeyPatch) -> DreamerV3:
    """A learner whose reward, continuation and value are the same everywhere."""
    learner = make_learner()
    model = learner.agent.world_model
    monkeypatch.setattr(model.reward_head, "mean", constant(REWARD))
    monkeypatch.setattr(model.continue_head, "probability", constant(CONTINUATION))
    monkeypatch.setattr(learner.agent.critic, "value", constant(VALUE))
    return learner


IMAGINED = REWARD + DISCOUNT * CONTINUATION * REWARD + DISCOUNT**2 * CONTINUATION**2 * VALUE
FIRST, SECOND = SEEN, SEEN + 1  # records of the horizon


GOES_ON = 1 + DISCOUNT * 2 + DISCOUNT**2 * VALUE
ENDS = {
    "goes on": ({}, GOES_ON, 3 - 2 * REWARD),
    "terminated start": ({"terminated": SEEN - 1}, None, None),
    "truncated start": ({"truncated": SEEN - 1, "is_init": FIRST}, None, None),
    "truncated inside": ({"truncated": FIRST, "is_init": SECOND}, None, 1 - REWARD),
    "next episode": ({"is_init": FIRST}, 0.0, 0.0),
    "ends after one": ({"terminated": FIRST, "is_init": SECOND}, 1.0, 1 - REWARD),
    "terminates last": ({"terminated": SECOND}, 1 + DISCOUNT * 2, 3 - 2 * REWARD),
    "begins at the start": ({"is_init": SEEN - 1}, GOES_ON, 3 - 2 * REWARD),
}


@pytest.mark.parametrize(("ends", "real", "reward_error"), ENDS.values(), ids=ENDS)
def test_real_returns_by_hand(predictable, ends: dict, real: float | None, reward_error: float | None) -> None:
    batch = make_batch(windows=1)
    batch["reward"][:, FIRST], batch["reward"][:, SECOND] = 1.0, 2.0
    batch["reward"][:, SEEN - 1] = 100.0  # was paid before the horizon
    for key, record in ends.items():
        batch[key][:, record] = True
    metrics = held_out_metrics(predictable, batch)
    if real is None:
        assert "imagination/return_bias" not in metrics, "nothing to hold the imagined return against"
    else:
        assert metrics["imagination/return_bias"].item() == pytest.approx(IMAGINED - real, rel=1e-5)
    if reward_error is None:
        assert "held_out/open_loop_reward_error" not in metrics, "nothing is paid after an episode's end"
    else:
        assert metrics["held_out/open_loop_reward_error"].item() == pytest.approx(reward_error, abs=1e-5)


def test_correlations_are_over_the_windows(predictable: DreamerV3, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = make_batch(windows=5)
    paid = torch.arange(5.0)
    batch["reward"][:, FIRST, 0] = paid
    assert held_out_metrics(predictable, batch)["held_out/open_loop_correlation"] == 0.0, "a constant prediction"
    predict = {"right": paid, "reversed": -paid}
    for name, sign in (("right", 1.0), ("reversed", -1.0)):

        def mean(features: torch.Tensor, name: str = name) -> torch.Tensor:
            windows_first = features.shape[0] == 5  # (W, H, F) open loop, (H, W, F) imagined
            shape = (5, 1, 1) if windows_first else (1, 5, 1)
            return predict[name].view(shape).expand(*features.shape[:-1], 1)

        monkeypatch.setattr(predictable.agent.world_model.reward_head, "mean", mean)
        metrics = held_out_metrics(predictable, batch)
        assert metrics["held_out/open_loop_correlation"].item() == pytest.approx(sign)
        assert metrics["imagination/return_correlation"].item() == pytest.approx(sign)


@pytest.mark.parametrize("measure", [held_out_metrics, world_model_metrics])
@pytest.mark.parametrize("mixed_precision", [False, True])
def test_measuring_leaves_no_trace(measure: Callable, mixed_precision: bool) -> None:
    learner = make_learner(mixed_precision=mixed_precision)
    before = copy.deepcopy(learner.state_dict())
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    metrics = measure(learner, make_batch(windows=3, length=SEEN + HORIZON + 4))
    assert torch.equal(torch.rand(4), expected)
    prefix = "held_out/" if measure is held_out_metrics else ""
    assert {prefix + name for name in ("reward_error", "loss_vector", "kl", "loss_reward")} <= metrics.keys()
    for key, value in metrics.items():
        assert value.shape == () and value.isfinite() and not value.requires_grad, key
        assert value.dtype == torch.float32, key
    for name, value in learner.agent.state_dict().items():
        assert torch.equal(value, before["agent"][name]), name
    assert all(parameter.grad is None for parameter in learner.agent.parameters())


def test_only_context_and_horizon_count() -> None:
    learner, batch = make_learner(), make_batch(windows=2, length=SEEN + HORIZON + 3)
    results = []
    for window in (batch, batch[:, : SEEN + HORIZON]):
        torch.manual_seed(0)
        results.append(held_out_metrics(learner, window))
    for key, value in results[0].items():
        torch.testing.assert_close(value, results[1][key], msg=key)


def test_short_windows_are_refused() -> None:
    with pytest.raises(ValueError, match=f"Windows of {SEEN + 1} records: {SEEN} \\+ horizon {HORIZON}"):
        held_out_metrics(make_learner(), make_batch(windows=1, length=SEEN + 1))


def test_correlation() -> None:
    first = torch.tensor([1.0, 2.0, 3.0])
    assert correlation(first, 5 - 2 * first).item() == pytest.approx(-1.0)
    # Deviations (−1, 0, 1) and (−1, 1, 0): product 1, norms √2.
    assert correlation(first, torch.tensor([0.0, 2.0, 1.0])).item() == pytest.approx(0.5)
    assert correlation(first, torch.full((3,), 7.0)).item() == 0.0


def test_the_world_model_is_measured_as_an_update_measures_it() -> None:
    learner, batch = make_learner(), make_batch(windows=3)
    torch.manual_seed(3)
    measured = world_model_metrics(learner, batch)
    torch.manual_seed(3)
    learned = learner.update(batch)
    assert {"reward_error", "loss_vector", "kl"} <= measured.keys()
    for name, value in measured.items():
        assert value.item() == pytest.approx(learned[name].item(), rel=1e-6), name
