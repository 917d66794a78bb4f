"""`recipes/plot.py` as a user runs it: figures from stored files, and plain refusals."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from dreamer_racing.curves import read_curves
from dreamer_racing.flights import write_trajectory
from tests.test_curves import write_run
from tests.test_figures import flat_dream, random_flight

RECIPE = Path(__file__).parents[1] / "recipes" / "plot.py"


def plot(*overrides: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(RECIPE), *overrides]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=240, check=False)


@pytest.fixture(scope="module")
def recipe() -> ModuleType:
    """The recipe as a module."""
    sys.path.insert(0, str(RECIPE.parent))
    try:
        return importlib.import_module("plot")
    finally:
        sys.path.pop(0)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for seed in range(2):
        run = write_run(tmp_path / "runs", f"dreamer_v3_circle_paper_seed{seed}", seed=seed)
        for env_steps, gates in ((1000, 3), (2000, 1)):
            stem = run / "evaluations" / f"{env_steps:09d}"
            write_trajectory(f"{stem}_trajectory.csv", random_flight(), "circle")
            flat_dream().save(f"{stem}_dream.npz")
            Path(f"{stem}.json").write_text(json.dumps({"gates_per_episode": gates, "return_mean": 0.0}))
    return tmp_path


def test_all_figures_and_the_curves_again_from_their_csv(runs):
    (write_run(runs / "runs", "ppo_circle_paper_seed0", algorithm="ppo") / "metrics.csv").write_text("")
    done = plot("aggregate=iqm", "quantities=[return,success_rate]", "flight=best", cwd=runs)
    assert done.returncode == 0, done.stderr
    made = {path.name for path in (runs / "figures").iterdir()}
    dream = "imagined_dreamer_v3_circle_paper_seed0"
    assert made == {
        "learning_curves.png", "learning_curves.csv", "trajectories.png", f"{dream}.png", f"{dream}.mp4", f"{dream}.gif"
    }  # fmt: skip
    assert "warning: ppo_circle_paper_seed0 left out: metrics.csv has no rows" in done.stdout
    curves = read_curves(runs / "figures" / "learning_curves.csv")
    assert curves.aggregate == "iqm" and [curve.quantity for curve in curves.curves] == ["return", "success_rate"]
    done = plot("runs=figures/learning_curves.csv", "output=again", cwd=runs)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in (runs / "again").iterdir()] == ["learning_curves.png"]


def test_flights_and_dreams_by_name_need_no_runs(runs, recipe):
    folder, output = runs / "runs" / "dreamer_v3_circle_paper_seed1" / "evaluations", runs / "figures"
    flights, dreams = [str(folder / "000001000_trajectory.csv")], [str(folder / "000002000_dream.npz")]
    for figure in ("trajectories", "imagined"):
        options = {"flights": flights, "dreams": dreams, "output": str(output), "runs": "nowhere"}
        recipe.draw(recipe.PlotConfig(figure=figure, **options))
    assert {path.name for path in output.iterdir()} == {
        "trajectories.png", "imagined.png", "imagined.mp4", "imagined.gif"
    }  # fmt: skip


@pytest.mark.parametrize(("which", "expected"), [("best", 1000), ("last", 2000)])
def test_last_and_best_flight(runs, recipe, which, expected):
    read, _ = recipe.read_runs(recipe.find_runs([runs / "runs"]))
    (file,) = recipe.chosen_flights(read, which)
    assert file == runs / "runs" / "dreamer_v3_circle_paper_seed0" / "evaluations" / f"{expected:09d}_trajectory.csv"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"figure": "violins"}, "figure=violins: there are learning_curves"),
        ({"quantities": ["speed"]}, "quantities=speed: there are return"),
        ({"runs": "nowhere"}, "runs=nowhere: there is no run directory"),
        ({"flight": "worst", "figure": "trajectories"}, "flight=worst: there are last and best"),
    ],
)
def test_bad_settings_are_refused(runs, recipe, settings, words):
    given = {"runs": str(runs / "runs"), "output": str(runs / "figures")} | settings
    with pytest.raises(ValueError, match=words):
        recipe.draw(recipe.PlotConfig(**given))


def test_mixed_configurations_are_refused(runs):
    write_run(runs / "runs", "dreamer_v3_circle_paper_seed2", seed=2, env={"preset": "faithful"})
    done = plot(cwd=runs)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "env.preset: easy and faithful" in done.stderr
