"""One's own: losses, rewards, tracks."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.tracks import Track, describe_track, load_track
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.flyer import trained_track
from dreamer_racing.modules import Interface
from dreamer_racing.training.directory import RunDirectory
from tests.running_recipes import ROOT, TINY, UNDRAWN, completed, compose, recipe_module, refused, run_config


def written(page: str) -> list[str]:
    """The Python that a page writes."""
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.M | re.S)


LARGER = (ROOT / "examples" / "losses" / "overshooting.py").read_text(encoding="utf-8")
LOSSES, REWARDS = "\n\n".join([*written("losses.md"), LARGER]), "\n\n".join(written("own_rewards.md")[:-1])
OVERRIDES = [
    "loss.world_model=reconstruction+my_losses:Overshooting",
    "loss.actor=my_losses:smooth_dynamics",
    "env.reward=my_rewards:smooth",
]


@pytest.mark.slow
def test_an_agent_of_own_losses_is_evaluated_flown_exported_and_drawn_from_elsewhere(tmp_path: Path) -> None:
    home, elsewhere, run = tmp_path / "home", tmp_path / "elsewhere", tmp_path / "run"
    home.mkdir()
    elsewhere.mkdir()
    (home / "my_losses.py").write_text(LOSSES)
    (home / "my_rewards.py").write_text(REWARDS)
    overrides = [*TINY, "tuned=none", *OVERRIDES, f"run_dir={run}", "evaluation.every=100"]
    trained = completed("dreamer_v3", *overrides, cwd=home, before=UNDRAWN)
    assert "my_losses:Overshooting" in (run / "config.yaml").read_text()
    assert "reward: my_rewards:smooth, minus the curriculum's penalty of body rates" in trained.stdout
    lost = refused("evaluate", f"checkpoint={run}", "episodes=1", cwd=elsewhere)
    assert f"there is no my_losses.py in {elsewhere}" in lost and "set PYTHONPATH to that folder" in lost
    path = f"import sys; sys.path.append({str(home)!r})"  # what PYTHONPATH does
    for name, *overrides in (
        ("evaluate", f"checkpoint={run}", "episodes=1", "video_steps=5"),
        ("fly", f"agent={run}", f"run_dir={elsewhere / 'flight'}"),
        ("export", f"checkpoint={run}", f"output={elsewhere / 'export' / 'actor.onnx'}"),
        ("plot", f"runs={run}", f"output={elsewhere / 'figures'}"),
    ):
        completed(name, *overrides, cwd=elsewhere, before=path)
    assert json.loads((run / "evaluation" / "evaluation.json").read_text())["deterministic"]["num_episodes"] == 1
    assert list((elsewhere / "flight").rglob("*trajectory.csv"))
    assert (elsewhere / "export" / "actor.onnx").is_file()
    assert (elsewhere / "figures" / "learning_curves.png").is_file()


# A reward and an observation of one's own, by their names in a run's configuration.


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
    dreamer, arena, saved = map(recipe_module, ("dreamer_v3", "composing.building", "composing.saved"))
    resolved = dreamer.resolve(compose("dreamer_v3", *RUN, *OWN))
    OmegaConf.save(resolved, folder / "config.yaml")
    config = saved.trained_config(folder)
    trained_in, flown_in = (
        arena.make_env(config),
        DroneRacingEnv(num_envs=1, evaluation=True, **arena.shared_env_arguments(config)),
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
        ("vector=progress", r"env\.vector='progress': must be a function"),
    ],
)
def test_bad_ones_are_refused_before_anything_is_built(folder: Path, own: str, message: str) -> None:
    config = run_config(*RUN, f"env.{own}")
    with pytest.raises(ValueError, match=message):
        config.check()


def test_the_control_suite_has_neither() -> None:
    config = run_config("env=dmc", "model=debug", OWN[0])
    with pytest.raises(ValueError, match=r"env\.reward=my_own:constant is for races"):
        config.check()


def test_what_sees_numbers_of_ones_own_is_not_exported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exporting = recipe_module("export")
    config = run_config(*RUN, *OWN)
    monkeypatch.setattr(exporting, "find_trained", lambda name: folder)
    monkeypatch.setattr(exporting, "config_folder", lambda path: path)
    monkeypatch.setattr(exporting, "trained_config", lambda path: config)
    with pytest.raises(ValueError, match=r"env\.vector=my_own:action, which reads the simulator's state"):
        exporting.export(exporting.ExportConfig(checkpoint="run"))


# A track of the user's own: a run keeps it as it was, and what comes of the run flies it.


EVALUATION = ("episodes=1", "num_envs=1", "video_steps=5")


@pytest.fixture
def track() -> Track:
    """Circle from a start that is a little higher."""
    circle = load_track("circle")
    x, y, z = circle.start_position
    return replace(circle, name="mine ${oc.env:HOME}", start_position=(x, y, z + 0.1))


@pytest.mark.slow
def test_a_run_keeps_the_track_of_a_file_that_is_gone(track: Track, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    file, directory, agent = tmp_path / "tracks" / "mine.yaml", tmp_path / "run", tmp_path / "mine"
    write(track, file)
    drone = tmp_path / "drone.yaml"
    drone.write_text("preset: easy\nparameters: {mass: 0.62}\n")
    short = [override for override in TINY if not override.startswith("track=")]
    completed("dreamer_v3", f"track={file}", f"env.preset={drone}", *short, "run_dir=run", cwd=tmp_path, before=UNDRAWN)
    write(load_track("circle"), file)
    drone.write_text("preset: easy\nparameters: {mass: 0.9}\n")  # for another run
    (tmp_path / "copy.yaml").write_text("preset: easy\nparameters: {mass: 0.62}\n")  # the same drone
    refusal = refused("dreamer_v3", "resume=run", f"env.preset={drone}", cwd=tmp_path)
    assert f"run was trained with env.preset={directory / 'drone.yaml'}, which cannot change to {drone}" in refusal
    longer = ["budget=none", "total_env_steps=240", "env.preset=copy.yaml"]
    resumed = completed("dreamer_v3", "resume=run", *longer, cwd=tmp_path, before=UNDRAWN)
    assert f"track: {file} has changed since the run started; the run keeps the old track\n" in resumed.stdout
    # a choice of settings composes everything anew, up to what is noted
    anew = ["tuned=auto", *short, "total_env_steps=280"]
    again = completed("dreamer_v3", "resume=run", *anew, cwd=tmp_path, before=UNDRAWN)
    assert "has changed since" in again.stdout
    starts = RunDirectory(directory).read_starts()
    given = [next(each for each in start["overrides"] if "preset" in each) for start in starts]
    assert given == [f"env.preset={drone}", "env.preset=copy.yaml", "env.preset=copy.yaml"], "not the run's own copy"
    completed("evaluate", "checkpoint=run", f"track={file}", *EVALUATION, cwd=tmp_path, before=UNDRAWN)
    export = ("export", f"checkpoint={directory}", "agent=mine", "commit=abc1234")
    assert "was flown on another track, or" in refused(*export, cwd=tmp_path)
    file.unlink()
    drone.unlink()
    completed("evaluate", "checkpoint=run", *EVALUATION, cwd=tmp_path, before=UNDRAWN)
    completed(*export, cwd=tmp_path)
    contract = read_contract(agent / "contract.json")
    assert (contract["source"]["track"], trained_track(contract)) == ("mine.yaml", track)
    assert (agent / "drone.yaml").read_text() == (directory / "drone.yaml").read_text()
    assert contract["action"]["trained_mass_kg"] == 0.62
    texts = [path.read_text() for path in agent.iterdir() if path.suffix in (".json", ".yaml")]
    assert not any(str(tmp_path) in text for text in texts), "paths of this machine"
    completed("fly", f"agent={agent}", cwd=tmp_path)


def test_the_track_of_a_file_is_noted_when_a_run_begins(track: Track, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    write(track, file)
    config = run_config(f"track={file}", "model=debug")
    assert config.saved_track() == track
    file.write_text("gates: []", encoding="utf-8")
    assert config.saved_track() == track
    built_in = run_config("track=kidney", "model=debug")
    assert (built_in.saved_track(), built_in.track_description) == (load_track("kidney"), None)


def write(track: Track, file: Path) -> None:
    """Write a track's file."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(yaml.safe_dump(describe_track(track)), encoding="utf-8")
