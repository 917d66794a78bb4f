"""The picture of a study, and the study itself on one flight."""

from __future__ import annotations

import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from PIL import Image

from dreamer_racing.figures import sim_to_real
from dreamer_racing.figures.sim_to_real import COLORS, LABELS, plot_study
from dreamer_racing.plant.study import SWEEPS


def result(actor: str, flights: list[dict]) -> dict:
    return {"provenance": {"actor": actor, "track": "circle", "preset": "easy", "flights": 2}, "flights": flights}


def flight(sweep: str, value: float, lap_time: float | None) -> dict:
    return {"sweep": sweep, "value": value, "finished": lap_time is not None, "lap_time": lap_time}


def test_every_sweep_has_a_label():
    assert LABELS.keys() == SWEEPS.keys()


def test_studies_are_drawn_over_each_other(tmp_path):
    pilot = result("pilot", [flight("mass", 0.9, 4.0), flight("mass", 1.1, None), flight("delay", 0.02, 4.2)])
    plot_study([pilot, result("circle", [flight("mass", 1.0, 3.3)])], tmp_path / "study.png")
    width, height = Image.open(tmp_path / "study.png").size
    assert width > height > 300


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """What is drawn, instead of files."""
    figures: list[Figure] = []
    monkeypatch.setattr(sim_to_real, "save", lambda figure, path: figures.append(figure))
    return figures


def test_every_point_has_its_interval_and_its_number(drawn):
    flights = [flight("mass", 0.9, 4.0), flight("mass", 0.9, None), flight("mass", 1.1, None)]
    plot_study([result("circle", flights)], "study.png")
    success, laps = drawn[0].axes
    (share,) = (bars for bars in success.containers if isinstance(bars, ErrorbarContainer))
    assert share.lines[0].get_ydata().tolist() == [0.5, 0.0]
    half, never = (segment[:, 1].tolist() for segment in share.lines[2][0].get_segments())
    assert half == pytest.approx([0.0945, 0.9055], abs=1e-3)  # Wilson's, by hand: 1 of 2 (0.5 ± 0.4055)
    assert never == pytest.approx([0.0, 0.7935], abs=1e-3)  # 0 of 1: z² / (1 + z²)
    assert [text.get_text() for text in success.texts] == ["2", "1"]
    assert [text.get_text() for text in laps.texts] == ["1"]
    assert [tick.get_text() for tick in laps.get_xticklabels()] == ["0.9", "1.1"]


def test_studies_at_one_value_lie_beside_each_other(drawn):
    plot_study([result("pilot", [flight("delay", 0.0, 4.0)]), result("circle", [flight("delay", 0.0, 3.0)])], "_.png")
    places = [bars.lines[0].get_xdata()[0] for bars in drawn[0].axes[0].containers]
    assert places[0] < 0.0 < places[1] and places[0] == -places[1]


def test_where_no_lap_was_flown_the_axis_is_not_negative(drawn):
    plot_study([result("circle", [flight("delay", 0.0, None)])], "study.png")
    success, laps = drawn[0].axes
    assert laps.get_ylim()[0] == 0.0 and [text.get_text() for text in laps.texts] == ["no lap"]
    assert success.get_xlim()[0] < 0.0 < success.get_xlim()[1]  # places, not milliseconds
    assert [tick.get_text() for tick in laps.get_xticklabels()] == ["0"]


def test_no_study_is_left_out_in_silence():
    studies = [result(str(number), [flight("mass", 1.0, 4.0)]) for number in range(len(COLORS) + 1)]
    with pytest.raises(ValueError, match="5 studies: no more than 4"):
        plot_study(studies, "study.png")


def test_nothing_flown_is_said(tmp_path):
    with pytest.raises(ValueError, match="hold no flight"):
        plot_study([result("pilot", [])], tmp_path / "study.png")
