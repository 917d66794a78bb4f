"""A track of the user's own: a run keeps it as it was, and what comes of the run flies it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from dreamer_racing.envs.tracks import Track, describe_track, load_track
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.flyer import track_of
from tests.running_recipes import TINY, compose, recipe, recipe_module


@pytest.fixture
def track() -> Track:
    """Circle from a start that is a little higher."""
    circle = load_track("circle")
    x, y, z = circle.start_position
    return replace(circle, name="mine", start_position=(x, y, z + 0.1))


@pytest.mark.slow
def test_a_run_keeps_the_track_of_a_file_that_is_gone(track: Track, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    file, directory = tmp_path / "tracks" / "mine.yaml", tmp_path / "run"
    file.parent.mkdir()
    file.write_text(yaml.safe_dump(describe_track(track)), encoding="utf-8")
    short = [override for override in TINY if not override.startswith("track=")]
    begun = recipe("dreamer_v3", "track=tracks/mine.yaml", *short, "run_dir=run", cwd=tmp_path)
    assert begun.returncode == 0, begun.stderr
    file.unlink()
    resumed = recipe("dreamer_v3", "resume=run", "total_env_steps=240", cwd=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert "other settings: total_env_steps=240 (was 200)\n" in resumed.stdout
    evaluated = recipe("evaluate", "checkpoint=run", "episodes=1", "num_envs=1", "video_steps=5", cwd=tmp_path)
    assert evaluated.returncode == 0, evaluated.stderr
    exported = recipe("export", f"checkpoint={directory}", "agent=mine", "commit=abc1234", cwd=tmp_path)
    assert exported.returncode == 0, exported.stderr
    contract = read_contract(tmp_path / "mine" / "contract.json")
    assert (contract["source"]["track"], track_of(contract)) == ("mine.yaml", track)
    texts = [path.read_text() for path in (tmp_path / "mine").iterdir() if path.suffix in (".json", ".yaml")]
    assert not any(str(tmp_path) in text for text in texts), "paths of this machine"
    flown = recipe("fly", f"agent={tmp_path / 'mine'}", cwd=tmp_path)
    assert flown.returncode == 0, flown.stderr


def test_the_track_of_a_file_is_noted_when_a_run_begins(track: Track, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(describe_track(track)), encoding="utf-8")
    dreamer, arena = recipe_module("dreamer_v3"), recipe_module("composing.arena")
    config = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", f"track={file}", "model=debug")))
    assert arena.track_of(config) == track
    file.write_text("gates: []", encoding="utf-8")
    assert arena.track_of(config) == track
    built_in = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", "track=kidney", "model=debug")))
    assert (arena.track_of(built_in), built_in.course) == ("kidney", None)


@pytest.mark.parametrize("override", ["course={name:mine}", "+course.name=mine"])
def test_what_a_run_notes_is_not_to_be_given(override: str) -> None:
    checks = recipe_module("composing.checks")
    with pytest.raises(ValueError, match=r"course= is what a run notes of its track's file: give that, track=my_track"):
        checks.check_overrides(compose("dreamer_v3"), [override])
