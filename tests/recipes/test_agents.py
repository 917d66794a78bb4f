"""Agents that ship, as a user makes, evaluates and flies them."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export import agents
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.export.shipped_agent import FILES, ShippedAgent, is_agent
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.publishing import write_checksums
from tests.running_recipes import ROOT, UNDRAWN, completed, recipe_module, refused

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.xdist_group("agent")  # one worker makes what these tests share

EVALUATION = ("episodes=1", "num_envs=1", "video_steps=5")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished debug run that is privileged, sees small images and keeps averaged weights."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    completed(
        "dreamer_v3", "track=circle", "model=debug", "model.average_rate=0.1", "loss=privileged", "env.image_size=32",
        "env.control_rate=25", "env.num_envs=4", "prefill=100", "total_env_steps=160", "replay.capacity=1000",
        "evaluation.every=0", f"run_dir={directory}", cwd=directory.parent, before=UNDRAWN,
    )  # fmt: skip
    return directory


@pytest.fixture(scope="module")
def agent(run_dir: Path) -> Path:
    """An agent made of that run, and its evaluation."""
    folder = run_dir.parent / "agents" / "mine"
    command = ("export", f"checkpoint={run_dir}", f"agent={folder}", "commit=abc1234")
    early = refused(*command, cwd=run_dir.parent)
    assert "an agent ships with its results. Make it with: " in early and "recipes/evaluate.py checkpoint=" in early
    assert not is_agent(folder)
    of_trained = (f"checkpoint={run_dir}", "weights=trained", *EVALUATION)
    trained = completed("evaluate", *of_trained, cwd=run_dir.parent, before=UNDRAWN)
    assert "weights: trained\n" in trained.stdout
    assert "evaluation of other weights" in refused(*command, cwd=run_dir.parent), "trained, not averaged ones"
    averaged = completed("evaluate", f"checkpoint={run_dir}", *EVALUATION, cwd=run_dir.parent)
    assert "weights: averaged (weights=auto)" in averaged.stdout
    completed(*command, f"evaluation={run_dir}/evaluation_2/evaluation.json", cwd=run_dir.parent)
    return folder


@pytest.mark.slow
def test_an_agent_says_where_it_comes_from(agent: Path, run_dir: Path) -> None:
    assert {path.name for path in agent.iterdir()} == set(FILES)
    about = json.loads((agent / "agent.json").read_text())
    assert (about["track"], about["preset"], about["control_rate"]) == ("circle", "easy", 25.0)
    assert (about["env_steps"], about["weights"], about["training"]["commit"]) == (160, "averaged", "abc1234")
    command = about["training"]["command"]
    assert command.startswith("python recipes/dreamer_v3.py track=circle model=debug model.average_rate=0.1 ")
    evaluation = json.loads((run_dir / "evaluation_2" / "evaluation.json").read_text())
    assert evaluation["provenance"]["weights"] == "averaged"
    assert (run_dir / "evaluation_2" / "videos" / "deterministic.mp4").stat().st_size > 0
    for mode in ("deterministic", "stochastic"):
        assert len(evaluation[mode]["episodes"]) == 1
        assert about["evaluation"][mode]["return_mean"] == evaluation[mode]["return_mean"]
    texts = [path.read_text() for path in agent.iterdir() if path.suffix in (".json", ".yaml")]
    assert not any(str(run_dir.parent) in text for text in texts), "paths of this machine"


@pytest.mark.slow
def test_an_agent_is_flown_evaluated_and_exported_as_its_run_is(agent: Path, run_dir: Path, tmp_path: Path) -> None:
    flown = completed("fly", f"agent={agent}", "run_dir=fly", cwd=tmp_path)
    assert all(words in flown.stdout for words in ("gates per episode", "laps  ", "finished  ", "mine on circle"))
    assert {path.name for path in (tmp_path / "fly").iterdir()} == {
        "evaluation.json", "top_down.png", "onboard.mp4", "onboard.gif", "flight_trajectory.csv", "flight_onboard.npz",
    }  # fmt: skip
    completed("evaluate", f"checkpoint={agent}", *EVALUATION, cwd=tmp_path, before=UNDRAWN)
    written = json.loads((tmp_path / "runs" / "agent_mine" / "evaluation" / "evaluation.json").read_text())
    expected = json.loads((run_dir / "evaluation_2" / "evaluation.json").read_text())
    assert written["deterministic"] == expected["deterministic"]
    assert written["provenance"]["weights_sha256"] == expected["provenance"]["weights_sha256"]
    assert (
        json.loads((tmp_path / "fly" / "evaluation.json").read_text())["episodes"]
        == (expected["deterministic"]["episodes"])
    )
    completed("export", f"checkpoint={agent}", cwd=tmp_path)
    contract = json.loads((tmp_path / "runs" / "agent_mine" / "export" / "contract.json").read_text())
    assert contract["weights_sha256"] == written["provenance"]["weights_sha256"]
    before = {path.name: path.read_bytes() for path in agent.iterdir()}
    said = refused("export", f"checkpoint={agent}", f"output={agent}/actor.onnx", cwd=tmp_path)
    assert "holds an agent, which is kept: choose another" in said
    assert {path.name: path.read_bytes() for path in agent.iterdir()} == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"image_size": 64}, "image_size=64: .*mine was trained with image_size=32"),
        ({"control_rate": 50.0}, "control_rate=50.0: .*mine was trained with control_rate=25.0"),
        ({"camera_tilt": 10.0}, "camera_tilt=10.0: .*mine was trained with camera_tilt=25.0"),
        ({"track": "monza"}, "monza"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_what_an_agent_cannot_fly_is_refused(
    agent: Path, settings: dict, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    fly = recipe_module("fly")
    config = fly.FlyConfig(agent=str(agent), **settings)
    config.check()
    with pytest.raises(SystemExit, match="2"):
        fly.make_flight(config)
    assert re.search(f"^error: .*{words}", capsys.readouterr().err)


@pytest.mark.slow
def test_weights_that_an_agent_does_not_hold_are_refused(agent: Path) -> None:
    settings = recipe_module("composing.restoring").FlightConfig(checkpoint=str(agent), weights="trained", device="cpu")
    with pytest.raises(ValueError, match="weights=trained: .*mine holds the averaged weights only"):
        recipe_module("composing.restoring").restore(settings)


def test_settings_of_which_one_would_be_ignored_are_refused(tmp_path: Path) -> None:
    fly, export = map(recipe_module, ("fly", "export"))
    with pytest.raises(ValueError, match="pilot=hover and agent=kidney: give one of them"):
        fly.FlyConfig(agent="kidney", pilot="hover").check()
    with pytest.raises(ValueError, match="pilot=human: must be one of scripted, hover, keyboard, gamepad"):
        fly.FlyConfig(pilot="human").check()
    (tmp_path / "agent.json").write_text("{}")
    for settings, words in (
        ({"commit": "abc"}, "commit=abc is for agent=FOLDER"),
        ({"agent": "new", "output": "x.onnx"}, "output=x.onnx and agent=new: give one"),
        ({"agent": "new", "latent": "sample"}, "latent=sample: agents ship with latent=mode"),
        ({"agent": "new"}, "checkpoint=there is an agent already"),
    ):
        with pytest.raises(ValueError, match=words):
            export.check_agent(export.ExportConfig(checkpoint="there", **settings), tmp_path)


def test_an_unknown_agent_gets_the_names_of_those_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    restoring = recipe_module("composing.restoring")
    assert agents.AGENTS == ROOT / "agents"
    monkeypatch.setattr(agents, "AGENTS", tmp_path)
    with pytest.raises(FileNotFoundError, match="kidny: the path does not exist.* Included agents, by name: none"):
        restoring.find_trained("kidny")
    for name in ("kidney", "circle"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "agent.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match="by name: circle, kidney"):
        restoring.find_trained("kidny")
    (tmp_path / "unfinished").mkdir()
    assert agents.agents_in(tmp_path) == ["circle", "kidney"] and agents.agents_in(tmp_path / "none") == []
    assert restoring.find_trained("kidney") == restoring.find_trained(str(tmp_path / "kidney")) == tmp_path / "kidney"


@pytest.mark.slow
def test_averaged_weights_that_were_not_kept_are_refused(run_dir: Path, tmp_path: Path) -> None:
    restoring = recipe_module("composing.restoring")
    shutil.copytree(run_dir, tmp_path / "run")
    checkpoint = latest_checkpoint(tmp_path / "run")
    (path,) = checkpoint.glob("components/*-learner/state.pt")
    state = torch.load(path, weights_only=True)
    assert state.pop("averaged")
    torch.save(state, path)
    write_checksums(checkpoint)  # else it is a damaged one
    config, cpu = restoring.trained_config(tmp_path / "run"), torch.device("cpu")
    with pytest.raises(ValueError, match=f"weights=averaged: {checkpoint} holds the trained weights only"):
        restoring.restore_learner(config, checkpoint, cpu, "averaged")
    assert restoring.restore_learner(config, checkpoint, cpu)[0].averaged is None
    assert restoring.restore_learner(config, latest_checkpoint(run_dir), cpu)[0].averaged is not None
    assert restoring.restore_learner(config, latest_checkpoint(run_dir), cpu, "trained")[0].averaged is None


@pytest.mark.parametrize("name", agents.agents_in(ROOT / "agents"))
def test_each_agent_that_ships_is_restored(name: str) -> None:
    """Also those that were made when networks had fewer numbers."""
    folder = ROOT / "agents" / name
    contract = read_contract(folder / "contract.json")
    env = DroneRacingEnv(contract["source"]["track"], 1, seed=0, control_rate=contract["control"]["rate_hz"],
                         camera=Camera(64, 64, tilt=contract["camera"]["tilt_up_deg"]), num_threads=1)  # fmt: skip
    try:
        assert ShippedAgent.load(folder, env).about["track"] == name.partition("_")[0]
    finally:
        env.close()


def test_the_agents_that_ship_are_whole_and_small() -> None:
    folders = [ROOT / "agents" / name for name in agents.agents_in(ROOT / "agents")]
    for folder in folders:
        assert {path.name for path in folder.iterdir()} == set(FILES)
        assert OmegaConf.load(folder / "config.yaml").run_dir is None
        assert sum(path.stat().st_size for path in folder.iterdir()) <= 3.3e6


def test_an_agent_ships_with_the_starts_before_its_checkpoint(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    run.path.mkdir()
    run.note_start(0, ["track=circle", "run_dir=/somewhere"], "abc")
    run.note_start(4000, ["track=circle", "loss.discount=0.98"], "def")
    history_of = recipe_module("export").history_of
    early, late = (run.checkpoints / f"checkpoint-{env_steps:012d}" for env_steps in (4000, 8000))
    assert [start["commit"] for start in history_of(early, 4000)] == ["abc"]
    assert [start["overrides"] for start in history_of(late, 8000)] == [
        ["track=circle"], ["track=circle", "loss.discount=0.98"]
    ]  # fmt: skip
    assert len(history_of(run.best.checkpoints / "checkpoint-000000008000", 8000)) == 2
    assert history_of(tmp_path / "other" / "checkpoints" / "checkpoint-000000000100", 100) == []
