"""The page of a flight: what it says is what was flown, it holds all it needs, and its panel follows the scrubber."""

from __future__ import annotations

import base64
import io
import json
import re
import socket
import urllib.request
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures import dashboard, scene_3d
from dreamer_racing.figures.dashboard_panel import (
    SHEET_COLUMNS,
    image_sheet,
    missing,
    panel,
    readings,
    row_at,
    state_words,
)
from dreamer_racing.figures.flights import NamedFlight
from tests.chromium import PROGRAM, open_page

CIRCLE = load_track("circle")
LARGEST_PAGE = 10e6  # bytes


def circling(rows: int = 61, control_dt: float = 0.05, seen: bool = True, judged: bool = True) -> Trajectory:
    """A flight around the middle of Circle in 3 s, level; each image is of one colour, which is its row."""
    angle = torch.linspace(0.0, 2.0 * torch.pi, rows)
    zero = torch.zeros_like(angle)
    half_yaw = (angle + torch.pi / 2) / 2
    pixels = torch.arange(rows, dtype=torch.uint8).reshape(-1, 1, 1, 1).expand(-1, 64, 64, 3).contiguous()
    return Trajectory(
        position=torch.stack((4.0 * angle.cos(), 4.0 * angle.sin(), zero + 1.35), dim=1),
        attitude=torch.stack((half_yaw.cos(), zero, zero, half_yaw.sin()), dim=1),
        linear_velocity=torch.stack((-angle.sin(), angle.cos(), zero), dim=1) * (2.0 + angle[:, None]),
        target_gate=(angle / (2.0 * torch.pi) * CIRCLE.num_gates).long() % CIRCLE.num_gates,
        action=torch.stack((angle, -angle, zero, angle / 10), dim=1)[:-1],
        pixels=pixels if seen else None,
        control_dt=control_dt,
        outcome="gate_frame",
        value=10.0 * angle[:-1] if judged else None,
        camera_tilt=25.0 if seen else None,
    )


def shown(*flights: Trajectory) -> list[NamedFlight]:
    return [NamedFlight(f"flight {index}", CIRCLE, flight) for index, flight in enumerate(flights, start=1)]


def check_tags(text: str) -> None:
    """Refuse a tag that is not closed by its own."""
    ElementTree.fromstring(text.replace(" data-time>", ' data-time="">'))


# --- what it says ---


def test_numbers_are_those_of_the_flight_in_si_units():
    flight = circling()
    flight = replace(flight, action=torch.tensor([[-1.0, 0.5, -1.0, 2.0]]).expand(60, 4))  # yaw is clipped, as flown
    said = readings(shown(flight))["flights"][0]
    assert {name: (values[0], len(values)) for name, values in said["values"].items()} == {
        "speed": (2.0, 61), "thrust": (0.0, 60), "roll rate": (5.0, 60), "pitch rate": (-10.0, 60),
        "yaw rate": (4.0, 60), "value": (0.0, 60),
    }  # fmt: skip
    assert said["words"][0] == ["1/3", "1/4", "flying"]
    assert said["words"][-1] == ["2/3", "1/4", "gate frame"]


def test_a_non_finite_state_is_drawn_as_a_gap():
    flight = circling()
    flight.position[-1], flight.linear_velocity[-1] = torch.nan, torch.nan
    assert readings(shown(flight))["flights"][0]["values"]["speed"][-1] is None
    drawn = panel(shown(flight), [])
    assert "nan" not in drawn.lower()


def test_what_was_not_recorded_is_named_and_not_drawn():
    without, judged = circling(seen=False, judged=False), circling()
    assert [line.partition(": ")[2].split(",")[0] for line in missing(shown(without)[0])] == ["no images", "no value"]
    assert not list(missing(shown(judged)[0]))
    alone = panel(shown(without), [])
    assert "no images recorded" in alone and 'data-of="value"' not in alone and 'data-of="speed"' in alone
    both = panel(shown(judged, without), [])
    assert both.count('data-of="value"') == 1 and both.count('data-of="speed"') == 2
    assert "flight 2: no value" in both and "flight 1: no value" not in both


def test_the_cursor_and_the_last_gate_share_one_axis():
    """A flight half as long takes half of the width."""
    both = panel(shown(circling(), circling(control_dt=0.025)), [])
    curves = re.findall(r'<polyline points="([^"]+)" stroke="(#\w+)"', both)
    ends = {color: float(points.split()[-1].partition(",")[0]) for points, color in curves[:2]}
    assert sorted(ends.values()) == [500.0, 1000.0]


def test_the_panel_is_well_formed_and_takes_titles_for_text():
    flights = [NamedFlight("</script><b>&", CIRCLE, circling())]
    drawn = panel(flights, ["run `a <b> c`"])
    check_tags(drawn)
    assert "</script>" not in drawn and "<code>a &lt;b&gt; c</code>" in drawn
    page = dashboard.compose("<html><title>Viser</title><body></body></html>", flights, [])
    assert page.count("</script>") == 2  # those of ours
    with pytest.raises(RuntimeError, match="not the one expected"):  # a viewer that is built otherwise
        dashboard.compose("<html><title>Another</title></body>", flights, [])


def test_an_image_lies_where_the_panel_looks_for_it():
    pixels = circling().pixels.numpy()
    data = base64.b64decode(image_sheet(pixels).partition(",")[2])
    sheet = np.asarray(Image.open(io.BytesIO(data)))
    assert sheet.shape == (3 * 64, SHEET_COLUMNS * 64, 3)
    for row in (0, 24, 25, 60):
        top, left = 64 * (row // SHEET_COLUMNS), 64 * (row % SHEET_COLUMNS)
        assert (sheet[top : top + 64, left : left + 64] == row).all()


def test_flights_of_different_rates_keep_their_own_time():
    fast, slow = circling(61, 0.02), circling(31, 0.05)
    times = dashboard.moments([fast, slow])
    assert len(times) == len({round(time, 9) for time in times}) == 61 + 31 - 13  # each 0.1 s they coincide
    assert times[0] == 0.0 and times[-1] == pytest.approx(1.5)
    for row in range(61):
        assert row_at(fast, row * 0.02) == row and row_at(fast, row * 0.02 - 0.001) == max(row - 1, 0)
    assert row_at(fast, 99.0) == 60 and state_words(shown(fast)[0])[60][2] == "gate frame"


def test_without_viser_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(scene_3d.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install .*\[dashboard\]"):
        dashboard.write_page(tmp_path / "page.html", shown(circling()))
    assert not list(tmp_path.iterdir())


# --- the file ---


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of two flights of different rates, one of them without a critic."""
    pytest.importorskip("viser", reason="needs viser, of the extra dashboard")
    path = tmp_path_factory.mktemp("new") / "deeper" / "page.html"
    flights = shown(circling(), circling(21, 0.1, judged=False))
    size = dashboard.write_page(path, flights, ["Training curves: `tensorboard --logdir runs/a`"])
    assert path.stat().st_size == size and [file.name for file in path.parent.iterdir()] == ["page.html"]
    return path


def test_the_page_is_one_file_of_bearable_size(page: Path):
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < LARGEST_PAGE
    assert "<title>circle: flight 1 against flight 2</title>" in text
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", text.partition("<script data-p")[0])
    data = text.partition('id="flights">')[2].partition("</script>")[0]
    assert [len(flight["words"]) for flight in json.loads(data)["flights"]] == [61, 21]
    assert "<code>tensorboard --logdir runs/a</code>" in text


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on the PATH to open the page with")
def test_the_panel_follows_the_scrubber_in_a_browser(page: Path):
    text = "document.querySelector('{}')?.textContent"
    with open_page(f"{page.as_uri()}#t=1.5") as browser:
        settled = "document.querySelector('.dashboard')?.ariaBusy === 'false' && "  # the viewer stands still there
        browser.wait_for(f"{settled}{text.format('.dashboard [data-time]')} === '1.50 s'")  # the address names it
        slider = browser.evaluate("Number(document.querySelector('#root [role=slider]').ariaValueNow)")
        assert slider == pytest.approx(1.5, abs=0.001)
        style = "getComputedStyle(document.querySelector('{}')).getPropertyValue('{}')"
        assert float(browser.evaluate(style.format(".dashboard", "--now"))) == pytest.approx(0.5, abs=0.001)
        for view, shown_row in ((".view-0", 30), (".view-1", 15)):
            column, row = (int(browser.evaluate(style.format(view, name))) for name in ("--column", "--row"))
            assert column + SHEET_COLUMNS * row == shown_row
        values = browser.evaluate("[...document.querySelectorAll('[data-of=value]')].map(cell => cell.textContent)")
        assert [float(value) for value in values] == [pytest.approx(10 * np.pi, abs=0.01)]
        browser.press(".")  # one step on
        browser.wait_for(f"{settled}{text.format('.dashboard [data-time]')} === '1.55 s'")
        picture = np.asarray(browser.screenshot())
        assert not browser.errors
        assert [address for address in browser.requests if not address.startswith(("file:", "data:", "blob:"))] == []
    race = picture[100:500, 200:460].reshape(-1, 3).astype(int)  # beside the note on software rendering
    orange = (race[:, 0] > 150) & (race[:, 0] > race[:, 2] + 80)
    assert orange.mean() > 0.002, "no gate is to be seen"
    assert len(np.unique(race, axis=0)) > 50


# --- live ---


def test_the_live_page_is_served_to_this_machine_alone():
    pytest.importorskip("viser", reason="needs viser, of the extra dashboard")
    addresses: list[str] = []
    rounds = iter((True, True, False))
    flights = shown(circling(), circling(21, 0.1))

    def goes_on() -> bool:
        if len(addresses) == 1:
            assert b"<title>Viser</title>" in urllib.request.urlopen(addresses[0]).read()
            port = int(addresses[0].rpartition(":")[2])
            with socket.socket() as other, pytest.raises(OSError, match=r".*"):
                other.connect((own_address(), port))
            addresses.append("asked")
        return next(rounds)

    dashboard.serve(flights, 0, announce=addresses.append, goes_on=goes_on)
    assert addresses[0].startswith("http://127.0.0.1:") and addresses[1:] == ["asked"]


def own_address() -> str:
    """An address of this machine that others may have for it; another one of the loopback's, if it has none."""
    found = socket.gethostbyname(socket.gethostname())
    return "127.0.0.2" if found.startswith("127.0.0.1") else found


def test_the_live_page_says_the_same():
    flights = shown(circling(), circling(21, 0.1, judged=False))
    table = dashboard.number_table(flights, [30, 20])
    check_tags(table)
    cells = re.findall(r"<tr><th>([^<]*)</th><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td></tr>", table)
    said = {name: values for name, *values in cells}
    assert said["lap"] == ["1/3", "2/3"] and said[""] == ["flying", "gate frame"]
    assert said["value"] == [f"{10 * np.pi:.2f} expected return", "–"]
    assert said["thrust"][1] == "–"  # after the last step there is no action
    style = dashboard.positions([30, 20], 0.5)
    assert "--now: 0.5000" in style and ".view-0 { --column: 5 !important; --row: 1 !important }" in style
