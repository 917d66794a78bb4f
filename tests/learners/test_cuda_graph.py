"""Updates as CUDA graphs, and how many kernels they launch."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics
from dreamer_racing.learners import latent_ppo
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import TARGETS, Trajectory
from dreamer_racing.modules import Interface, get_size
from tests.dreamers import differing, learner_by, learner_of, make_windows
from tests.launches import Launches, launches


def batch(device: str, windows: int = 2, steps: int = 4) -> TensorDict:
    return make_windows(windows, steps, is_init=[(0, 2)]).to(device)


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
    assert not differing(other.agent.state_dict(), before)
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


# What an update and a control step ask of a device: seen on a CPU, where nobody waits, or on no device at all.


PRIVILEGED = 5
INTERFACE = Interface(privileged_dim=PRIVILEGED)
SIZES = {
    "debug": get_size("debug"),
    "reference": replace(
        get_size("size1m"), belief=32, hidden=16, latents=4, units=16, cnn_depth=8, blocks=8, actor_critic_layers=1
    ),
    "paper": replace(get_size("paper_small"), belief=32, hidden=16, latents=4, classes=4, units=16, cnn_depth=2),
    "soft": replace(get_size("debug"), sampled=False, state_std=False),
}


def records(device: str = "cpu") -> TensorDict:
    return make_windows(3, 4, privileged=PRIVILEGED).to(device)


def with_context(batch: TensorDict, learner: WorldModelLearner) -> TensorDict:
    """Windows that go on from stored latents."""
    size, shape = learner.size, batch.batch_size
    belief, state = (torch.zeros(*shape, width, device=batch.device) for width in (size.belief, size.state))
    return batch.set("context", learner.latent_format.pack(belief, state))


def waits(seen: Launches) -> list[str]:
    """Return where a CUDA device is waited for: torch before 2.13 looks at the shares of a quantile on a CPU alone."""
    return [place for place in seen.waits if not place.startswith("equal at modules/value_norm.py:")]


def captured(learner: WorldModelLearner, batch: TensorDict) -> Callable[[], object]:
    """What a CUDA graph captures of an update."""
    return lambda: learner._backward(batch)


ACTORS = ("reinforce", "dynamics", "latent_ppo")
LOSSES = [*product(TARGETS, ACTORS[:1]), *product([next(iter(TARGETS))], ACTORS[1:])]
"""Every target and every actor; neither knows of the other."""


def make_learner(actor: str, size: str = "debug", **options: Any) -> WorldModelLearner:
    of_state = {"critic": "state"} if actor == "latent_ppo" else {}
    return learner_by(actor, SIZES[size], INTERFACE, **of_state, **options)


def test_kernels_waits_and_devices_are_told_apart() -> None:
    values = torch.arange(6.0).view(2, 3)
    assert launches(lambda: values.T.reshape(6)[1:] + 1).kernels == {"clone": 1, "add": 1}
    assert "item" not in launches(lambda: values.sum()).kernels
    for waits in (
        lambda: values.sum().item(),
        lambda: values[values > 2],
        lambda: values.nonzero(),
        lambda: bool(values.any()),
        lambda: values.masked_select(values > 2),
        lambda: values.index_put_((values > 2,), torch.zeros(())),
    ):
        assert len(launches(waits).waits) == 1
    seen = launches(lambda: values.to("meta") + torch.ones(()))
    assert len(seen.mixed) == 1 and seen.mixed[0].startswith("_to_copy at learners/test_cuda_graph.py:")
    assert len(launches(lambda: torch.ones(3, device="meta").mul_(torch.ones(3))).mixed) == 1
    assert not launches(lambda: values * torch.ones(())).mixed, "a number goes with every device"


@pytest.mark.parametrize("mixed_precision", [False, True], ids=["float32", "bfloat16"])
@pytest.mark.parametrize(("world_model", "actor"), LOSSES)
def test_no_update_waits_for_the_device(
    monkeypatch: pytest.MonkeyPatch, world_model: str, actor: str, mixed_precision: bool
) -> None:
    monkeypatch.setattr(latent_ppo, "masks_steps", lambda device: True)
    learner = make_learner(actor, world_model=world_model, drift_scale=1.0, mixed_precision=mixed_precision)
    batch = with_context(records(), learner)
    learner.update(batch)  # optimisers make their moments
    seen = launches(captured(learner, batch))
    assert seen.count > 100 and (waits(seen), seen.mixed) == ([], [])
    assert "randperm" not in seen.kernels, "which CUDA cannot capture"
    guard = len(launches(lambda: learner._guard.check({"loss": torch.ones(())}, batch)).waits)
    rest = waits(launches(lambda: learner.update(batch)))
    assert len(rest) == guard, "only the look at whether the loss was finite, which on CUDA is two updates late"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("options", [{}, {"imagination_starts": 5}], ids=["all", "some"])
def test_no_size_waits_for_the_device(size: str, options: dict[str, object]) -> None:
    learner = make_learner("reinforce", size, mixed_precision=True, average_rate=0.1, **options)
    seen = launches(captured(learner, with_context(records(), learner)))
    assert seen.count > 100 and (waits(seen), seen.mixed) == ([], [])


@pytest.mark.parametrize(
    ("world_model", "actor", "size"),
    [*((*loss, "debug") for loss in LOSSES), *(("reconstruction", "reinforce", size) for size in [*SIZES][1:])],
)
def test_no_update_makes_tensors_on_another_device(world_model: str, actor: str, size: str) -> None:
    """On the meta device, which holds nothing: what is on the CPU beside it would be beside CUDA, too."""
    with torch.device("cpu"):  # the default of what forgets to say where
        learner = make_learner(actor, size, world_model=world_model, drift_scale=1.0, device="meta")
        batch = with_context(records("meta"), learner)
        seen = launches(captured(learner, batch))
    assert seen.count > 100 and seen.mixed == []


@pytest.mark.parametrize("preset", ["easy", "faithful"])
@pytest.mark.parametrize("looks", ["nominal", "randomised"])
def test_no_control_step_waits_for_the_device(preset: str, looks: str) -> None:
    """Of the simulator of CUDA, which runs on a CPU too; warp's kernels are not torch's, and not seen."""
    worlds = RaceWorlds("kidney", 3, preset, seed=0, backend="mujoco_warp", looks=looks, miss_radius=2.0)
    worlds.reset()
    worlds.race._sweep._picks = False  # as on CUDA

    def step() -> None:
        worlds._fly(torch.zeros(3, 4))
        worlds.render()
        worlds.vector()
        worlds.privileged()

    seen = launches(step)
    worlds.close()
    assert seen.count > 50 and (seen.waits, seen.mixed) == ([], [])


@pytest.mark.parametrize("ends", [False, True], ids=["flies_on", "ends"])
@pytest.mark.parametrize("remembers", [False, True], ids=["race", "with_memory"])
@pytest.mark.parametrize("settings", [{"from_pixels": False}, {"looks": "randomised"}], ids=["numbers", "pixels"])
def test_a_step_asks_once_which_episodes_ended(settings: dict[str, Any], remembers: bool, ends: bool) -> None:
    race = DroneRacingEnv("circle", 3, preset="faithful", seed=0, backend="mujoco_warp", **settings)
    race.worlds.race._sweep._picks = False  # as on CUDA
    primer = TensorDictPrimer({"memory": Unbounded((2,))}, default_value=0.0, expand_specs=True)
    env = with_memory(race, primer) if remembers else race
    acted = env.rand_action(env.reset())
    acted["action"][1] = math.nan if ends else 0.0
    seen = launches(lambda: env.step_and_maybe_reset(acted))
    env.close()
    assert [place.partition(" ")[0] for place in seen.waits] == ["nonzero"] and not seen.mixed
