"""Worlds: their backends, OpenGL's variables, and resets of a part of them."""

from __future__ import annotations

import ast
import gc
import importlib
import inspect
import os
import re
import signal
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, ObservationNorm, PendulumEnv, TensorDictPrimer, TransformedEnv

import dreamer_racing.envs
from dreamer_racing.envs import DroneRacingEnv, dm_control_gl
from dreamer_racing.envs.gl_variables import VARIABLES
from dreamer_racing.envs.policy_memory import RaceWithMemory, with_memory
from dreamer_racing.envs.simulator.opengl import loads
from dreamer_racing.envs.worlds import RaceWorlds, WorldOptions
from tests.renderers import NEEDS_EGL
from tests.running_recipes import ROOT, python

IMPORTS = (ast.Import, ast.ImportFrom)
OF_ADAPTERS = {"self", "track", "num_envs", "preset", "from_pixels"}


def test_every_option_of_the_worlds_is_handed_on():
    parameters = inspect.signature(RaceWorlds.__init__).parameters
    assert set(parameters) - OF_ADAPTERS == set(WorldOptions.__annotations__)


@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_no_gradient_goes_back_to_the_action(preset: str) -> None:
    worlds = RaceWorlds("circle", 2, preset, from_pixels=False, seed=0)
    worlds.reset()
    leaf = torch.zeros(2, 4, requires_grad=True)
    for _ in range(3):
        outcome = worlds.step(torch.tanh(leaf))
    simulator = worlds.simulator
    kept = [
        *vars(outcome).values(),
        *vars(simulator.state).values(),
        *worlds.race.state_dict().values(),
        simulator.quadrotor.setpoints,
        simulator.quadrotor.rotor_speed,
    ]
    assert not any(tensor.requires_grad for tensor in kept)


def test_changes_of_action_cost_what_they_are_weighed_with_but_not_over_a_reset() -> None:
    weight, actions = 0.1, 0.5 * torch.rand(4, 2, 4, generator=torch.Generator().manual_seed(0)) - 0.5
    plain, weighed = (
        RaceWorlds("circle", 2, from_pixels=False, seed=0, action_change_weight=value) for value in (0.0, weight)
    )
    plain.reset()
    weighed.reset()
    for step, action in enumerate(actions):
        expected = plain.step(action).reward_base
        if step:
            expected = expected - weight * (action - actions[step - 1]).square().sum(1)
        torch.testing.assert_close(weighed.step(action).reward_base, expected)
    mask = torch.tensor([True, False])
    plain.reset(mask)
    weighed.reset(mask)
    lost = plain.step(actions[0]).reward_base - weighed.step(actions[0]).reward_base
    torch.testing.assert_close(
        lost, torch.stack((torch.zeros(()), weight * (actions[0, 1] - actions[3, 1]).square().sum()))
    )
    other = RaceWorlds("circle", 2, from_pixels=False, seed=1, action_change_weight=weight)
    other.load_state_dict(weighed.state_dict())
    assert torch.equal(other.step(actions[1]).reward_base, weighed.step(actions[1]).reward_base)
    assert (
        RaceWorlds("circle", from_pixels=False, evaluation=True, action_change_weight=1.0).action_change_weight == 0.0
    )


@pytest.mark.parametrize(("lives", "acts"), [("cuda:0", "cuda:1"), ("cuda:0", "cpu"), ("cpu", "cuda:0")])
def test_an_action_on_another_device_is_refused(lives: str, acts: str) -> None:
    worlds = RaceWorlds("circle", 2, from_pixels=False, seed=0)
    worlds.reset()
    worlds.device = torch.device(lives)
    with FakeTensorMode():
        action = torch.zeros(2, 4, device=acts)
        with pytest.raises(ValueError, match=f"Action on {acts}: must be on {lives}"):
            worlds.step(action)


def in_a_fork(work: Callable[[], None]) -> bool:
    """Whether a forked process did its work, without an error and in less than 20 s."""
    if child := os.fork():
        return os.waitpid(child, 0)[1] == 0
    signal.alarm(20)
    try:
        work()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
@pytest.mark.parametrize("from_pixels", [False, True])
def test_a_forked_process_is_told_instead_of_waiting_for_ever(from_pixels: bool) -> None:
    made = [RaceWorlds("circle", 2, from_pixels=from_pixels, renderer="warp", num_threads=2, seed=0)]
    made[0].reset()

    def told() -> None:
        for work in (made[0].reset, made[0].render, lambda: made[0].step(torch.zeros(2, 4))):
            with pytest.raises(RuntimeError, match="was forked from it.*by multiprocessing's 'spawn'"):
                work()

    def freed() -> None:
        made.clear()
        gc.collect()

    for work in (told, lambda: made[0].close(), freed):
        assert in_a_fork(work)
    made[0].step(torch.zeros(2, 4))
    made[0].close()


# Variables that OpenGL's users read: none of them keeps a drone from flying, and the one in the way is named.


@pytest.mark.slow
def test_images_are_drawn_whatever_mujoco_gl_says(tmp_path: Path) -> None:
    value = "no_such_thing" if loads("libOSMesa.so.8") else "osmesa"
    program = (
        "from dreamer_racing.envs import DroneRacingEnv; print(DroneRacingEnv('circle', 1).reset()['pixels'].shape)"
    )
    done = python("-c", program, cwd=tmp_path, without=VARIABLES, MUJOCO_GL=value)
    assert done.returncode == 0 and "64" in done.stdout, done.stderr
    assert done.stderr.count(f"MUJOCO_GL={value} is ignored") == 1


def test_a_training_begins_whatever_mujoco_gl_says(tmp_path: Path) -> None:
    """TorchRL imports MuJoCo, too. What is refused here is refused once all is imported."""
    program = [str(ROOT / "recipes" / "dreamer_v3.py"), "model=debug", "total_env_steps=1"]
    done = python(*program, cwd=tmp_path, without=VARIABLES, MUJOCO_GL="no_such_thing")
    assert done.returncode == 2 and "Traceback" not in done.stderr and "prefill" in done.stderr, done.stderr
    assert done.stderr.count("MUJOCO_GL=no_such_thing is ignored") == 1


def test_whatever_imports_torchrl_has_heeded_the_variable_before() -> None:
    package = ROOT / "dreamer_racing"
    users = {path for path in package.rglob("*.py") if re.search(r"^(from|import) torchrl", path.read_text(), re.M)}
    folders = {package / path.relative_to(package).parts[0] for path in users} - {package / "envs"}
    assert package / "learners" in folders
    for folder in folders:
        first = next(node for node in ast.parse((folder / "__init__.py").read_text()).body if isinstance(node, IMPORTS))
        assert ast.unparse(first) == "import dreamer_racing.envs", folder


@NEEDS_EGL
@pytest.mark.parametrize(
    ("name", "value"), [("MUJOCO_GL", "no_such_thing"), ("PYOPENGL_PLATFORM", "glx"), ("MUJOCO_EGL_DEVICE_ID", "one")]
)
def test_the_doctor_names_the_variable_and_no_package_that_is_there(tmp_path: Path, name: str, value: str) -> None:
    done = python(str(ROOT / "recipes" / "doctor.py"), cwd=tmp_path, without=VARIABLES, **{name: value})
    assert f"unset {name}" in done.stdout and f"{name}={value}" in done.stdout
    assert "Traceback" not in done.stderr and "apt-get install libegl1" not in done.stdout


@NEEDS_EGL
@pytest.mark.slow
@pytest.mark.parametrize("word", ["", "no_such_thing"])  # where there is no word, dm_control_gl chooses egl
def test_dm_control_draws_whatever_pyopengl_platform_says(tmp_path: Path, word: str) -> None:
    program = "from dreamer_racing.envs import load; print(load('circle', from_pixels=True).reset().observation.keys())"
    done = python("-c", program, cwd=tmp_path, without=VARIABLES, MUJOCO_GL=word, PYOPENGL_PLATFORM="glx")
    assert done.returncode == 0 and "pixels" in done.stdout, done.stderr
    assert done.stderr.count("PYOPENGL_PLATFORM=glx is ignored") == 1


def test_dm_control_does_without_opengl_where_none_of_it_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(dm_control_gl, "imports_with_variable", lambda name: False)
    dm_control_gl.import_dm_control()
    assert os.environ["MUJOCO_GL"] == "disable"


def test_what_fails_while_a_module_is_loaded_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(ImportError, match="RaceWorlds cannot be imported: .*glGetError"):
        dreamer_racing.envs.RaceWorlds  # noqa: B018 - is imported


# Partial resets: what is seen after them is what TorchRL's own merge gives.


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
        {"imu": "noisy"},
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
    with pytest.raises(TypeError, match=r"with_memory needs a transform, policy.make_primer\(\), not Linear"):
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
