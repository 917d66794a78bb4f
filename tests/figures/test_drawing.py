"""What is drawn of tracks, flights and reports."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, load_track
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.drawing import camera_directions, draw_track
from dreamer_racing.figures.film import top_down_frames
from dreamer_racing.figures.flights import CELL, plot_top_down, plot_tracks
from dreamer_racing.figures.report import ReturnReport
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of
from tests.flights import level_flight


def straight_flight(track, outcome: str = "ground") -> Trajectory:
    """In 60 steps from the start pose along its heading, 0 to 8 m/s."""
    heading = math.radians(track.start_yaw_degrees)
    direction = torch.tensor([math.cos(heading), math.sin(heading), 0.0])
    speed, angle = torch.linspace(0, 8, 61).unsqueeze(1), torch.full((61,), heading)
    return level_flight(
        torch.tensor(track.start_position) + 0.02 * speed.cumsum(0) * direction,
        attitude=from_roll_pitch_yaw(0 * angle, 0 * angle, angle),
        linear_velocity=speed * direction,
        outcome=outcome,
    )


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_every_track_fits_and_only_different_heights_get_a_side_view(name, tmp_path, figures):
    track = load_track(name)
    trajectory = straight_flight(track)
    plot_top_down(track, trajectory, tmp_path / "new" / "plot.png")
    with Image.open(tmp_path / "new" / "plot.png") as image:
        assert image.width == 1350
        assert 1000 < image.height < 2400
    *panels, altitude, bar = figures[0].axes
    assert (altitude.get_ylabel(), bar.get_ylabel()) == ("altitude (m)", "speed (m/s)")
    heights = [gate.position[2] for gate in track.gates]
    assert len(panels) == (2 if max(heights) - min(heights) > 0.5 else 1)
    top = panels[0]
    assert top.get_aspect() == 1.0
    for low, high, limits in zip(track.bounds_low, track.bounds_high, (top.get_xlim(), top.get_ylim()), strict=False):
        assert limits[0] < low < high < limits[1]
    numbers = {text.get_text(): text.get_position() for text in top.texts if text.get_text().isdigit()}
    assert list(numbers) == [str(number) for number in range(1, track.num_gates + 1)]
    for number, place in numbers.items():
        reach = math.dist(place, track.gates[int(number) - 1].position[:2])
        assert reach == pytest.approx(track.shape.outer / 2 + 0.45)


def test_path_is_coloured_by_speed_and_ends_with_the_crash(tmp_path, figures):
    track = load_track("circle")
    trajectory = straight_flight(track)
    plot_top_down(track, trajectory, tmp_path / "plot.png")
    axes = figures[0].axes[0]
    line, arrows = axes.collections
    assert line.get_clim() == (0.0, 8.0)
    np.testing.assert_allclose(line.get_array(), np.linspace(0, 8, 61)[1:], rtol=1e-6)
    np.testing.assert_allclose(line.get_segments()[-1][1], trajectory.position[-1, :2], rtol=1e-6)
    assert len(arrows.get_offsets()) == 13  # 1.2 s, one every 0.1 s and one at the start
    marks = {mark.get_marker(): mark for mark in axes.lines if mark.get_marker() in ("o", "x")}
    np.testing.assert_allclose(marks["o"].get_xydata()[0], track.start_position[:2])
    np.testing.assert_allclose(marks["x"].get_xydata()[0], trajectory.position[-1, :2])
    assert all(mark.get_zorder() < line.get_zorder() for mark in marks.values()), "a short flight would be hidden"
    assert axes.get_title(loc="left") == "circle: 1.20 s, up to 8.0 m/s (ground)"
    plot_top_down(track, straight_flight(track, outcome="finished"), tmp_path / "plot.png")
    assert "x" not in [line.get_marker() for line in figures[1].axes[0].lines]


def test_gates_are_bars_across_the_direction_of_flight():
    track = load_track("figure8_decoys")
    axes = Figure().subplots()
    draw_track(axes, track)
    bars = [line.get_xydata() for line in axes.lines]
    assert len(bars) == len(track.decoys) + len(track.gates)
    for bar, gate in zip(bars, (*track.decoys, *track.gates), strict=True):
        np.testing.assert_allclose(bar.mean(0), gate.position[:2], atol=1e-9)
        assert math.dist(*bar) == pytest.approx(track.shape.outer)
        assert (bar[1] - bar[0]) @ np.array(gate.forward[:2]) == pytest.approx(0.0, abs=1e-9)
    colors = [line.get_color() for line in axes.lines]
    assert len(set(colors[:2])) == len(set(colors[2:])) == 1
    assert colors[0] != colors[-1]


def test_camera_looks_25_degrees_above_the_nose():
    zero = torch.zeros(4)
    pitch = torch.deg2rad(torch.tensor([0.0, 25.0, 115.0, 0.0]))  # nose down
    yaw = torch.deg2rad(torch.tensor([0.0, 0.0, 0.0, 90.0]))
    view = camera_directions(from_roll_pitch_yaw(zero, pitch, yaw), None)
    cosine, sine = math.cos(math.radians(25)), math.sin(math.radians(25))
    expected = torch.tensor([[cosine, 0, sine], [1, 0, 0], [0, 0, -1], [0, cosine, sine]])
    torch.testing.assert_close(view, expected, atol=1e-6, rtol=0)


def test_flights_are_drawn_with_the_cameras_that_they_were_flown_by(tmp_path):
    track, pictures = load_track("circle"), {}
    for tilt in (None, Camera.tilt, 60.0):
        flight = replace(straight_flight(track), camera_tilt=tilt)
        plot_top_down(track, flight, tmp_path / "plot.png")
        pictures[tilt] = np.asarray(Image.open(tmp_path / "plot.png")), top_down_frames(track, flight, size=96)
    for usual, same, other in zip(*pictures.values(), strict=True):
        assert np.array_equal(usual, same) and not np.array_equal(usual, other)


def test_lost_state_can_be_drawn(tmp_path):
    track = load_track("circle")
    trajectory = straight_flight(track, outcome="non_finite_state")
    trajectory.position[-1] = trajectory.linear_velocity[-1] = math.nan
    plot_top_down(track, trajectory, tmp_path / "plot.png")
    assert len(top_down_frames(track, trajectory, size=64)) == 61


# Maps of tracks side by side.


def test_every_track_is_drawn_from_above_and_from_the_side(tmp_path):
    tracks = [load_track(name) for name in BUILTIN_TRACKS[:4]]
    plot_tracks(tracks, tmp_path / "new" / "tracks.png")
    with Image.open(tmp_path / "new" / "tracks.png") as image:
        assert image.size == (round(3 * CELL[0] * 150), round(2 * CELL[1] * 150))
        pixels = image.convert("L")
        cells = [pixels.crop((left, 0, left + 750, 840)).getextrema() for left in (0, 750, 1500)]
        assert all(low < 128 for low, _ in cells)
        assert pixels.crop((760, 850, 2240, 1670)).getextrema() == (255, 255), "cells to spare stay white"


# Evaluations by returns: what they depend on, and what not.


def test_an_evaluation_by_returns_does_not_depend_on_those_before_it(tmp_path: Path) -> None:
    env = ControlSuiteEnv("cartpole_swingup", 2, from_pixels=False, action_repeat=50, seed=4)
    report = ReturnReport(tmp_path, learner_of(interface=Interface.of(env), seed=0), env, episodes=3, seed=4)
    torch.manual_seed(0)  # the model's latents are samples
    first = report.make(0)
    torch.manual_seed(0)
    second = report.make(1)
    report.close()
    assert first == second and first["evaluation/return_std"] > 0, "all episodes were one"
