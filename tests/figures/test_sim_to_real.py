"""The picture of a study, and the study itself on one flight."""

from __future__ import annotations

import pytest
from PIL import Image

from dreamer_racing.figures.sim_to_real import LABELS, plot_study
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


def test_nothing_flown_is_said(tmp_path):
    with pytest.raises(ValueError, match="hold no flight"):
        plot_study([result("pilot", [])], tmp_path / "study.png")
