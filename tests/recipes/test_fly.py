"""`recipes/fly.py viewer=true`: flights before someone's eyes, in a stand-in for the window; refusals without one."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from PIL import Image
from tensordict import TensorDictBase

from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.viewer import WindowClosedError
from dreamer_racing.envs.worlds import RaceWorlds
from tests.running_recipes import recipe, recipe_module


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
    fly.check(config)
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
            fly.check(fly.FlyConfig(viewer=True, **flown))


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


def test_a_folder_to_which_something_was_written_stays(tmp_path) -> None:
    fly = recipe_module("fly")
    with fly.folder_to_fill(tmp_path / "runs" / "fly") as directory:
        (directory / "evaluation.json").write_text("{}")
    assert (tmp_path / "runs" / "fly" / "evaluation.json").exists()


@pytest.mark.slow
def test_the_refusal_as_a_user_meets_it(tmp_path) -> None:
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        pytest.skip("there is a display here")
    done = recipe("fly", "agent=kidney", "viewer=true", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: The viewer cannot open a window here: ")
    assert not list(tmp_path.iterdir())


def test_a_view_that_there_is_not_is_refused_before_the_flight() -> None:
    fly = recipe_module("fly")
    with pytest.raises(ValueError, match=r"^view=side: there are map, chase\.$"):
        fly.check(fly.FlyConfig(view="side"))
    with pytest.raises(ValueError, match=r"^viewer=true and view=chase"):
        fly.check(fly.FlyConfig(viewer=True, view="chase"))


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
        raise RendererUnavailableError("A drone is drawn from outside by OpenGL alone, and here is none.")

    monkeypatch.setattr(fly, "ChaseView", missing)
    with pytest.raises(SystemExit):
        fly.fly(fly.FlyConfig(pilot="hover", view="chase", run_dir=str(tmp_path / "new")))
    assert "by OpenGL alone, and here is none." in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
