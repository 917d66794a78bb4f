"""Comparisons: of variants, and of simulated with real flights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer

from dreamer_racing.figures.comparison import compare_variants, comparison_table
from dreamer_racing.figures.runs import RunData
from dreamer_racing.figures.sim_to_real import COLORS, LABELS, plot_study
from dreamer_racing.plant.study import SWEEPS
from dreamer_racing.training.metrics import MetricsTable

NAMES = {"gates": "evaluation/gates_per_episode", "clock": "wall_clock", "cpu": "cpu_clock"}


def make_run(variant: str, seed: int, every: int = 100, **columns: list[float]) -> RunData:
    """A run with rows at 100, 200 ... env_steps; NaN where a cell is empty."""
    count = max(map(len, columns.values()))
    steps = every * np.arange(1.0, count + 1)
    values = {NAMES.get(name, name): np.array(column) for name, column in columns.items()}
    filled = {name: (steps[np.isfinite(column)], column[np.isfinite(column)]) for name, column in values.items()}
    directory = Path(f"runs/ablation/dreamer_v3_circle_{variant}_seed{seed}")
    config = {"track": "circle", "seed": seed, "algorithm": "dreamer_v3"}
    return RunData(directory, config, MetricsTable(filled, steps, []))


RUNS = [
    make_run("late", 0, gates=[0.0] * 10, clock=[30.0] * 9 + [60.0]),
    make_run("default", 0, gates=[9.0] * 7 + [1.0, 2.0, 3.0]),  # the last fifth: from 800 env_steps on
    make_run("default", 1, gates=[0.0] * 7 + [4.0, 4.0, 4.0]),
]


def test_the_last_fifth_of_every_seed_counts_once() -> None:
    reference, late = compare_variants(RUNS).results
    assert reference.name == "default" and late.name == "late"
    assert reference.values["gates"].tolist() == [2.0, 4.0]
    assert reference.window == (800, 1000) and reference.wall_clock is None and late.wall_clock == 60.0


def test_variants_are_compared_over_the_same_env_steps() -> None:
    """Half a run is at its own end what the others were at half their length."""
    rising = [float(value) for value in range(1, 11)]
    runs = [
        make_run("default", 0, gates=rising),
        make_run("default", 1, gates=rising[:5]),  # ends before 800
        make_run("killed", 0, gates=rising[:9]),  # ends within
        make_run("young", 0, gates=rising[:3]),
    ]
    comparison = compare_variants(runs, ["gone left out: it has no metrics.csv"])
    default, killed, young = comparison.results
    assert default.seeds == 1 and default.values["gates"].tolist() == [9.0]
    assert killed.values["gates"].tolist() == [8.5]
    assert young.seeds == 0 and young.values == {} and young.window == (800, 1000)
    name = "dreamer_v3_circle"
    assert comparison.problems == [
        "gone left out: it has no metrics.csv",
        f"{name}_default_seed1 ends at 500 env_steps, but 800 to 1,000 are compared: left out",
        f"{name}_killed_seed0 ends at 900 env_steps, but 800 to 1,000 are compared: used up to its end",
        f"{name}_young_seed0 ends at 300 env_steps, but 800 to 1,000 are compared: left out",
    ]


def test_the_return_is_that_of_evaluations() -> None:
    """Training pays every variant by its own b₂."""
    run = make_run("default", 0, **{"episode/return": [900.0] * 10, "evaluation/return_mean": [5.0] * 10})
    (result,) = compare_variants([run]).results
    assert {name: values.tolist() for name, values in result.values.items()} == {"evaluation_return": [5.0]}


def test_the_table_has_a_row_a_variant_and_no_column_without_values_and_says_what_is_missing() -> None:
    comparison = compare_variants(RUNS)
    head, _, reference, late, empty, caption = comparison_table(comparison).strip().split("\n")
    columns = ["algorithm", "track", "variant", "seeds", "env_steps", "Gates per episode (deterministic)", "wall clock"]
    assert head == f"| {' | '.join(columns)} |"
    assert reference == "| dreamer_v3 | circle | default | 2 | 800–1,000 | 3 ± 1.41 |  |"
    assert late == "| dreamer_v3 | circle | late | 1 | 800–1,000 | 0 | 1.0 min |"
    assert empty == "" and caption == comparison.caption and "b₂ = 0" in caption
    early = [5.0] * 5 + [float("nan")] * 5  # no evaluation in the last fifth
    unseen = make_run("default", 2, gates=early, clock=[60.0] * 10)
    lines = comparison_table(compare_variants([*RUNS, unseen], ["late left out"])).split("\n")
    assert "| default | 3 | 800–1,000 | 3 ± 1.41 (n = 2) | 1.0 min |" in lines[2]
    assert lines[-2] == "- late left out"


def test_variants_are_compared_at_equal_cpu_time() -> None:
    """The slow one makes as many env_steps in twice the time: of its gates those up to the other's end count."""
    rising = [float(value) for value in range(1, 11)]
    fast = make_run("default", 0, gates=rising, cpu=[360.0 * value for value in rising])
    slow = make_run("slow", 0, gates=rising, cpu=[720.0 * value for value in rising])
    untimed = make_run("old", 0, gates=rising)
    comparison = compare_variants([fast, slow, untimed], axis="core_hours")
    default, late = comparison.results
    assert default.window == late.window == (pytest.approx(0.8), 1.0)
    assert default.values["gates"].tolist() == [9.0]  # of 0.8, 0.9 and 1 hours
    assert late.values["gates"].tolist() == [4.5]  # of 0.8 and 1 hours
    assert comparison.problems == [
        f"{untimed.name} left out: it has no cpu_clock, which axis=core_hours needs",
        "dreamer_v3 circle: compared up to 1.00 core_hours, where the shortest variant ends, of 2.00",
    ]
    table = comparison_table(comparison)
    assert "| seeds | core_hours |" in table and "| 0.80–1.00 |" in table and "core_hours that every variant" in table


def test_nothing_to_compare_is_refused() -> None:
    with pytest.raises(ValueError, match="no run to compare"):
        compare_variants([])
    with pytest.raises(ValueError, match="axis=minutes: must be one of"):
        compare_variants(RUNS, axis="minutes")


# The picture of a study, and the study itself on one flight.


def result(actor: str, flights: list[dict]) -> dict:
    return {"provenance": {"actor": actor, "track": "circle", "preset": "easy", "flights": 2}, "flights": flights}


def flight(sweep: str, value: float, lap_time: float | None) -> dict:
    return {"sweep": sweep, "value": value, "finished": lap_time is not None, "lap_time": lap_time}


def test_every_sweep_has_a_label():
    assert LABELS.keys() == SWEEPS.keys()


def test_every_point_has_its_interval_and_its_number(tmp_path, figures):
    flights = [flight("mass", 0.9, 4.0), flight("mass", 0.9, None), flight("mass", 1.1, None)]
    plot_study([result("circle", flights)], tmp_path / "study.png")
    assert (tmp_path / "study.png").is_file()
    success, laps = figures[0].axes
    (share,) = (bars for bars in success.containers if isinstance(bars, ErrorbarContainer))
    assert share.lines[0].get_ydata().tolist() == [0.5, 0.0]
    half, never = (segment[:, 1].tolist() for segment in share.lines[2][0].get_segments())
    assert half == pytest.approx([0.0945, 0.9055], abs=1e-3)  # Wilson's, by hand: 1 of 2 (0.5 ± 0.4055)
    assert never == pytest.approx([0.0, 0.7935], abs=1e-3)  # 0 of 1: z² / (1 + z²)
    assert [text.get_text() for text in success.texts] == ["2", "1"]
    assert [text.get_text() for text in laps.texts] == ["1"]
    assert [tick.get_text() for tick in laps.get_xticklabels()] == ["0.9", "1.1"]


def test_studies_at_one_value_lie_beside_each_other_and_without_a_lap_the_axis_is_not_negative(tmp_path, figures):
    plot_study([result(actor, [flight("delay", 0.0, None)]) for actor in ("pilot", "circle")], tmp_path / "study.png")
    success, laps = figures[0].axes
    places = [bars.lines[0].get_xdata()[0] for bars in success.containers]
    assert places[0] < 0.0 < places[1] and places[0] == -places[1]
    assert laps.get_ylim()[0] == 0.0 and [text.get_text() for text in laps.texts] == ["no lap"]
    assert success.get_xlim()[0] < 0.0 < success.get_xlim()[1]  # places, not milliseconds
    assert [tick.get_text() for tick in laps.get_xticklabels()] == ["0"]


def test_too_many_studies_and_those_without_flights_are_refused():
    studies = [result(str(number), [flight("mass", 1.0, 4.0)]) for number in range(len(COLORS) + 1)]
    with pytest.raises(ValueError, match="5 studies: at most 4"):
        plot_study(studies, "study.png")
    with pytest.raises(ValueError, match="hold no flight"):
        plot_study([result("pilot", [])], "study.png")
