"""Figures of evaluations: stored flights and dreams come back exactly, and what is drawn is what was stored."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from dreamer_racing.envs.tracks import Gate, load_track
from dreamer_racing.evaluation.dreams import PREDICTED_FRAMES, SEEN_FRAMES, STRIDE, Dream, record_dream
from dreamer_racing.evaluation.trajectory import (
    Trajectory,
    read_flight,
    read_trajectory,
    write_flight,
    write_trajectory,
)
from dreamer_racing.figures.drawing import (
    CRASH_COLOR,
    GATE_COLOR,
    MISSED_COLOR,
    Crossing,
    crossings,
    draw_altitude,
    profile_axis,
    speed_scale,
)
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR, dream_video, film_strip, shown_frames
from dreamer_racing.figures.flights import NamedFlight, plot_dreams, plot_flights
from tests.flights import flat_dream, level_flight, random_flight

# --- stored flights ---


EDITED = replace(load_track("circle"), name="kidney", laps=2)  # called as another, as an edited copy may be


@pytest.mark.parametrize(
    ("outcome", "course"),
    [("ground", "figure8_decoys"), ("finished", EDITED), (None, "split_s")],
    ids=["crashed", "of an edited track", "cut off"],
)
def test_a_flight_comes_back_exactly(tmp_path, outcome, course):
    before = random_flight(outcome=outcome)
    before.position[-1] = math.nan
    before.linear_velocity[-1, 0] = math.inf
    write_trajectory(tmp_path / "new" / "flight.csv", before, course)
    after, track = read_trajectory(tmp_path / "new" / "flight.csv")
    assert track == load_track(course)
    assert (after.control_dt, after.outcome, after.pixels) == (0.02, outcome, None)
    for name in ("position", "attitude", "linear_velocity", "target_gate", "action"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=0, atol=0, equal_nan=True)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["flight.csv"]


def test_value_and_images_come_back_with_the_flight(tmp_path):
    before = random_flight(pixels=True)
    before = replace(before, value=torch.randn(60), camera_tilt=12.5)
    assert write_flight(tmp_path / "one", before, "circle") == ["one_trajectory.csv", "one_onboard.npz"]
    after, track = read_flight(tmp_path / "one_trajectory.csv")
    assert (track.name, after.camera_tilt, after.outcome) == ("circle", 12.5, "ground")
    for name in ("action", "value", "pixels"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name
    assert read_trajectory(tmp_path / "one_trajectory.csv")[0].pixels is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one_onboard.npz", "one_trajectory.csv"]


def test_images_are_never_those_of_another_flight(tmp_path):
    write_flight(tmp_path / "one", random_flight(pixels=True), "circle")
    write_flight(tmp_path / "two", random_flight(steps=20), "circle")
    (tmp_path / "one_onboard.npz").rename(tmp_path / "two_onboard.npz")
    with pytest.raises(ValueError, match="two_onboard.npz holds .* has 21 rows: .* from different flights"):
        read_flight(tmp_path / "two_trajectory.csv")
    assert write_flight(tmp_path / "two", random_flight(steps=20), "circle") == ["two_trajectory.csv"]
    assert read_flight(tmp_path / "two_trajectory.csv")[0].pixels is None
    write_flight(tmp_path / "two", random_flight(steps=20, pixels=True), "circle")
    whole = (tmp_path / "two_onboard.npz").read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"no images"):
        (tmp_path / "two_onboard.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match="two_onboard.npz holds no images"):
            read_flight(tmp_path / "two_trajectory.csv")


@pytest.mark.parametrize("cut", [1, 700])
def test_an_incomplete_flight_is_refused(tmp_path, cut):
    path = tmp_path / "flight.csv"
    write_trajectory(path, random_flight(), "circle")
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(ValueError, match=r"flight\.csv was cut short"):
        read_trajectory(path)


def test_another_table_is_no_flight(tmp_path):
    (tmp_path / "metrics.csv").write_text("env_steps,loss\n1,2\n")
    with pytest.raises(ValueError, match="holds no trajectory: its columns should be t, x, y, z"):
        read_trajectory(tmp_path / "metrics.csv")
    (tmp_path / "garbage.csv").write_text('"' + "x" * 200_000)
    with pytest.raises(ValueError, match="holds no trajectory: field larger than"):
        read_trajectory(tmp_path / "garbage.csv")


# --- stored dreams ---


def brighter(batch, context: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pretend that latents are images: seen ones grow by 1, predicted ones are the number of the context."""
    images = batch["pixels"] // 2 + 1
    images[:, context:] = context
    return images, images


DREAMER = SimpleNamespace(open_loop=brighter)


def as_they_are(belief, state, target_gate):
    return belief


def test_a_dream_is_a_flight_reconstructed_and_predicted(tmp_path):
    flight = random_flight(steps=100, pixels=True)
    dream = record_dream(DREAMER, flight, as_they_are)
    assert dream is not None and dream.real.shape == (1, SEEN_FRAMES + PREDICTED_FRAMES, 64, 64, 3)
    assert dream.frame_dt == pytest.approx(0.02 * STRIDE)
    np.testing.assert_array_equal(dream.real[0], flight.pixels[::STRIDE][: SEEN_FRAMES + PREDICTED_FRAMES])
    np.testing.assert_array_equal(dream.reconstructed, dream.real // 2 + 1)
    np.testing.assert_array_equal(dream.imagined[:, :SEEN_FRAMES], dream.reconstructed[:, :SEEN_FRAMES])
    assert (dream.imagined[:, SEEN_FRAMES:] == STRIDE * (SEEN_FRAMES - 1) + 1).all()  # the last one seen is stored
    dream.save(tmp_path / "a_dream.npz")
    again = Dream.load(tmp_path / "a_dream.npz")
    for name in ("real", "reconstructed", "imagined"):
        np.testing.assert_array_equal(getattr(again, name), getattr(dream, name))
    assert (again.context, again.frame_dt, again.from_pose) == (dream.context, dream.frame_dt, False)
    replace(dream, from_pose=True).save(tmp_path / "a_dream.npz")
    assert Dream.load(tmp_path / "a_dream.npz").from_pose


def test_short_flights_and_agents_without_decoder_leave_no_dream():
    assert record_dream(DREAMER, random_flight(steps=SEEN_FRAMES * STRIDE - 1, pixels=True), as_they_are) is None
    shortest = record_dream(DREAMER, random_flight(steps=SEEN_FRAMES * STRIDE, pixels=True), as_they_are)
    assert shortest is not None and shortest.real.shape[1] == SEEN_FRAMES + 1
    assert record_dream(DREAMER, random_flight(pixels=True), None) is None
    assert record_dream(DREAMER, random_flight(), as_they_are) is None


@pytest.mark.parametrize("damage", [lambda data: data[:2000], lambda data: data[:2000] + bytes(99) + data[2099:]])
def test_an_incomplete_dream_is_refused(tmp_path, damage):
    path = tmp_path / "a_dream.npz"
    record_dream(DREAMER, random_flight(pixels=True), as_they_are).save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match="holds no dream, or an incomplete one"):
        Dream.load(path)


def test_film_strip_places_and_colours():
    strip = film_strip(flat_dream(), [2, 3])
    assert strip.shape == (3 * 22, 2 * 22, 3)
    for row, value in enumerate((10, 20, 30)):
        for column in range(2):
            tile = strip[22 * row : 22 * (row + 1), 22 * column : 22 * (column + 1)]
            assert (tile[3:19, 3:19] == value).all()
            border = (255, 255, 255) if row == 0 else OPEN_LOOP_COLOR if row == 2 and column == 1 else CONTEXT_COLOR
            assert (tile[0] == border).all() and (tile[:, -1] == border).all()


def test_shown_frames_are_the_end_of_the_context_and_even_after_it():
    assert shown_frames(flat_dream()) == [1, 2, 3, 6, 9, 12]
    assert shown_frames(flat_dream(frames=4)) == [1, 2, 3]


def test_dreams_of_three_stages(tmp_path, figures):
    plot_dreams([(name, flat_dream()) for name in ("early", "middle", "late")], tmp_path / "imagined.png")
    panels = figures[0].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["early", "middle", "late"]
    labels = [text.get_text() for text in panels[0].get_xticklabels()]
    assert labels[:3] == ["-0.08 s", "+0.00 s", "+0.08 s"] and labels[-1] == "+0.80 s"
    video = dream_video([("early", flat_dream(frames=5)), ("late", flat_dream())])
    assert video.shape == (13, 2 * (15 + 2 * 8 + 8), 2 * (2 * 8 + 8), 3)  # a strip of words above each


# --- figures ---


def test_flights_side_by_side(tmp_path, figures):
    flights = [NamedFlight(name, load_track(name), random_flight()) for name in ("figure8", "figure8_decoys")]
    plot_flights(flights, tmp_path / "flights.png", over="time")
    maps, altitudes, speeds = figures[0].axes[0:6:3], figures[0].axes[1:6:3], figures[0].axes[2:6:3]
    assert [axes.get_title(loc="left").split("\n")[0] for axes in maps] == ["figure8", "figure8_decoys"]
    assert "2 gates in 1.20 s (ground)" in maps[0].get_title(loc="left")
    assert altitudes[0].get_ylabel() == "altitude (m)" and speeds[0].get_ylabel() == "speed (m/s)"
    for axes in (*altitudes, *speeds):
        assert axes.get_xlim() == (0.0, pytest.approx(1.2))
        assert [line.get_color() for line in axes.lines if line.get_marker() == "x"] == [CRASH_COLOR]
    for axes in speeds:
        assert axes.get_xlabel() == "time (s)" and [text.get_text() for text in axes.texts] == ["1", "2"]
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert labels[:6] == ["gate", "decoy", "start", "crash", "camera", "bounding box"]


def test_maps_of_different_halls_have_one_scale_and_stand_in_line(tmp_path, figures):
    flights = [NamedFlight(name, load_track(name), random_flight()) for name in ("circle", "figure8", "kidney")]
    plot_flights(flights, tmp_path / "flights.png")
    for row in range(3):
        boxes = [axes.get_position() for axes in figures[0].axes[row:9:3]]
        for side in ("y0", "y1", "width"):
            assert np.ptp([getattr(box, side) for box in boxes]) < 0.002, (row, side)
    for flight, axes in zip(flights, figures[0].axes[0:9:3], strict=True):
        (left, right), (bottom, top), track = axes.get_xlim(), axes.get_ylim(), flight.track
        assert left < track.bounds_low[0] < track.bounds_high[0] < right
        assert bottom < track.bounds_low[1] < track.bounds_high[1] < top


def straight(height: float, backwards: bool = False) -> Trajectory:
    """Along x from −2 to 2 m in 4 steps at one height; the first gate counts between 0 and 1 m if it does."""
    x, passes = torch.arange(-2.0, 3.0), height == 1.35 and not backwards
    position = torch.stack((-x if backwards else x, 0 * x, 0 * x + height), dim=-1)
    return level_flight(position, target_gate=torch.tensor([0, 0, 0, passes, passes]).long())


def test_altitude_tells_a_gate_passed_from_one_flown_over(figures):
    gates = (Gate((0.25, 0.0, 1.35), 0.0), Gate((0.0, 1.5, 1.35), 0.0))  # the second to the left of the path
    track = replace(load_track("circle"), gates=gates)
    assert crossings(track, straight(1.35)) == [Crossing(2.25, 0, True)]
    assert crossings(track, straight(3.0)) == [Crossing(2.25, 0, False)]
    assert crossings(track, straight(1.35, backwards=True)) == [Crossing(1.75, 0, False)]
    for height, color in ((1.35, GATE_COLOR), (3.0, MISSED_COLOR)):
        axes = Figure().subplots()
        draw_altitude(axes, track, straight(height), speed_scale([straight(height)]))
        beams = [line.get_xydata() for line in axes.lines if line.get_color() == color]
        ends = (track.shape.opening / 2, track.shape.outer / 2)
        expected = [[[2.25, 1.35 + sign * end] for end in ends] for sign in (-1, 1)]
        np.testing.assert_allclose(beams, expected)
        assert axes.get_ylim()[0] == 0.0 and axes.get_ylim()[1] > height


def test_axis_of_the_profiles():
    flight = level_flight(torch.tensor([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]]))
    np.testing.assert_allclose(profile_axis(flight, "distance"), [0, 5, 17])
    np.testing.assert_allclose(profile_axis(flight, "time"), [0, 0.02, 0.04])


def test_what_was_left_out_is_written_beside_a_figure_and_not_into_it(tmp_path, figures):
    flight = NamedFlight("lost", load_track("split_s"), random_flight())
    path, left_out = tmp_path / "flights.png", tmp_path / "flights_left_out.txt"
    plot_flights([flight], path, problems=["a_run without its last flight", "b_run: ½"])
    assert left_out.read_text(encoding="utf-8") == "a_run without its last flight\nb_run: ½\n"
    assert figures[0].get_suptitle() == ""
    plot_flights([flight], path)
    assert not left_out.exists()
