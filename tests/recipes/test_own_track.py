"""A track of the user's own: a run keeps it as it was, and what comes of the run flies it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from dreamer_racing.envs.tracks import Track, describe_track, load_track
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.flyer import trained_track
from tests.running_recipes import TINY, UNDRAWN, compose, recipe, recipe_module

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
    short = [override for override in TINY if not override.startswith("track=")]
    begun = recipe("dreamer_v3", f"track={file}", *short, "run_dir=run", cwd=tmp_path)
    assert begun.returncode == 0, begun.stderr
    write(load_track("circle"), file)
    resumed = recipe("dreamer_v3", "resume=run", "budget=none", "total_env_steps=240", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert f"track: as {file} was when the run was begun, which it no longer is\n" in resumed.stdout
    # a choice of settings composes everything anew, up to what is noted
    again = recipe("dreamer_v3", "resume=run", "tuned=auto", *short, "total_env_steps=280", cwd=tmp_path)
    assert again.returncode == 0 and "which it no longer is" in again.stdout, again.stderr
    of_now = recipe("evaluate", "checkpoint=run", f"track={file}", *EVALUATION, cwd=tmp_path, before=UNDRAWN)
    assert of_now.returncode == 0, of_now.stderr
    export = ("export", f"checkpoint={directory}", "agent=mine", "commit=abc1234")
    refused = recipe(*export, cwd=tmp_path)
    assert refused.returncode == 2 and "was flown on another track, or" in refused.stderr, refused.stderr
    file.unlink()
    evaluated = recipe("evaluate", "checkpoint=run", *EVALUATION, cwd=tmp_path, before=UNDRAWN)
    assert evaluated.returncode == 0, evaluated.stderr
    exported = recipe(*export, cwd=tmp_path)
    assert exported.returncode == 0, exported.stderr
    contract = read_contract(agent / "contract.json")
    assert (contract["source"]["track"], trained_track(contract)) == ("mine.yaml", track)
    texts = [path.read_text() for path in agent.iterdir() if path.suffix in (".json", ".yaml")]
    assert not any(str(tmp_path) in text for text in texts), "paths of this machine"
    flown = recipe("fly", f"agent={agent}", cwd=tmp_path)
    assert flown.returncode == 0, flown.stderr


def test_the_track_of_a_file_is_noted_when_a_run_begins(track: Track, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    write(track, file)
    dreamer, arena = recipe_module("dreamer_v3"), recipe_module("composing.arena")
    config = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", f"track={file}", "model=debug")))
    assert arena.track_as_begun(config) == track
    file.write_text("gates: []", encoding="utf-8")
    assert arena.track_as_begun(config) == track
    built_in = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", "track=kidney", "model=debug")))
    assert (arena.track_as_begun(built_in), built_in.track_description) == (load_track("kidney"), None)


def test_what_a_run_notes_is_not_to_be_given() -> None:
    checks = recipe_module("composing.checks")
    with pytest.raises(ValueError, match=r"track_description= is what a run notes of its track's file"):
        checks.check_overrides(compose("dreamer_v3"), ["track_description={}"])


def write(track: Track, file: Path) -> None:
    """Write a track's file."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(yaml.safe_dump(describe_track(track)), encoding="utf-8")
