"""Partial resets: what is seen after them is what TorchRL's own merge gives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, ObservationNorm, PendulumEnv, TensorDictPrimer, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.policy_memory import RaceWithMemory, with_memory


class StockSteps(DroneRacingEnv):
    """The environment with TorchRL's resets between steps."""

    maybe_reset = EnvBase.maybe_reset


def make(kind: type[DroneRacingEnv] = DroneRacingEnv, **settings: Any) -> DroneRacingEnv:
    return kind("kidney", 4, seed=3, **{"privileged": False, "renderer": "warp", "num_threads": 1, **settings})


def flight(env: EnvBase, steps: int = 12) -> list[TensorDict]:
    """Step with partial resets, from the same seed, with a policy that remembers."""
    torch.manual_seed(0)
    data, flown = env.reset(), []
    for _ in range(steps):
        data.set("action", torch.rand(4, 4) * 2 - 1)
        data.set("noise", torch.rand(4))
        data.set(("next", "memory"), torch.rand(4, 2, 3))
        data.set(("next", "agent", "age"), torch.rand(4, 1))
        step, data = env.step_and_maybe_reset(data)
        flown += [step.clone(), data.clone()]
    return flown


def assert_same_flights(ours: EnvBase, stock: EnvBase) -> None:
    partial = 0
    for one, other in zip(flight(ours, 60), flight(stock, 60), strict=True):
        assert set(one.keys(True, True)) == set(other.keys(True, True))
        assert (one == other).all()
        done = one.get(("next", "done"), torch.zeros(4, 1, dtype=torch.bool))
        partial += bool(done.any() and not done.all())
    assert partial
    ours.close()
    stock.close()


@pytest.mark.parametrize(
    "settings",
    [
        {"from_pixels": False},
        {"from_pixels": False, "privileged": True},
        {"from_pixels": False, "backend": "mujoco_warp"},
        {},
        {"privileged": True},
        {"looks": "randomised"},
    ],
    ids=str,
)
def test_steps_are_those_of_torchrl(settings: dict[str, Any]) -> None:
    assert_same_flights(make(**settings), make(StockSteps, **settings))


@pytest.mark.parametrize("num_envs", [1, 3])
def test_where_all_episodes_end_at_once_a_policys_keys_are_zero_too(num_envs: int) -> None:
    env = DroneRacingEnv("kidney", num_envs, from_pixels=False, privileged=False, seed=3, episode_steps=2)
    data = env.reset().set("memory", torch.ones(num_envs, 2))
    for _ in range(2):
        data.set("action", torch.zeros(num_envs, 4))
        step, data = env.step_and_maybe_reset(data)
    assert step["next", "truncated"].all() and step["memory"].all()
    assert not data["memory"].any() and not data["done"].any()
    assert torch.equal(data["vector"], env.worlds.vector())


def primer(**settings: Any) -> TensorDictPrimer:
    return TensorDictPrimer({"memory": Unbounded((2, 3))}, expand_specs=True, **{"default_value": 0.0, **settings})


@pytest.mark.parametrize("settings", [{}, {"from_pixels": False, "privileged": True}], ids=str)
def test_a_policy_remembers_what_torchrls_transforms_let_it_remember(settings: dict[str, Any]) -> None:
    stock = TransformedEnv(make(StockSteps, **settings), Compose(InitTracker(), primer()))
    ours = with_memory(make(**settings), primer())
    assert isinstance(ours, RaceWithMemory)
    assert_same_flights(ours, stock)


def test_other_environments_have_torchrls_transforms() -> None:
    env = with_memory(PendulumEnv(), primer())
    assert type(env) is TransformedEnv and {"is_init", "memory"} <= set(env.reset().keys())


@pytest.mark.parametrize("settings", [{"default_value": 1.0}, {"default_value": {"memory": 0.5}}], ids=str)
def test_memory_that_does_not_begin_with_zeros_is_torchrls(settings: dict[str, Any]) -> None:
    env = with_memory(make(from_pixels=False), primer(**settings))
    begins = env.reset()["memory"].clone()
    data = env.rand_step(env.reset())["next"].clone(False)
    data["done"].fill_(True)
    assert begins.all() and torch.equal(env.maybe_reset(data.set("memory", begins * 3))["memory"], begins)


def test_transforms_that_are_appended_see_episodes_begin() -> None:
    def appended(race: DroneRacingEnv) -> TransformedEnv:
        env = with_memory(race, primer())
        env.append_transform(ObservationNorm(5.0, 1.0, in_keys=["vector"], standard_normal=False))
        return env

    settings = {"from_pixels": False}
    assert_same_flights(appended(make(**settings)), appended(make(StockSteps, **settings)))


def test_a_policy_in_place_of_its_primer_is_refused() -> None:
    with pytest.raises(TypeError, match=r"with_memory takes policy.make_primer\(\), a transform, and no Linear"):
        with_memory(make(from_pixels=False), torch.nn.Linear(1, 1))


@pytest.mark.parametrize("remember", [False, True])
def test_a_callers_own_data_is_reset_by_torchrl(remember: bool) -> None:
    env = with_memory(make(), primer()) if remember else make()
    data = env.reset().exclude("pixels").set("done", torch.tensor([[True], [False], [True], [False]]))
    assert not env.maybe_reset(data)["done"].any()
    env.close()


def test_the_step_before_keeps_its_images() -> None:
    env = with_memory(make(), primer())
    step = env.rand_step(env.reset())
    ended = torch.tensor([[True], [False], [True], [False]])
    step["next", "done"].copy_(ended)
    kept = step["next", "pixels"].clone()
    data = env.maybe_reset(step["next"].clone(False))
    assert torch.equal(step["next", "pixels"], kept)
    assert torch.equal(data["pixels"][1::2], kept[1::2]) and torch.equal(data["is_init"], ended)
    assert (data["pixels"][::2] != kept[::2]).flatten(1).any(1).all()
    env.close()
