"""`recipes/plot.py` as a user runs it: figures from stored files, and plain refusals."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from dreamer_racing.evaluation.trajectory import write_trajectory
from dreamer_racing.figures import plotting
from dreamer_racing.figures.curves import read_curves
from tests.figures.test_curves import write_run
from tests.flights import flat_dream, random_flight
from tests.running_recipes import ROOT, completed, recipe, recipe_module, refused

pytestmark = pytest.mark.xdist_group("figures")  # one worker makes what these tests share

plot = partial(completed, "plot")


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


def draw(folder: Path, **settings: Any) -> Path:
    """Draw figures of a folder's runs, unless of others; return where they are."""
    config = plotting.PlotConfig(**{"runs": str(folder / "runs"), "output": str(folder / "figures")} | settings)
    plotting.draw(config)
    return folder / "figures"


def test_all_figures_and_the_curves_again_from_their_csv(runs):
    (write_run(runs / "runs", "ppo_circle_paper_seed0", algorithm="ppo") / "metrics.csv").write_text("")
    done = plot("aggregate=iqm", "quantities=[return,success_rate]", "flight=best", cwd=runs)
    made = {path.name for path in (runs / "figures").iterdir()}
    dream = "imagined_dreamer_v3_circle_paper_seed0"
    assert made == {
        "learning_curves.png", "learning_curves.csv", "learning_curves_left_out.txt", "trajectories.png",
        f"{dream}.png", f"{dream}.mp4", f"{dream}.gif",
    }  # fmt: skip
    assert "warning: ppo_circle_paper_seed0 left out: metrics.csv has no rows" in done.stdout
    curves = read_curves(runs / "figures" / "learning_curves.csv")
    assert curves.aggregate == "iqm" and [curve.quantity for curve in curves.curves] == ["return", "success_rate"]
    plot("runs=figures/learning_curves.csv", "output=again", cwd=runs)
    made = {path.name for path in (runs / "again").iterdir()}
    assert made == {"learning_curves.png", "learning_curves_left_out.txt"}
    plot("runs=figures", "output=once_more", cwd=runs)
    assert (runs / "once_more" / "learning_curves.png").is_file()
    said = refused("plot", "runs=figures/learning_curves.csv", "figure=comparison", "quantities=[gates]", cwd=runs)
    assert "quantities=, figure=: runs=figures/learning_curves.csv is a file" in said


def test_flights_and_dreams_by_name_need_no_runs(runs):
    folder = runs / "runs" / "dreamer_v3_circle_paper_seed1" / "evaluations"
    flights, dreams = [str(folder / "000001000_trajectory.csv")], [str(folder / "000002000_dream.npz")]
    for figure in ("trajectories", "imagined"):
        output = draw(runs, figure=figure, flights=flights, dreams=dreams, runs="nowhere")
    assert {path.name for path in output.iterdir()} == {
        "trajectories.png", "imagined.png", "imagined.mp4", "imagined.gif"
    }  # fmt: skip


def test_a_single_flight_and_what_an_evaluation_after_training_left_are_drawn(runs):
    evaluations = runs / "runs" / "dreamer_v3_circle_paper_seed0" / "evaluations"
    plot(f"flights={evaluations}/000001000_trajectory.csv", "figure=trajectories", "output=one", cwd=runs)
    assert (runs / "one" / "trajectories.png").is_file()
    (runs / "elsewhere").mkdir()
    plot(f"flights={evaluations}/000001000_trajectory.csv", cwd=runs / "elsewhere")
    assert {path.name for path in (runs / "elsewhere" / "figures").iterdir()} == {"trajectories.png"}
    after = evaluations.parent / "evaluation"
    after.mkdir()
    evaluations.rename(after / "evaluations")
    for file in (after / "evaluations").glob("000001000*"):
        file.rename(file.with_name(file.name.replace("000001000", "deterministic")))
    done = recipe("plot", f"runs={after.parent}", "output=after", "quantities=gates", cwd=runs)
    made = {path.name for path in (runs / "after").iterdir()}
    assert {"trajectories.png", "imagined_dreamer_v3_circle_paper_seed0.png"} <= made, done.stderr


@pytest.mark.parametrize(("which", "expected"), [("best", "1,000"), ("last", "2,000")])
def test_last_and_best_flight(runs, which, expected):
    read, _ = plotting.read_runs(plotting.find_runs([runs / "runs"]))
    problems: list[str] = []
    (flight,) = plotting.chosen_flights(read, which, problems)
    assert flight.title == f"dreamer_v3_circle_paper_seed0, {expected} env_steps" and problems == []


def cut(path: Path) -> str:
    """Leave the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return str(path)


@pytest.mark.parametrize("which", ["best", "last"])
def test_instead_of_half_a_flight_the_next_one_is_drawn(runs, figures, caplog, which):
    folder = runs / "runs" / "dreamer_v3_circle_paper_seed0" / "evaluations"
    chosen, other = ("1", "2") if which == "best" else ("2", "1")
    cut(folder / f"00000{chosen}000_trajectory.csv")
    output = draw(runs, figure="trajectories", flight=which)
    assert f"{other},000 env_steps" in figures[0].axes[0].get_title(loc="left")
    file = f"00000{chosen}000_trajectory.csv"
    warning = f"dreamer_v3_circle_paper_seed0 without {file}: {file} was"
    assert warning in caplog.text
    assert (output / "trajectories_left_out.txt").read_text().startswith(warning)


def test_instead_of_half_a_dream_the_one_before_it_is_shown(runs):
    folder = runs / "runs" / "dreamer_v3_circle_paper_seed0" / "evaluations"
    for env_steps in (3000, 4000, 5000):
        flat_dream().save(folder / f"{env_steps:09d}_dream.npz")

    def shown() -> tuple[list[str], list[str]]:
        ((run, _), _) = plotting.read_runs(plotting.find_runs([runs / "runs"]))
        stages, problems = plotting.stages_of_training(run)
        return [file.name[5:9] for file in stages], problems

    assert shown() == (["1000", "3000", "5000"], [])
    later = folder.parent / "evaluation" / "evaluations"  # by `recipes/evaluate.py`, which is no stage of training
    later.mkdir(parents=True)
    flat_dream().save(later / "deterministic_dream.npz")
    assert shown() == (["1000", "3000", "5000"], [])
    cut(folder / "000003000_dream.npz")
    cut(folder / "000005000_dream.npz")
    names, problems = shown()
    assert names == ["1000", "2000", "4000"]
    assert [problem.partition(":")[0].split()[-1] for problem in problems] == [
        "000003000_dream.npz", "000005000_dream.npz"
    ]  # fmt: skip
    cut(folder / "000001000_dream.npz")  # nothing is older: the one after it
    assert shown()[0] == ["2000", "4000"]


def test_nothing_but_half_files_costs_no_other_figure(runs, caplog):
    caplog.set_level("INFO", "dreamer_racing")
    for path in (runs / "runs").rglob("*_dream.npz"):
        cut(path)
    for path in (runs / "runs").rglob("*_trajectory.csv"):
        cut(path)
    assert {path.name for path in draw(runs).iterdir()} == {"learning_curves.png", "learning_curves.csv"}
    out = caplog.text
    assert "paper_seed0 without 000002000_trajectory.csv and 1 other: 000002000_trajectory.csv was cut short" in out
    assert "paper_seed0 without 000002000_dream.npz and 1 other: 000002000_dream.npz holds no dream" in out


@pytest.mark.parametrize(("figure", "option"), [("trajectories", "flights"), ("imagined", "dreams")])
def test_half_a_file_that_the_user_named_is_refused(runs, figure, option):
    ending = {"flights": "trajectory.csv", "dreams": "dream.npz"}[option]
    file = cut(runs / "runs" / "dreamer_v3_circle_paper_seed0" / "evaluations" / f"000002000_{ending}")
    with pytest.raises(ValueError, match=f"{ending}"):
        draw(runs, figure=figure, **{option: [file]})


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"figure": "violins"}, "figure=violins: must be one of learning_curves"),
        ({"quantities": ["speed"]}, "quantities=speed: must be one of return"),
        ({"runs": "nowhere"}, "runs=nowhere: there is no run directory"),
        ({"flight": "worst"}, "flight=worst: must be one of last, best"),
        ({"over": "height"}, "over=height: must be one of distance, time"),
    ],
)
def test_bad_settings_are_refused(runs, settings, words):
    with pytest.raises(ValueError, match=words):
        draw(runs, **settings)


@pytest.mark.parametrize("setting", ["flights", "dreams"])
@pytest.mark.parametrize("figure", ["all", "learning_curves", "trajectories"])
def test_a_named_file_that_is_not_there_is_refused_for_any_figure(setting, figure, runs):
    with pytest.raises(ValueError, match=f"{setting}=nowhere.npz: there is no such file"):
        draw(runs, figure=figure, **{setting: ["nowhere.npz"]})
    assert not (runs / "figures").exists()


def test_one_variant_is_not_compared(runs):
    with pytest.raises(ValueError, match="figure=comparison: these runs have only one variant; runs= takes several"):
        draw(runs, figure="comparison", runs=str(runs / "runs" / "dreamer_v3_circle_paper_seed0"))


def test_an_ordinary_folder_of_runs_is_drawn_as_curves_named_by_what_differs(runs, figures):
    """As `runs/` is after a few days: names with a date, settings tried out, and a seed flown twice."""
    for name, overrides in (("101-120000", []), ("102-120000", ["env.preset=faithful"]), ("103-120000", [])):
        preset = "faithful" if overrides else "easy"
        run = write_run(runs / "ordinary", f"dreamer_v3_circle_20260{name}", env={"preset": preset})
        (run / "overrides.yaml").write_text(json.dumps(["track=circle", *overrides]))
    made = {path.name for path in draw(runs, runs=str(runs / "ordinary")).iterdir()}
    assert made >= {"learning_curves.png", "comparison.png", "learning_curves_left_out.txt"}
    (legend,) = [child for child in figures[0].axes[-1].get_children() if hasattr(child, "get_texts")]
    assert [text.get_text() for text in legend.get_texts()] == [
        "DreamerV3 (1 seed)", "DreamerV3, env.preset=faithful (1 seed)"
    ]  # fmt: skip
    left_out = (runs / "figures" / "learning_curves_left_out.txt").read_text()
    assert left_out.startswith("dreamer_v3_circle_20260101-120000 left out: same settings and seed as ")


def test_all_figures_refuse_if_none_can_be_drawn(tmp_path):
    write_run(tmp_path, "dreamer_v3_circle_seed0", returns=[float("nan")])
    with pytest.raises(ValueError, match=r"nothing could be drawn.*=learning_curves: no run has values of return"):
        draw(tmp_path, runs=str(tmp_path))


def test_a_defect_costs_no_other_figure_and_is_no_secret(runs, monkeypatch):
    def broken(*_: object) -> None:
        raise TypeError("not a figure")

    monkeypatch.setitem(plotting.FIGURES, "learning_curves", plotting.Entry(broken, lambda config: ()))
    with pytest.raises(TypeError, match="not a figure"):
        draw(runs)
    assert (runs / "figures" / "trajectories.png").exists()


def test_a_figure_finds_the_columns_that_its_entry_names(runs, monkeypatch):
    found = []

    def draw_new(config, output: Path, read: list, problems: list[str]):
        found.extend(sorted(read[0].metrics.columns))
        return ["new.png"], []

    monkeypatch.setitem(plotting.FIGURES, "new", plotting.Entry(draw_new, lambda config: ["evaluation/success_rate"]))
    draw(runs, figure="new")
    assert found == ["evaluation/success_rate"]


def test_figures_are_named_where_one_chooses_them():
    page, options = ((ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("figures.md", "options.md"))
    (meaning,) = re.findall(r"^\| `figure=` .*$", options, re.M)
    for name in (*plotting.FIGURES, "all"):
        assert f"\n| `{name}` |" in page and re.search(rf"\b{name}\b", meaning), name


def test_figures_of_an_experiment_do_not_depend_on_each_other(runs):
    write_run(runs / "runs", "dreamer_v3_circle_paper_seed2", seed=2, env={"preset": "faithful"})
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(runs / "runs")}}})
    recipe_module("composing.callbacks").DrawFigures().on_multirun_end(config)
    assert (runs / "runs" / "figures" / "trajectories.png").exists()


def test_a_comparison_names_what_was_left_out(runs, figures):
    write_run(runs / "runs", "dreamer_v3_circle_seed0", returns=[1.0] * 40)
    output = draw(runs, figure="comparison")
    warning = "dreamer_v3_circle_paper_seed0 ends at 2,000 env_steps, but 32,000 to 40,000 are compared: left out"
    assert f"- {warning}\n" in (output / "comparison.md").read_text()
    assert warning in (output / "comparison_left_out.txt").read_text()
