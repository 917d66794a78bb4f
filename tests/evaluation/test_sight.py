"""What the camera is turned to: angles and views by hand."""

from __future__ import annotations

import json
import math

import pytest
import torch
from PIL import Image

from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator.camera_view import is_in_view, points_in_camera
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Gate, load_track, make_track
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.evaluation.sight import Sight, angles, gate_table, measure_sight, sight_table
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.protocol import plot_sight

LEVEL = Camera(tilt=0.0, position=(0.0, 0.0, 0.0))


def flight(position, yaw_degrees=0.0, pitch_degrees=0.0, target=0, rows=1) -> Trajectory:
    """Standing still, for some rows."""
    angle = torch.zeros(rows)
    attitude = from_roll_pitch_yaw(
        angle, angle + math.radians(pitch_degrees), angle + math.radians(yaw_degrees)
    )  # pitch: nose down
    return Trajectory(
        position=torch.tensor(position).expand(rows, 3).clone(),
        attitude=attitude,
        linear_velocity=torch.zeros(rows, 3),
        target_gate=torch.full((rows,), target),
        action=torch.zeros(rows - 1, 4),
        pixels=None,
        control_dt=0.02,
        outcome=None,
    )


def track_of(*places):
    return make_track("line", [Gate(place, 0.0) for place in places])


def test_points_in_the_axes_of_a_tilted_mounted_turned_camera():
    camera = Camera(tilt=30.0, position=(0.1, 0.0, 0.0))
    attitude = from_roll_pitch_yaw(*torch.deg2rad(torch.tensor([[0.0], [0.0], [90.0]])))  # along y
    # From the mount at (0, 0.1, 0): √3 ahead (along y), 2 to the left (−x), 1 up; the axis is 30° above the horizon.
    points = torch.tensor([[-2.0, 0.1 + math.sqrt(3.0), 1.0], [0.0, 0.1, 2.0]])
    seen = points_in_camera(torch.zeros(1, 3), attitude, points, camera)[0]
    torch.testing.assert_close(seen, torch.tensor([[2.0, 2.0, 0.0], [1.0, 0.0, math.sqrt(3.0)]]))
    assert angles(seen).tolist() == pytest.approx([45.0, 60.0])


def test_the_view_is_a_pyramid_of_90_degrees_and_as_wide_as_the_image():
    ahead = torch.tensor([[1.0, 0.99, 0.99], [1.0, 1.01, 0.0], [1.0, 0.0, -1.01], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert is_in_view(ahead, LEVEL).tolist() == [True, False, False, False, False]
    assert is_in_view(ahead, Camera(width=128, height=64)).tolist() == [True, True, False, False, False]
    narrow = math.tan(math.radians(30.0))
    sides = torch.tensor([[1.0, 0.99 * narrow, 0.0], [1.0, 1.01 * narrow, 0.0]])
    assert is_in_view(sides, Camera(field_of_view=60.0)).tolist() == [True, False]


def test_next_and_nearest_visible_gate():
    """Gates 30° to the left at 10 m, straight ahead at 20 m, and behind at 1 m, which is next."""
    left = (10 * math.cos(math.radians(30)), 10 * math.sin(math.radians(30)), 1.0)
    sights = measure_sight([flight((0.0, 0.0, 1.0), target=2)], track_of(left, (20.0, 0, 1.0), (-1.0, 0, 1.0)), LEVEL)
    assert list(sights) == ["next gate", "nearest visible gate", "gate 1", "gate 2", "gate 3"]
    assert sights["next gate"].angle.tolist() == pytest.approx([180.0])
    assert not sights["next gate"].in_view.any()
    assert sights["nearest visible gate"].angle.tolist() == pytest.approx([30.0])
    assert sights["nearest visible gate"].in_view.all()


def test_each_gate_is_seen_for_itself():
    """One row towards both gates, 0° and 30° off the axis, two turned by 60° to the left, and one to where none is."""
    left = (10 * math.cos(math.radians(30)), 10 * math.sin(math.radians(30)), 1.0)
    here = (0.0, 0.0, 1.0)
    flights = [flight(here), flight(here, yaw_degrees=60.0, rows=2), flight(here, yaw_degrees=180.0)]
    sights = measure_sight(flights, track_of((20.0, 0, 1.0), left), LEVEL)
    assert sights["gate 1"].angle.tolist() == pytest.approx([0, 60, 60, 180])
    assert sights["gate 2"].angle.tolist() == pytest.approx([30, 30, 30, 150])
    assert [sights[f"gate {number}"].share_in_view for number in (1, 2)] == [0.25, 0.75]
    assert sights["gate 2"].shares_by_flight == [1.0, 1.0, 0.0]
    rows = gate_table({"without": sights, "with": sights}).splitlines()
    assert rows[0] == "| in view | without | with |" and rows[2:] == [
        "| gate 1 | 25% | 25% |",
        "| gate 2 | 75% | 75% |",
    ]
    table = sight_table({"without": sights}).splitlines()
    assert [row.split(" | ")[1] for row in table[2:]] == ["next gate", "nearest visible gate"]


def test_shares_over_flights_of_unequal_length_and_no_gate_in_view():
    """Three rows towards the gate, one away from it: time counts, not flights."""
    track = track_of((10.0, 0, 1.0), (20.0, 0, 1.0))
    flights = [flight((0.0, 0.0, 1.0), rows=3), flight((0.0, 0.0, 1.0), yaw_degrees=180.0)]
    sights = measure_sight(flights, track, LEVEL)
    assert sights["next gate"].share_in_view == sights["nearest visible gate"].share_in_view == 0.75
    assert sights["next gate"].angle.tolist() == pytest.approx([0, 0, 0, 180])
    nearest = sights["nearest visible gate"]
    assert nearest.angle.isnan().tolist() == [False, False, False, True]
    assert nearest.to_dict()["angle_mean_degrees"] == 0.0


def test_decoys_count_whether_they_stand_there_or_not():
    decoys = [Gate((0.0, 5.0, 1.0), 0.0, kind="decoy"), Gate((5.0, 5.0, 1.0), 0.0, kind="decoy")]
    track = track_of((10.0, 0, 1.0), (20.0, 0, 1.0))
    sights = measure_sight([flight((0.0, 0.0, 1.0), yaw_degrees=30.0)], track, LEVEL, decoys)
    assert [sights[name].angle.item() for name in ("decoy 1", "decoy 2", "any decoy")] == pytest.approx([60, 15, 15])
    assert [sights[name].in_view.item() for name in ("decoy 1", "decoy 2", "any decoy")] == [False, True, True]


def test_a_lost_state_is_left_out():
    lost = flight((0.0, 0.0, 1.0), rows=2)
    lost.position[1] = math.nan
    assert len(measure_sight([lost], track_of((10.0, 0, 1.0), (20.0, 0, 1.0)), LEVEL)["next gate"].angle) == 1


def test_observations_know_their_flight():
    track = track_of((10.0, 0, 1.0), (20.0, 0, 1.0))
    lost = flight((0.0, 0.0, 1.0), rows=2)
    lost.position[0] = math.nan
    away = flight((0.0, 0.0, 1.0), yaw_degrees=180.0, rows=3)
    sight = measure_sight([lost, away], track, LEVEL)["next gate"]
    assert sight.flight.tolist() == [0, 1, 1, 1] and sight.shares_by_flight == [1.0, 0.0]


def test_numbers_of_a_sight():
    sight = Sight(
        torch.tensor([2.0, 4.0, 12.0, 180.0, math.nan]),
        torch.tensor([True, True, True, False, False]),
        torch.tensor([0, 0, 0, 2, 2]),
    )
    histogram = sight.histogram()
    assert histogram[[0, 2, 35]].tolist() == [0.5, 0.25, 0.25] and histogram.sum() == 1
    numbers = json.loads(json.dumps(sight.to_dict(), allow_nan=False))
    assert numbers["observations"] == 5 and numbers["share_in_view"] == pytest.approx(0.6)
    assert numbers["angle_mean_degrees"] == pytest.approx(49.5)
    assert numbers["angle_quantiles_degrees"]["50 %"] == pytest.approx(8.0)
    never = Sight(torch.tensor([math.nan]), torch.tensor([False]), torch.tensor([0]))
    assert never.to_dict()["angle_quantiles_degrees"]["50 %"] is None
    table = sight_table({"with": {"gate": sight, "none": never}}).splitlines()
    assert table[2] == "| with | gate | 60% | 50° | 2° | 4° | 8° | 54° | 155° |"
    assert table[3] == "| with | none | 0% | – | – | – | – | – | – |"


def test_plot_of_flights_with_and_without_decoys(tmp_path):
    track, other = load_track("figure8"), load_track("figure8_decoys")
    still = flight(track.start_position, rows=10)
    sights = measure_sight([still], track, Camera(), other.decoys)
    flights = {"without": (track, still, sights), "with": (other, still, sights)}
    plot_sight(flights, Camera(), tmp_path / "new" / "both.png", "a title")
    plot_sight({"without": flights["without"]}, Camera(), tmp_path / "one.png")
    with Image.open(tmp_path / "new" / "both.png") as both, Image.open(tmp_path / "one.png") as one:
        assert both.width == one.width == 1500


def test_points_are_where_the_renderer_draws_them():
    """Top and bottom bars of gates, from random poses: the pixel that a point in view projects to is orange."""
    worlds = RaceWorlds("circle", 40, renderer="warp", num_threads=1, seed=0)
    worlds.reset()
    state, track = worlds.privileged(), worlds.track
    images = worlds.render()
    bar = (track.shape.outer + track.shape.opening) / 4  # m above and below the gate's centre
    centres = track.gate_positions()
    points = torch.cat((centres, centres)) + torch.tensor([[0.0, 0.0, bar]] * 4 + [[0.0, 0.0, -bar]] * 4)
    seen = points_in_camera(state["position"], state["attitude"], points, worlds.camera)  # (40, 8, 3)
    depth, left, up = seen.unbind(-1)
    edge = torch.maximum(left.abs(), up.abs()) > 0.95 * depth  # half a pixel may be another thing there
    near = is_in_view(seen, worlds.camera) & ~edge & (depth < 4.0)
    assert near.sum() > 20
    world, _ = near.nonzero(as_tuple=True)
    row, column = (32 * (1 - offset / depth)[near] for offset in (up, left))
    colors = images[world, row.long(), column.long()].int()
    assert (colors[:, 0] > 150).all() and (colors[:, 2] < 60).all()
    worlds.close()
