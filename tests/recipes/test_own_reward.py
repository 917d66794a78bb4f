"""A reward and an observation of one's own, by their names in a run's configuration."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.modules import Interface
from tests.running_recipes import compose, recipe_module

SOURCE = """import torch

def constant(step):
    return torch.full_like(step.default_reward, 3.0)

def action(state):
    return state.action

def wide(step):
    return step.after.action
"""
OWN = ["env.reward=my_own:constant", "env.vector=my_own:action"]
RUN = ["track=circle", "model=debug", "device=cpu", "env.num_envs=2"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a file of one's own, from which one starts."""
    (tmp_path / "my_own.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_own", None)


def test_training_and_evaluation_have_them_and_the_run_remembers(folder: Path) -> None:
    dreamer, arena, saved = map(recipe_module, ("dreamer_v3", "composing.arena", "composing.saved"))
    resolved = dreamer.resolve(compose("dreamer_v3", *RUN, *OWN))
    OmegaConf.save(resolved, folder / "config.yaml")
    config = saved.trained_config(folder)
    trained_in, flown_in = (
        arena.make_env(config),
        DroneRacingEnv(num_envs=1, evaluation=True, **arena.worlds_of(config)),
    )
    for env in (trained_in, flown_in):
        interface = Interface.of(env)
        assert (interface.observation_keys, interface.vector_dim) == (["pixels", "vector"], 4)
        step = env.rand_step(env.reset())
        assert step["next", "reward"].eq(3.0).all()
        torch.testing.assert_close(step["next", "vector"], step["action"])
        env.close()


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ("reward=my_own:wide", r"env\.reward=my_own:wide returned a tensor of shape \(2, 4\): must be \(2,\)"),
        ("reward=my_own:constnat", r"env\.reward=my_own:constnat: .* \(did you mean constant\?\)"),
        ("vector=progress", r"env\.vector='progress': must be a function of your own"),
    ],
)
def test_bad_ones_are_refused_before_anything_is_built(folder: Path, own: str, message: str) -> None:
    dreamer, checks = map(recipe_module, ("dreamer_v3", "composing.checks"))
    config = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", *RUN, f"env.{own}")))
    with pytest.raises(ValueError, match=message):
        checks.check(config)


def test_the_control_suite_has_neither() -> None:
    dreamer, checks = map(recipe_module, ("dreamer_v3", "composing.checks"))
    config = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", "env=dmc", "model=debug", OWN[0])))
    with pytest.raises(ValueError, match=r"env\.reward=my_own:constant is for races"):
        checks.check(config)


def test_what_sees_numbers_of_ones_own_is_not_exported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exporting, schema = map(recipe_module, ("export", "composing.schema"))
    config = OmegaConf.to_object(recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *RUN, *OWN)))
    monkeypatch.setattr(exporting, "find_trained", lambda name: folder)
    monkeypatch.setattr(exporting, "config_folder", lambda path: path)
    monkeypatch.setattr(exporting, "trained_config", lambda path: config)
    with pytest.raises(ValueError, match=r"env\.vector=my_own:action, which computes from the simulator's state"):
        exporting.export(schema.ExportConfig(checkpoint="run"))
