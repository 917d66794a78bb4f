"""The scene, and its looks."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import PRESETS, QuadrotorParameters
from dreamer_racing.envs.simulator.looks import LooksRandomisation, load_looks
from dreamer_racing.envs.simulator.scene import CAMERA_NAME, DRONE_GROUP, HALL_GROUP, Camera, build_scene
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Gate, Track, load_track
from dreamer_racing.envs.worlds import RaceWorlds
from tests.renderers import IN_PROCESS, renderer_or_skip

EASY = PRESETS["easy"]


def compiled(
    track: str | Track = "kidney", parameters: QuadrotorParameters = EASY, camera: Camera | None = None
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_scene(load_track(track), parameters, camera).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def first_hit(model: mujoco.MjModel, data: mujoco.MjData, origin, direction) -> tuple[str, float]:
    """Name of the first geom of the hall along a ray, and its distance in m."""
    groups, geom = np.zeros(6, np.uint8), np.zeros(1, np.int32)
    groups[HALL_GROUP] = 1
    origin, direction = np.asarray(origin, float), np.asarray(direction, float)
    distance = mujoco.mj_ray(model, data, origin, direction, groups, 1, -1, geom)
    return model.geom(geom[0]).name, distance


def gate_point(gate: Gate, forward: float, left: float, up: float) -> np.ndarray:
    """The point (3,) at an offset in a gate's own axes, m."""
    return np.asarray(gate.position) + forward * np.array(gate.forward) + left * np.array(gate.left) + [0, 0, up]


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_gates_stand_where_the_track_says(name: str) -> None:
    track = load_track(name)
    model, data = compiled(name)
    opening, outer, depth = track.shape.opening / 2, track.shape.outer / 2, track.shape.depth / 2
    named = [(f"gate_{index}", gate) for index, gate in enumerate(track.gates)]
    named += [(f"decoy_{index}", gate) for index, gate in enumerate(track.decoys)]
    for geom, gate in named:
        for side in (-1.0, 1.0):
            for middle in ((0.0, side), (side, 0.0), (side, side)):
                left, up = ((opening + outer) / 2 * offset for offset in middle)
                hit, distance = first_hit(model, data, gate_point(gate, -0.3, left, up), gate.forward)
                assert hit == geom
                assert distance == pytest.approx(0.3 - depth, abs=1e-5)
            for inside in (0.0, opening - 0.01):  # nothing of the gate stands in its opening
                hit, distance = first_hit(model, data, gate_point(gate, -0.2, side * inside, inside), gate.forward)
                assert hit != geom or distance > 0.4
            start = gate_point(gate, -0.2, side * (outer + 0.005), 0.0)  # just past the frame
            hit, distance = first_hit(model, data, start, gate.forward)
            assert hit != geom or distance > 0.4


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_hall_is_the_bounding_box(name: str) -> None:
    track = load_track(name)
    model, data = compiled(name)
    (x0, y0, _), (x1, y1, z1) = track.bounds_low, track.bounds_high
    corner = np.array([x0 + 0.2, y0 + 0.3, z1 - 0.2])  # above the gates, clear of the yellow lines
    expected = {
        (1, 0, 0): ("wall_x+", x1 - corner[0]),
        (-1, 0, 0): ("wall_x-", 0.2),
        (0, 1, 0): ("wall_y+", y1 - corner[1]),
        (0, -1, 0): ("wall_y-", 0.3),
        (0, 0, 1): ("ceiling", 0.2),
        (0, 0, -1): ("floor", corner[2]),
    }
    for direction, (geom, distance) in expected.items():
        hit, measured = first_hit(model, data, corner, direction)
        assert (hit, measured) == (geom, pytest.approx(distance, abs=1e-9))


def test_lines_lie_on_the_floor() -> None:
    track = load_track("circle")
    model, data = compiled(track)
    middle = (np.array(track.bounds_low) + np.array(track.bounds_high)) / 2
    heights = []
    for offset in np.arange(0.0, 3.0, 0.05):  # one spacing, in y, half a spacing from lines in x
        origin = middle + np.array([0.75, offset, 0.0])
        hit, distance = first_hit(model, data, origin, (0, 0, -1))
        heights.append((hit, round(origin[2] - distance, 6)))
    assert set(heights) == {("floor", 0.0), ("floor_lines", 0.02)}


def test_mass_properties_are_exact() -> None:
    parameters = dataclasses.replace(EASY, mass=0.7, inertia=(0.003, 0.002, 0.004))
    model, _ = compiled("kidney", parameters)
    drone = model.body("drone")
    np.testing.assert_array_equal(drone.ipos, np.zeros(3))
    np.testing.assert_array_equal(drone.iquat, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(drone.inertia, parameters.inertia)
    assert drone.mass.item() == 0.7
    assert model.body_mass.sum() == 0.7  # nothing else moves or weighs
    assert model.nv == 6


def test_applied_forces_are_of_the_world_and_torques_of_the_body() -> None:
    model, data = compiled()
    rotated = np.array([0.5, 0.5, 0.5, 0.5])  # body x → world y → z → x
    data.qpos[3:] = rotated
    data.qfrc_applied[:] = (0.3, 0.2, 0.1 + 9.81 * EASY.mass, 0.01, 0.02, 0.03)
    mujoco.mj_forward(model, data)
    expected = np.concatenate((np.array((0.3, 0.2, 0.1)) / EASY.mass, np.array((0.01, 0.02, 0.03)) / EASY.inertia))
    np.testing.assert_allclose(data.qacc, expected, rtol=1e-12, atol=1e-12)


def test_physics_options_are_those_of_the_parameters() -> None:
    for parameters, integrator in (
        (PRESETS["easy"], mujoco.mjtIntegrator.mjINT_EULER),
        (dataclasses.replace(PRESETS["faithful"], integrator="RK4"), mujoco.mjtIntegrator.mjINT_RK4),
    ):
        model, _ = compiled("kidney", parameters)
        assert model.opt.timestep == parameters.physics_dt
        assert model.opt.integrator == integrator
        np.testing.assert_array_equal(model.opt.gravity, [0.0, 0.0, -9.81])


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_camera_looks_along_body_x_tilted_up(tilt: float) -> None:
    camera = Camera(tilt=tilt, field_of_view=80.0)
    model, data = compiled("kidney", camera=camera)
    data.qpos[:] = (1.0, 2.0, 1.5, 1.0, 0.0, 0.0, 0.0)
    mujoco.mj_forward(model, data)
    view = data.camera(CAMERA_NAME)
    right, up, backwards = view.xmat.reshape(3, 3).T
    angle = math.radians(tilt)
    np.testing.assert_allclose(-backwards, [math.cos(angle), 0.0, math.sin(angle)], atol=1e-12)
    np.testing.assert_allclose(right, [0.0, -1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(up, [-math.sin(angle), 0.0, math.cos(angle)], atol=1e-12)
    np.testing.assert_allclose(view.xpos, np.array([1.0, 2.0, 1.5]) + camera.position, atol=1e-12)
    assert model.camera(CAMERA_NAME).fovy.item() == 80.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"width": 0}, "camera.width=0: must be at least 1"),
        ({"width": 64.0}, "camera.width=64.0: must be a whole number"),
        ({"field_of_view": 180.0}, "camera.field_of_view=180.0: must be below 180"),
        ({"tilt": math.inf}, r"camera.tilt=inf: must be finite\."),
        ({"position": (0.1, 0.0)}, r"camera.position=\(0.1, 0.0\): must be three numbers, each finite"),
        ({"position": (0.1, 0.0, math.nan)}, "camera.position=.*nan.*: must be three numbers, each finite"),
        ({"near": 0.0}, "camera.near=0.0: must be above 0"),
        ({"far": math.inf}, "camera.far=inf: must be above 0, and finite"),
        ({"near": 2.0, "far": 1.0}, "camera.near=2.0: must be below camera.far=1.0"),
    ],
)
def test_cameras_that_see_nothing_are_refused(settings, words) -> None:
    with pytest.raises(ValueError, match=words):
        Camera(**settings)


def test_numbers_of_numpy_make_a_camera() -> None:
    assert Camera(np.int64(32), np.int32(32), np.float32(80), position=np.zeros(3)).width == 32


def test_drone_is_drawn_in_a_group_of_its_own_and_touches_nothing() -> None:
    model, _ = compiled()
    drone = model.body("drone").id
    assert set(model.geom_group[model.geom_bodyid == drone]) == {DRONE_GROUP}
    assert set(model.geom_group[model.geom_bodyid != drone]) == {HALL_GROUP}
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()


def test_gate_colours() -> None:
    decoys = load_track("figure8_decoys")
    painted = dataclasses.replace(decoys.gates[0], color=(0.0, 1.0, 0.0))
    model, _ = compiled(dataclasses.replace(decoys, gates=(painted, *decoys.gates[1:])))

    def color(name: str) -> np.ndarray:
        return model.mat_rgba[model.geom(name).matid.item(), :3]

    np.testing.assert_allclose(color("gate_0"), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(color("decoy_0"), decoys.decoys[0].color, atol=1e-6)
    assert not np.allclose(color("gate_1"), color("decoy_0"))


# Looks that change from episode to episode, the same from every renderer.


N = 6
QUIET = LooksRandomisation(noise=0.0)
NOTHING = LooksRandomisation(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def worlds(looks: str | LooksRandomisation | None, renderer: str = "auto", seed: int = 0, **arguments) -> RaceWorlds:
    made = RaceWorlds("kidney", N, evaluation=True, looks=looks, renderer=renderer, seed=seed, **arguments)
    made.reset()
    return made


def images(looks: str | LooksRandomisation | None, renderer: str = "warp", **arguments) -> Tensor:
    return worlds(looks, renderer, **arguments).render().float()


@pytest.mark.parametrize("renderer", IN_PROCESS)
def test_worlds_look_different_and_only_if_asked(renderer: str) -> None:
    renderer_or_skip(renderer)
    nominal, varied = images(None, renderer), images(QUIET, renderer)
    assert (nominal[1:] == nominal[0]).all()  # all start at the same place
    for one in range(N):
        for other in range(one):
            assert (varied[one] - varied[other]).abs().mean() > 1.0
    assert (images(NOTHING, renderer) - nominal).abs().mean() < 0.2


@pytest.mark.parametrize("renderer", [name for name in IN_PROCESS if name != "egl"])
def test_renderers_agree_about_looks(renderer: str) -> None:
    for name in ("egl", renderer):
        renderer_or_skip(name)
    made = [worlds(QUIET, "egl"), worlds(QUIET, renderer), worlds(QUIET, backend="mujoco_warp")]
    for each in made[1:]:
        each.simulator.load_state_dict(made[0].simulator.state_dict())
    first, *others = (each.render().float() for each in made)
    for other in others:
        assert (first - other).abs().mean() < 3.0


@pytest.mark.parametrize(
    ("name", "value"), [("brightness", 0.5), ("color", 0.5), ("gate_color", 0.5), ("camera_tilt", 10.0)]
)
def test_each_width_has_its_effect(name: str, value: float) -> None:
    varied = images(LooksRandomisation(**{**vars(NOTHING), name: value}))
    difference = (varied - images(None)).abs()
    assert (difference.mean((1, 2, 3)) > 0.1).all()
    if name == "brightness":  # every pixel that is not saturated becomes darker or brighter alike
        darker, brighter = (varied < images(None)).flatten(1), (varied > images(None)).flatten(1)
        assert not (darker.any(1) & brighter.any(1)).any()


def test_a_wider_lens_shows_gates_smaller() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "field_of_view": 20.0}))
    looks = made.simulator.looks.looks
    red, green, blue = made.render().float().unbind(-1)
    orange = ((red > 140) & (green < 100) & (blue < 60)).flatten(1).sum(1)
    order = looks.field_of_view.argsort()
    assert (orange[order].diff() <= 0).all()
    assert orange[order[0]] > 1.2 * orange[order[-1]]


def test_an_episode_keeps_its_looks_and_the_next_has_others() -> None:
    made = worlds(QUIET)
    before = made.simulator.looks.state_dict()
    mask = torch.tensor([True, False] * (N // 2))
    made.step(torch.zeros(N, 4))
    made.reset(mask)
    after = made.simulator.looks.state_dict()
    for name, value in after.items():
        assert torch.equal(value[~mask], before[name][~mask])
        assert (value[mask] != before[name][mask]).reshape(N // 2, -1).any(1).all()


def test_gates_and_surfaces_vary_apart() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "gate_color": 0.2}))
    looks = made.simulator.looks
    changed = (looks.looks.colors != looks._nominal).flatten(2).any(2)  # (N, K)
    assert changed.sum(1).tolist() == [1] * N  # kidney's gates share one colour


def test_noise_is_of_the_width_asked_for_and_new_in_every_image() -> None:
    made = worlds(LooksRandomisation(**{**vars(NOTHING), "noise": 0.02}))
    clean, first, second = made.simulator.render().float(), made.render().float(), made.render().float()
    inner = (clean > 30) & (clean < 225)  # not cut off
    assert (first - clean)[inner].std() == pytest.approx(0.02 * 255, rel=0.05)
    assert abs(float((first - clean)[inner].mean())) < 0.1
    assert not torch.equal(first, second)


@pytest.mark.parametrize(("saved", "present"), [(None, "randomised"), ("randomised", None)])
def test_a_state_with_other_looks_is_refused(saved: str | None, present: str | None) -> None:
    one, other = worlds(saved), worlds(present)
    name = saved or "nominal"
    with pytest.raises(ValueError, match=f"the saved worlds have looks={name}, so resume"):
        other.load_state_dict(one.state_dict())


def test_bad_looks_are_refused() -> None:
    with pytest.raises(ValueError, match="looks='pretty': use nominal, randomised"):
        load_looks("pretty")
    with pytest.raises(ValueError, match="or a LooksRandomisation"):
        load_looks({"noise": 0.1})
    with pytest.raises(ValueError, match="looks='randomised': needs images, but from_pixels=False"):
        RaceWorlds("circle", looks="randomised", from_pixels=False)
    with pytest.raises(ValueError, match="noise=-1.0: must be at least 0"):
        LooksRandomisation(noise=-1.0)
    with pytest.raises(ValueError, match="below 1"):
        LooksRandomisation(brightness=1.0)
    with pytest.raises(ValueError, match="camera_tilt='3': must be a number"):
        LooksRandomisation(camera_tilt="3")


@pytest.mark.parametrize(("lens", "width", "most"), [(90.0, 90.0, 90), (120.0, 60.0, 60)])
def test_varied_fields_of_view_stay_between_0_and_180_degrees(lens: float, width: float, most: int) -> None:
    with pytest.raises(ValueError, match=f"field_of_view={width}: must be below {most}, so that {lens:g} degrees"):
        worlds(LooksRandomisation(field_of_view=width), "warp", camera=Camera(field_of_view=lens))
