"""Graphed updates compute what plain ones do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.losses import Trajectory
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


def make(device: str, **settings: object) -> DreamerV3:
    return learner_of(device=device, seed=0, horizon=3, **settings)


def test_a_cuda_graph_needs_a_cuda_device() -> None:
    with pytest.raises(ValueError, match="cuda_graph=True needs a CUDA device, but the learner is on 'cpu'"):
        make("cpu", cuda_graph=True)


@pytest.mark.gpu
@pytest.mark.parametrize(
    "settings", [{}, {"mixed_precision": True}, {"imagination_starts": 3}, {"actor": "dynamics"}], ids=str
)
def test_graphed_updates_learn_as_eager_ones(settings: dict[str, object]) -> None:
    settings = {"learning_rate": 1e-3, "warmup_updates": 0, **settings}
    batches = [batch("cuda"), batch("cuda").flip(0)]  # stale inputs would show
    first, last = [], []
    for cuda_graph in (False, True):
        learner = make("cuda", cuda_graph=cuda_graph, **settings)
        losses = [learner.update(batches[number % 2])["loss_image"].item() for number in range(60)]
        first.append(losses[0])
        last.append(sum(losses[-10:]) / 10)
        assert last[-1] < 0.95 * first[-1], "it learns"
    # Random numbers differ, what is learned does not.
    assert first[1] == pytest.approx(first[0], rel=0.02)
    assert last[1] == pytest.approx(last[0], rel=0.1)


@pytest.mark.gpu
def test_after_the_capture_a_learner_is_measured_saved_and_flown(tmp_path: Path) -> None:
    learner, other = (make("cuda", cuda_graph=True, average_rate=0.1, mixed_precision=True) for _ in range(2))
    for _ in range(3):
        learner.update(batch("cuda"))
    before = {name: value.clone() for name, value in learner.agent.state_dict().items()}
    metrics = held_out_metrics(learner, batch("cuda", steps=SEEN + 3))
    assert all(value.isfinite() for value in metrics.values())
    torch.save(learner.state_dict(), tmp_path / "learner.pt")
    other.load_state_dict(torch.load(tmp_path / "learner.pt", weights_only=False))
    for name, value in before.items():
        assert torch.equal(value, other.agent.state_dict()[name]), name
    course = Course(learner.evaluation_policy(), {"track": "circle", "device": "cuda"}, 2)
    assert len(course.evaluate().episodes) == 2
    course.close()
    assert learner.update(batch("cuda"))["loss"].isfinite(), "the graph still replays"
    assert other.update(batch("cuda"))["loss"].isfinite()
    lengths, objective = [], other.objective

    def noted(trajectory: Trajectory, **numbers: Any) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        lengths.append(len(trajectory.action))
        return objective(trajectory, **numbers)

    other.objective = noted
    other.adjust(imagination_horizon=2)
    assert other.update(batch("cuda"))["loss"].isfinite()
    assert lengths and set(lengths) == {2}, "what is scheduled is captured anew"


@pytest.mark.gpu
@pytest.mark.parametrize("mixed_precision", [False, True])
def test_an_update_waits_for_nothing(mixed_precision: bool) -> None:
    learner = make("cuda", mixed_precision=mixed_precision)
    data = batch("cuda")
    for _ in range(3):
        learner.update(data)
    torch.cuda.set_sync_debug_mode("error")
    try:
        learner._backward(data)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
def test_a_graph_refuses_another_batch_shape() -> None:
    learner = make("cuda", cuda_graph=True)
    learner.update(batch("cuda"))
    with pytest.raises(ValueError, match=r"captured for a batch of \[2, 4\], got \[3, 4\]"):
        learner.update(batch("cuda", windows=3))
