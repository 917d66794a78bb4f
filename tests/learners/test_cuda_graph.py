"""Compiled and graphed updates compute what plain ones do."""

from __future__ import annotations

import functools

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer import DreamerLearner
from tests.dreamers import learner_of


def batch(device: str, windows: int = 2, steps: int = 4) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    shape = (windows, steps)
    records = {
        "pixels": torch.randint(0, 256, (*shape, 64, 64, 3), dtype=torch.uint8, generator=generator),
        "previous_action": torch.rand(*shape, 4, generator=generator) * 2 - 1,
        "reward": torch.randn(*shape, 1, generator=generator),
        "is_init": torch.rand(*shape, 1, generator=generator) < 0.2,
        "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
        "truncated": torch.zeros(*shape, 1, dtype=torch.bool),
    }
    return TensorDict(records, shape).to(device)


def make(device: str, **settings: object) -> DreamerLearner:
    return learner_of(device=device, seed=0, horizon=3, **settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("device", "backend"),
    [("cpu", "aot_eager"), pytest.param("cuda", "inductor", marks=pytest.mark.gpu)],  # inductor's C++ takes minutes
)
@torch._inductor.config.patch(fallback_random=True)  # the same random numbers as eager mode
def test_compiled_updates_are_those_of_eager_mode(device: str, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch._dynamo.reset()
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    plain, compiled = make(device), make(device, compile=True)
    for seed in range(3):
        metrics = []
        for learner in (plain, compiled):
            torch.manual_seed(seed)
            metrics.append({name: value.item() for name, value in learner.update(batch(device, steps=2)).items()})
        assert metrics[1] == pytest.approx(metrics[0], rel=1e-3, abs=1e-4)


def test_a_cuda_graph_needs_a_cuda_device() -> None:
    with pytest.raises(ValueError, match="cuda_graph=True needs a CUDA device, but the learner is on 'cpu'"):
        make("cpu", cuda_graph=True)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "settings", [{}, {"mixed_precision": True}, {"imagination_starts": 3}, {"actor": "dynamics"}], ids=str
)
def test_graphed_updates_learn_as_eager_ones(settings: dict[str, object]) -> None:
    settings = {"lr": 1e-3, "warmup_updates": 0, **settings}
    batches = [batch("cuda"), batch("cuda").flip(0)]  # stale inputs would show
    first, last = [], []
    for cuda_graph in (False, True):
        learner = make("cuda", cuda_graph=cuda_graph, **settings)
        losses = [learner.update(batches[number % 2])["loss_image"].item() for number in range(60)]
        first.append(losses[0])
        last.append(sum(losses[-10:]) / 10)
        assert last[-1] < 0.8 * first[-1], "it learns"
    # Random numbers differ, what is learned does not.
    assert first[1] == pytest.approx(first[0], rel=0.02)
    assert last[1] == pytest.approx(last[0], rel=0.1)


@pytest.mark.gpu
def test_a_graph_refuses_another_batch_shape() -> None:
    learner = make("cuda", cuda_graph=True)
    learner.update(batch("cuda"))
    with pytest.raises(ValueError, match=r"captured for a batch of \[2, 4\], got \[3, 4\]"):
        learner.update(batch("cuda", windows=3))
