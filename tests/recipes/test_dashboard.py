"""recipes/dashboard.py: which flight is meant, what is refused, and the page that comes of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from dreamer_racing.evaluation.trajectory import Trajectory, read_trajectory, write_flight
from dreamer_racing.settings import check_settings
from tests.figures.test_dashboard import circling
from tests.running_recipes import ROOT, completed, recipe_module, refused


def store(stem: Path, flight: Trajectory | None = None, track: str = "circle") -> None:
    write_flight(stem, flight or circling(), track)


def config(**settings: object) -> object:
    return recipe_module("dashboard").DashboardConfig(**settings)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with two evaluations, of both policies, and TensorBoard files, and one that was evaluated later."""
    monkeypatch.chdir(tmp_path)
    for name in ("000001000", "000002000", "000003000_stochastic"):
        store(tmp_path / "runs" / "a" / "evaluations" / name)
    store(tmp_path / "runs" / "b" / "evaluation_2" / "evaluations" / "deterministic", circling(21, 0.1, judged=False))
    for name in "ab":
        (tmp_path / "runs" / name / "tensorboard").mkdir()
    return tmp_path / "runs"


# --- which flight is meant ---


def test_a_run_is_its_last_evaluation_of_the_deterministic_policy(runs: Path) -> None:
    dashboard = recipe_module("dashboard")
    assert dashboard.locate("run", "runs/a").name == "000002000_trajectory.csv"
    (source,) = dashboard.find(config(run="runs/a"))
    flight = source.flight
    assert (flight.title, source.folder, flight.track.name) == ("a, 2,000 env_steps", runs / "a", "circle")
    assert flight.trajectory.pixels is not None and flight.trajectory.value is not None
    assert dashboard.how_it_trained([source.folder]) == "Training curves: `tensorboard --logdir runs/a`"


def test_folders_and_files_of_other_recipes_are_read_too(runs: Path) -> None:
    dashboard = recipe_module("dashboard")
    store(runs / "fly" / "flight", circling(seen=False, judged=False))
    titles = {
        "runs/b/evaluation_2": "b, deterministic",
        "runs/fly": "fly",
        "runs/fly/flight_trajectory.csv": "fly",
        "runs/a/evaluations/000001000_trajectory.csv": "a, 1,000 env_steps",
    }
    for place, title in titles.items():
        (source,) = dashboard.find(config(run=place))
        assert source.flight.title == title
    assert source.folder == runs / "a"
    (source,) = dashboard.find(config(run="runs/fly"))
    assert "no run directory" in dashboard.how_it_trained([source.folder])


def test_agents_that_ship_go_by_their_names(runs: Path) -> None:
    assert recipe_module("dashboard").locate("run", "kidney") == "kidney"


# --- what is refused ---


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "neither is given"),
        ({"run": "runs/a", "agent": "kidney"}, "both are given, runs/a and kidney"),
        ({"run": "runs/a", "output": "page.pdf"}, "output=page.pdf: .* ends in .html"),
    ],
    ids=lambda value: " ".join(value) or "nothing" if isinstance(value, dict) else None,
)
def test_it_must_be_clear_what_is_meant(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        config(**settings).check()


def test_a_port_is_in_its_range() -> None:
    with pytest.raises(ValueError, match="serve=0: must be at least 1 and at most 65535"):
        check_settings(config(run="runs/a", serve=0))


def test_what_holds_no_flight_is_refused_with_what_would_be_right(runs: Path) -> None:
    dashboard = recipe_module("dashboard")
    agents = ", ".join(sorted(path.parent.name for path in (ROOT / "agents").glob("*/agent.json")))
    named = f"run=runs/nowhere: there is no such .* {agents}"
    with pytest.raises(FileNotFoundError, match=named):
        dashboard.find(config(run="runs/nowhere"))
    (runs / "young").mkdir()
    with pytest.raises(FileNotFoundError, match="against=runs/young holds no flight: .* agent=runs/young flies"):
        dashboard.find(config(run="runs/a", against="runs/young"))
    (runs / "young" / "metrics.csv").write_text("env_steps,loss\n")
    with pytest.raises(ValueError, match="metrics.csv holds no trajectory"):
        dashboard.find(config(run="runs/young/metrics.csv"))


@pytest.mark.parametrize("value", ["0.0", "nan"])
def test_a_flight_without_time_is_damaged(value: str, runs: Path) -> None:
    file = next((runs / "a").rglob("*trajectory.csv"))
    lines = [f"# control_dt: {value}" if "control_dt" in line else line for line in file.read_text().splitlines()]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match=f"control_dt is {float(value):g}, not a number above 0"):
        read_trajectory(file)


def test_flights_of_two_tracks_do_not_fit_into_one_scene(runs: Path) -> None:
    store(runs / "c" / "flight", track="kidney")
    with pytest.raises(ValueError, match="against=runs/c was flown on kidney, a, 2,000 env_steps on circle"):
        recipe_module("dashboard").find(config(run="runs/a", against="runs/c"))


@pytest.mark.parametrize(
    ("overrides", "before", "words"),
    [
        (["run=nowhere"], "", "run=nowhere: there is no such file or folder. Included agents, by name"),
        (["run=nowhere"], "import sys; sys.modules['viser'] = None", "needs the package viser: "),
    ],
    ids=["no such run", "no viser"],
)
def test_a_person_is_told_in_a_paragraph(overrides: list[str], before: str, words: str, tmp_path: Path) -> None:
    if "viser" in words:
        before = before or "pass"
    else:
        pytest.importorskip("viser", reason="needs viser, of the extra dashboard")
    assert words in refused("dashboard", *overrides, cwd=tmp_path, before=before)
    assert not list(tmp_path.iterdir())


# --- the page ---


def test_two_runs_become_one_page(runs: Path) -> None:
    pytest.importorskip("viser", reason="needs viser, of the extra dashboard")
    done = completed("dashboard", "run=runs/a", "against=runs/b", cwd=runs.parent)
    assert "tensorboard --logdir_spec a:runs/a,b:runs/b" in done.stdout
    assert "b, deterministic: no value" in done.stdout and "page: runs/a/dashboard.html" in done.stdout
    text = (runs / "a" / "dashboard.html").read_text(encoding="utf-8")
    flights = json.loads(re.search(r'id="flights">(.*?)</script>', text)[1])["flights"]
    assert [("value" in flight["values"], len(flight["words"])) for flight in flights] == [(True, 61), (False, 21)]
    assert str(runs) not in text, "paths of this machine"


@pytest.mark.slow
def test_an_agent_that_ships_is_flown_and_lacks_its_critic(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="needs viser, of the extra dashboard")
    done = completed("dashboard", "agent=kidney", cwd=tmp_path)
    assert "finished           1 (100%)" in done.stdout and "no value, because the flight has no critic" in done.stdout
    text = (tmp_path / "runs" / "agent_kidney" / "dashboard.html").read_text(encoding="utf-8")
    assert 'data-of="speed"' in text and 'data-of="value"' not in text
    assert len(text) < 10e6
