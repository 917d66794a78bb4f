"""PPO's update, and the guard against what is not finite."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from dreamer_racing.learners import ppo_update
from dreamer_racing.learners.finite_guard import FiniteGuard, NonFiniteLossError
from dreamer_racing.learners.ppo_update import PPOUpdate
from dreamer_racing.losses import PPOUpdateConfig

RECORDS = 24


def make_update(masked: bool, monkeypatch: pytest.MonkeyPatch, **numbers: Any) -> tuple[PPOUpdate, Any]:
    """An update of a linear network, and a loss whose divergence grows with the distance from where it began."""
    monkeypatch.setattr(ppo_update, "masks_steps", lambda device: masked)
    torch.manual_seed(0)
    network, inputs, targets = nn.Linear(3, 1), torch.randn(RECORDS, 3), torch.randn(RECORDS, 1)
    begun = network.weight.detach().clone()
    kl_target = numbers.pop("kl_target", None)
    config = PPOUpdateConfig(**{"epochs": 4, "minibatch": 16, "kl_stop": 1e9, **numbers})
    update = PPOUpdate(network, 1e-2, config, kl_target)

    def loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        error = (network(inputs[chosen]) - targets[chosen]).square().mean()
        return error, {"ppo/kl": (network.weight.detach() - begun).square().sum()}

    return update, loss


@pytest.mark.parametrize(
    ("numbers", "epochs"),
    [({}, 4.0), ({"kl_stop": 1e-5}, 1.0), ({"kl_stop": 0.002, "kl_target": 0.001}, None)],
    ids=["all", "stopped at the second step", "controlled"],
)
def test_masked_updates_are_those_that_break_off(monkeypatch, numbers, epochs):
    of_each = []
    for masked in (False, True):
        update, loss = make_update(masked, monkeypatch, **numbers)
        metrics = []
        for seed in range(3):
            torch.manual_seed(seed)
            metrics.append(update.run(RECORDS, loss))
        of_each.append((metrics, update.network.state_dict(), update.learning_rate_scale))
    torch.testing.assert_close(of_each[1], of_each[0], rtol=1e-4, atol=1e-5)
    stopped = of_each[0][0][0]["ppo/epochs"].item()
    assert stopped == epochs if epochs else stopped < 4.0, "or the test sees no masks"


@pytest.mark.parametrize("masked", [False, True])
def test_a_gradient_that_is_no_number_leaves_weights_and_moments_as_they_were(monkeypatch, masked):
    update, loss = make_update(masked, monkeypatch)
    update.run(RECORDS, loss)  # there are moments
    before = copy.deepcopy((update.network.state_dict(), update.optimizer.state_dict()))
    metrics = update.run(RECORDS, lambda chosen: (loss(chosen)[0] * float("nan"), {}))
    assert not metrics["gradient_norm"].isfinite()
    after = (update.network.state_dict(), update.optimizer.state_dict())
    torch.testing.assert_close(after, before, rtol=0, atol=0)


def test_a_checkpoint_goes_on_with_masks_or_without(monkeypatch):
    plain, loss = make_update(False, monkeypatch, kl_target=1e-9)
    plain.run(RECORDS, loss)
    masked, masked_loss = make_update(True, monkeypatch, kl_target=1e-9)
    masked.load_state_dict(copy.deepcopy(plain.state_dict()))
    masked.network.load_state_dict(copy.deepcopy(plain.network.state_dict()))
    assert masked.learning_rate_scale == plain.learning_rate_scale < 1.0
    for update, of_it in ((plain, loss), (masked, masked_loss)):
        torch.manual_seed(1)
        update.run(RECORDS, of_it)
    torch.testing.assert_close(masked.network.state_dict(), plain.network.state_dict(), rtol=1e-4, atol=1e-6)
    plain.load_state_dict(copy.deepcopy(masked.state_dict()))
    assert [group["fused"] for group in plain.optimizer.param_groups] == [None]


@pytest.mark.parametrize(("number", "sizes"), [(32, [16, 16]), (36, [12, 12, 12]), (17, [9, 8]), (5, [5])])
def test_no_minibatch_is_a_small_rest_and_each_record_is_seen_once_an_epoch(monkeypatch, number, sizes):
    update, _ = make_update(False, monkeypatch, epochs=1)
    seen: list[Tensor] = []
    update.run(number, lambda chosen: (seen.append(chosen) or update.network.weight.sum(), {}))
    assert [len(chosen) for chosen in seen] == sizes
    assert torch.cat(seen).sort().values.tolist() == list(range(number))


@pytest.mark.parametrize(("kl", "scale"), [(0.016, 0.8), (0.012, 1.0), (0.005, 1.0), (float("nan"), 0.8)], ids=str)
def test_the_learning_rate_follows_the_divergence(monkeypatch, kl, scale):
    """By hand: 1.25 times lower beyond 1.5 times the target of 0.01, and never above the full one."""
    update, _ = make_update(False, monkeypatch, kl_target=0.01, epochs=1, minibatch=RECORDS)

    def loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return update.network.weight.sum(), {"ppo/kl": torch.tensor(kl)}

    assert update.run(RECORDS, loss)["ppo/learning_rate_scale"] == 1.0, "that it was made at"
    assert update.learning_rate_scale.item() == pytest.approx(scale)
    update.learning_rate_scale.fill_(0.5)
    update.run(RECORDS, loss)
    assert update.learning_rate_scale.item() == pytest.approx({0.005: 0.625, 0.012: 0.5}.get(kl, 0.4))
    update.kl_target = None
    assert update.run(RECORDS, loss)["ppo/learning_rate_scale"] == 1.0, "without a target it is the full one"


# The guard against losses that are not finite, alone; with a learner it is in ``test_dreamer_v3.py``.


def test_a_lagging_guard_names_the_batch_that_was_bad():
    guard, names = FiniteGuard(lag=2), ("loss", "reward_error", "gradient_norm/actor")
    metrics = {name: torch.tensor(1.0) for name in names} | {"agreement": torch.tensor(math.nan)}
    for number in range(4):
        guard.check(metrics, number)
    guard.check(metrics | {"gradient_norm/actor": torch.tensor(math.inf)}, "bad")
    guard.check(metrics, 5)
    with pytest.raises(NonFiniteLossError) as error:
        guard.check(metrics, 6)
    assert error.value.batch == "bad"
