"""What a world model sees and dreams, also in damaged images."""

from __future__ import annotations

import json
import math

import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator.rendering import is_in_view, points_in_camera
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Gate, load_track, make_track
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.evaluation.dreams import BelievedView, find_painter
from dreamer_racing.evaluation.image_corruptions import CORRUPTIONS, CorruptedPolicy, Frozen, Noise, blank, intact
from dreamer_racing.evaluation.sight import Sight, SightResults, angles, gate_table, measure_sight, sight_table
from dreamer_racing.evaluation.trajectory import Trajectory
from dreamer_racing.figures.protocol import plot_sight
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of
from tests.flights import level_flight

LEVEL = Camera(tilt=0.0, position=(0.0, 0.0, 0.0))


def flight(position, yaw_degrees=0.0, target=0, rows=1) -> Trajectory:
    """Standing still, for some rows."""
    angle = torch.zeros(rows)
    attitude = from_roll_pitch_yaw(angle, angle, angle + math.radians(yaw_degrees))
    return level_flight(torch.tensor(position).repeat(rows, 1), attitude=attitude, target_gate=angle.long() + target)


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
    head, _, *rows = gate_table({"without": sights, "with": sights}).splitlines()
    assert head == "| in view | without | with |" and rows == ["| gate 1 | 25% | 25% |", "| gate 2 | 75% | 75% |"]
    table = sight_table({"without": sights}).splitlines()
    assert [row.split(" | ")[1] for row in table[2:]] == ["next gate", "nearest visible gate"]


def test_shares_over_flights_of_unequal_length_a_lost_state_and_no_gate_in_view():
    """Three rows towards the gate, one away from it: time counts, not flights, and not the state that was lost."""
    towards, away = flight((0.0, 0.0, 1.0), rows=4), flight((0.0, 0.0, 1.0), yaw_degrees=180.0)
    towards.position[0] = math.nan
    sights = measure_sight([towards, away], track_of((10.0, 0, 1.0), (20.0, 0, 1.0)), LEVEL)
    following, nearest = sights["next gate"], sights["nearest visible gate"]
    assert following.share_in_view == nearest.share_in_view == 0.75
    assert following.angle.tolist() == pytest.approx([0, 0, 0, 180])
    assert following.flight.tolist() == [0, 0, 0, 1] and following.shares_by_flight == [1.0, 0.0]
    assert nearest.angle.isnan().tolist() == [False, False, False, True]
    assert nearest.to_dict()["angle_mean_degrees"] == 0.0


def test_decoys_count_whether_they_stand_there_or_not():
    decoys = [Gate((0.0, 5.0, 1.0), 0.0, kind="decoy"), Gate((5.0, 5.0, 1.0), 0.0, kind="decoy")]
    track = track_of((10.0, 0, 1.0), (20.0, 0, 1.0))
    sights = measure_sight([flight((0.0, 0.0, 1.0), yaw_degrees=30.0)], track, LEVEL, decoys)
    seen = [sights[name] for name in ("decoy 1", "decoy 2", "any decoy")]
    assert [sight.angle.item() for sight in seen] == pytest.approx([60, 15, 15])
    assert [sight.in_view.item() for sight in seen] == [False, True, True]


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
    without, decoyed = (SightResults(one, 0.0, 0.0, still, sights) for one in (track, other))
    plot_sight({"without": without, "with": decoyed}, Camera(), tmp_path / "new" / "both.png", "a title")
    plot_sight({"without": without}, Camera(), tmp_path / "one.png", "a title")
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


# Image corruptions: what the policy sees, and that nobody else sees it.


def images(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.uint8).view(-1, 1, 1, 1).expand(-1, 2, 2, 3).clone()


def test_frozen_shows_the_first_image_of_each_episode():
    frozen, first = Frozen(), images(1, 2)
    shown = [frozen(first, torch.tensor([True, True]))]
    first.fill_(9)  # a renderer may draw into the same memory
    for pixels, begins in ((images(3, 4), (False, False)), (images(5, 6), (False, True)), (first, (False, False))):
        shown.append(frozen(pixels, torch.tensor(begins)))
    assert [image[:, 0, 0, 0].tolist() for image in shown] == [[1, 2], [1, 2], [1, 6], [1, 6]]
    assert CORRUPTIONS["frozen"]() is not CORRUPTIONS["frozen"]()


def test_noise_is_uniform_new_at_every_step_and_seeded():
    pixels, begins = torch.zeros(4, 64, 64, 3, dtype=torch.uint8), torch.zeros(4)
    noise = Noise(seed=3)
    first, second = noise(pixels, begins), noise(pixels, begins)
    assert first.dtype == torch.uint8 and not torch.equal(first, second)
    assert torch.equal(first, Noise(seed=3)(pixels, begins))
    counts = torch.bincount(first.flatten().int(), minlength=256) / (first.numel() / 256)
    assert counts.min() > 0.6 and counts.max() < 1.4


def test_only_the_policy_sees_corrupted_images():
    watching = TensorDictModule(lambda pixels: pixels.clone(), ["pixels"], ["action"])  # acts by what it sees
    data = TensorDict({"pixels": images(1, 2), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
    policy = CorruptedPolicy(watching, blank)
    acted = policy(data)
    assert acted["action"].unique().tolist() == [128]
    assert acted["pixels"][:, 0, 0, 0].tolist() == data["pixels"][:, 0, 0, 0].tolist() == [1, 2]
    policy.deterministic = True
    assert watching.deterministic and policy.deterministic
    assert torch.equal(CorruptedPolicy(watching, intact)(data)["action"], data["pixels"])
    with pytest.raises(ValueError, match="no 'pixels'"):
        policy(data.exclude("pixels"))


# What shows a world model's latents; how dreams are stored is tested in tests/figures/test_flights.py.


def test_the_view_of_the_true_state_equals_the_camera_image() -> None:
    """Latents that are the race vector, over more frames than there are worlds; the drones stay where they are."""
    worlds = RaceWorlds("kidney", num_envs=3, start_on_line=1.0)
    worlds.reset()
    seen = []
    for _ in range(4):
        worlds.step(torch.zeros(3, 4))
        seen.append((worlds.vector(), worlds.render(), worlds.race.target_gate.clone()))
    vector, images, gate = (torch.stack(parts, 1) for parts in zip(*seen, strict=True))  # each (3, 4, ...)
    before = worlds.simulator.state.position.clone()
    painter = BelievedView(torch.nn.Identity(), worlds)
    views = painter(vector[..., :9], vector[..., 9:], gate)
    assert views.shape == images.shape and views.dtype == torch.uint8
    difference = (views.int() - images.int()).abs()
    assert (difference > 8).float().mean() < 0.002, "but for edges, by the rounding of float32"
    assert torch.equal(worlds.simulator.state.position, before)
    early = painter(vector[..., :9], vector[..., 9:], (gate + 1) % worlds.track.num_gates)
    late = ((early.int() - images.int()).abs() > 8).float().mean()
    assert late < 0.002, "the model passes a gate later than the flight"
    worlds.close()


def test_the_view_of_an_impossible_state_has_an_image() -> None:
    worlds = RaceWorlds("kidney", num_envs=2)
    painter = BelievedView(torch.nn.Identity(), worlds)
    for nonsense in (torch.nan, torch.inf, 1e30, 0.0):
        vector = torch.full((1, 3, 21), nonsense)
        views = painter(vector[..., :9], vector[..., 9:], torch.zeros(1, 3, dtype=torch.int64))
        assert views.shape == (1, 3, 64, 64, 3)
    worlds.close()


def test_latents_are_shown_by_what_decodes_them() -> None:
    worlds = RaceWorlds("kidney", num_envs=2)
    decoders = {"reconstruction": True, "privileged": True, "decoder_free": False, "informed": True}
    for world_model, shown in decoders.items():
        learner = learner_of("debug", Interface(privileged_dim=21), world_model=world_model)
        painter = find_painter(learner, worlds)
        assert (painter is not None) == shown, world_model
        if painter is not None:
            latents = [torch.zeros(1, 3, size) for size in (learner.size.belief, learner.size.state)]
            images = painter(*latents, torch.zeros(1, 3, dtype=torch.int64))
            assert images.shape == (1, 3, 64, 64, 3) and images.dtype == torch.uint8
    worlds.close()
