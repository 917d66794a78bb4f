"""Recipes around flights: fly, tracks, sim_to_real."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from PIL import Image
from tensordict import TensorDictBase

from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, load_track
from dreamer_racing.envs.viewer import WindowClosedError
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.plant.study import StudyFlight
from tests.running_recipes import ROOT, recipe, recipe_module, refused


class StandIn:
    """In place of a `RaceWindow`: closed when the second flight begins, or after so many pictures."""

    def __init__(self, worlds: RaceWorlds, pictures: int) -> None:
        self.track, self.pictures = worlds.track.name, pictures
        self.gates: list[int] = []
        self.images: list[tuple[int, ...]] = []
        self.closed = False

    def show(self, tensordict: TensorDictBase) -> None:
        self.gates.append(int(tensordict["race", "gates_passed"]))
        self.images.append(tuple(tensordict["pixels"].shape))
        if self.gates[-1] < max(self.gates) or len(self.gates) == self.pictures:
            raise WindowClosedError

    def close(self) -> None:
        self.closed = True


def watch(fly: ModuleType, monkeypatch: pytest.MonkeyPatch, pictures: int, **settings: str) -> StandIn:
    """Fly before a stand-in."""
    opened: list[StandIn] = []
    monkeypatch.setattr(fly, "RaceWindow", lambda worlds: opened.append(StandIn(worlds, pictures)) or opened[-1])
    monkeypatch.setattr(fly, "BREAK", 0.0)
    monkeypatch.setattr(fly, "check_window", lambda: None)
    config = fly.FlyConfig(viewer=True, **settings)
    config.check()
    fly.watch(config)
    (window,) = opened
    assert window.closed
    return window


def test_an_agent_flies_before_someones_eyes_until_the_window_is_closed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    window = watch(recipe_module("fly"), monkeypatch, pictures=1000, agent="circle")
    assert window.track == "circle" and set(window.images) == {(1, 64, 64, 3)}
    assert sorted(set(window.gates)) == list(range(12)) and window.gates[-1] == 0, "three laps, and again"
    words = capsys.readouterr().out
    assert words.count("flight ") == 1 and "flight 1: finished after 12 gates, laps: " in words


def test_a_pilot_flies_before_someones_eyes(monkeypatch: pytest.MonkeyPatch) -> None:
    window = watch(recipe_module("fly"), monkeypatch, pictures=5, pilot="hover", track="figure8")
    assert window.track == "figure8" and window.gates == [0] * 5


def test_without_a_display_it_says_in_a_sentence_how_to_get_a_video(monkeypatch: pytest.MonkeyPatch) -> None:
    fly = recipe_module("fly")
    monkeypatch.setattr("dreamer_racing.envs.viewer.sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    words = (
        r"cannot open a window here: no display .*; leave out viewer=true for a video, a GIF and a plot in runs/fly\.$"
    )
    for flown in ({"agent": "kidney"}, {"pilot": "hover"}):
        with pytest.raises(ValueError, match=words):
            fly.FlyConfig(viewer=True, **flown).check()


@pytest.mark.parametrize(
    "refused", [{"track": "monza"}, {"agent": "circle", "control_rate": 49.0}], ids=["track", "control rate"]
)
def test_a_flight_that_is_refused_leaves_no_folder(refused, tmp_path, monkeypatch) -> None:
    fly = recipe_module("fly")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for run_dir in ("runs/fly", "mine/fly", "mine"):
        with pytest.raises(SystemExit):
            fly.fly(fly.FlyConfig(run_dir=run_dir, **refused))
        assert [path.name for path in tmp_path.rglob("*")] == ["mine"]


def test_a_view_that_there_is_not_is_refused_before_the_flight() -> None:
    fly = recipe_module("fly")
    with pytest.raises(ValueError, match=r"^view=side: must be one of map, chase\.$"):
        fly.FlyConfig(view="side").check()
    with pytest.raises(ValueError, match=r"^viewer=true and view=chase"):
        fly.FlyConfig(viewer=True, view="chase").check()


@pytest.mark.parametrize("flyer", [{"agent": "circle"}, {"pilot": "hover", "track": "circle", "control_rate": 10}])
def test_a_flight_is_filmed_from_outside(flyer: dict[str, Any], tmp_path: Path) -> None:
    fly = recipe_module("fly")
    fly.fly(fly.FlyConfig(**flyer, view="chase", run_dir=str(tmp_path)))
    with Image.open(tmp_path / "chase.gif") as film:
        assert film.n_frames > 10 and film.width == 256 + 8 + 256 and film.height > 256
    assert (tmp_path / "onboard.gif").is_file()


def test_without_opengl_no_flight_is_filmed_and_none_is_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fly = recipe_module("fly")

    def missing(*_: object, **__: object) -> None:
        raise RendererUnavailableError("Only OpenGL can draw a drone from outside, and there is none here.")

    monkeypatch.setattr(fly, "ChaseView", missing)
    with pytest.raises(SystemExit):
        fly.fly(fly.FlyConfig(pilot="hover", view="chase", run_dir=str(tmp_path / "new")))
    assert "and there is none here." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# The list of tracks.


TRIANGLE = """name: triangle
gates:
  - {position: [0.0, 0.0, 1.35], yaw_degrees: 0.0}
  - {position: [8.0, 0.0, 1.35], yaw_degrees: 120.0}
  - {position: [8.0, 6.0, 1.35], yaw_degrees: -120.0}
"""


def test_the_list_needs_no_torch_and_has_every_track(tmp_path: Path) -> None:
    before = (
        "import builtins; imports = builtins.__import__\n"
        "def without_torch(name, *rest, **named):\n"
        "    assert name.partition('.')[0] != 'torch'\n"
        "    return imports(name, *rest, **named)\n"
        "builtins.__import__ = without_torch"
    )
    done = recipe("tracks", cwd=tmp_path, before=before)
    head, *lines = done.stdout.splitlines()
    assert done.returncode == 0 and head.startswith("track"), done.stderr
    assert [line.split()[0] for line in lines] == list(BUILTIN_TRACKS)
    assert not list(tmp_path.iterdir())
    assert done.stdout in (ROOT / "docs" / "tracks.md").read_text(encoding="utf-8")


def test_a_track_of_ones_own_is_measured_and_drawn(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(TRIANGLE)
    done = recipe("tracks", "track=mine.yaml", "picture=mine.png", "--json", cwd=tmp_path)
    (found,) = json.loads(done.stdout)
    assert found["track"] == "triangle" and (found["gates"], found["decoys"], found["laps"]) == (3, 0, 3)
    assert found["lap_length"] == 8.0 + 6.0 + 10.0 and found["least_gate_distance"] == 6.0
    with Image.open(tmp_path / "mine.png") as image:
        assert image.width > 500


def test_what_cannot_be_flown_or_drawn_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("gates: 3\n")
    for overrides, said in ((["track=mine.yaml"], "mine.yaml: gates is 3"), (["picture=a.gif"], "picture=a.gif")):
        assert said in refused("tracks", *overrides, cwd=tmp_path)


# `recipes/sim_to_real.py` before anything flies.


sim_to_real = recipe_module("sim_to_real")


def test_an_actor_of_another_track_is_refused():
    assert sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney"))[0] == load_track("kidney")
    with pytest.raises(ValueError, match="source.track is 'kidney', .* track=circle"):
        sim_to_real.check(sim_to_real.SimToRealConfig(actor="kidney", track="circle"))


def test_the_pilot_is_not_flown_beside_itself():
    with pytest.raises(ValueError, match="beside=pilot and actor=pilot"):
        sim_to_real.check(sim_to_real.SimToRealConfig(track="circle", beside="pilot"))


def test_agent_and_pilot_come_of_one_command(monkeypatch, tmp_path):
    made = []

    def flown(make_flyer, track, *others):
        made.append(make_flyer.func.__name__)
        yield StudyFlight("delay", 0.0, 0, 18, True, 4.0 + len(made), 9.0, "over")

    monkeypatch.setattr(sim_to_real, "study", flown)
    monkeypatch.setattr("sys.argv", ["sim_to_real", "actor=kidney", "beside=pilot", f"run_dir={tmp_path}", "flights=1"])
    sim_to_real.main()
    assert made == ["ActorFlyer", "PilotFlyer"]
    for name, actor, lap in (("sim_to_real", "kidney", 5.0), ("sim_to_real_pilot", "pilot", 6.0)):
        result = json.loads((tmp_path / f"{name}.json").read_text())
        assert result["provenance"]["actor"] == actor and result["flights"][0]["lap_time"] == lap
    assert (tmp_path / "sim_to_real.png").stat().st_size > 1000
