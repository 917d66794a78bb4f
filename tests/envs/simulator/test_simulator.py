"""The batched simulator: drones that do not know of each other, and renderers that agree."""

import logging
import math
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from dreamer_racing import machine
from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator import opengl, rendering, simulators
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.scene import DRONE_GROUP, Camera, build_scene
from dreamer_racing.envs.simulator.simulators import MujocoSimulator
from dreamer_racing.envs.tracks import load_track
from tests.renderers import IN_PROCESS, renderer_or_skip
from tests.torch_flight import TorchFlight

EASY = PRESETS["easy"]
KIDNEY = load_track("kidney")


def poses(num_envs: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (N, 3) in the hall, attitudes (N, 4), velocities (N, 3)."""
    draw = torch.rand(num_envs, 9, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    position = draw[:, :3] * torch.tensor([6.0, 4.0, 1.0]) + torch.tensor([0.0, 0.0, 2.0])
    roll, pitch, yaw = (draw[:, 3:6] * torch.tensor([0.4, 0.4, math.pi])).unbind(1)
    return position, from_roll_pitch_yaw(roll, pitch, yaw), draw[:, 6:] * 3


def everyone(num_envs: int) -> Tensor:
    return torch.ones(num_envs, dtype=torch.bool)


def simulator(
    num_envs: int, renderer: str | None = None, preset: str = "easy", seed: int = 0, **arguments
) -> MujocoSimulator:
    generator = torch.Generator().manual_seed(seed)
    made = MujocoSimulator(KIDNEY, PRESETS[preset], num_envs, renderer=renderer, generator=generator, **arguments)
    made.reset(everyone(num_envs), *poses(num_envs))
    return made


def actions(steps: int, num_envs: int, seed: int = 1) -> Tensor:
    return torch.rand(steps, num_envs, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1


def snapshot(made: MujocoSimulator) -> Tensor:
    state = made.state
    return torch.cat((state.position, state.attitude, state.linear_velocity, state.body_rates), dim=1).clone()


@pytest.mark.parametrize(("num_envs", "num_threads", "expected"), [(5, None, 2), (5, 3, 3), (1, None, 1), (1, 3, 1)])
def test_threads_of_physics_and_drawing(num_envs: int, num_threads: int | None, expected: int, monkeypatch) -> None:
    """One a CPU, at most OMP_NUM_THREADS; as many as are asked for; never more than worlds."""
    seen, make_batch = [], simulators.Batch
    monkeypatch.setattr(machine, "available_cpus", lambda: 4)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(simulators, "Batch", lambda *given: seen.append(given[2]) or make_batch(*given))
    monkeypatch.setattr(simulators, "make_renderer", lambda *given: seen.append(given[4]))
    MujocoSimulator(KIDNEY, EASY, num_envs, num_threads=num_threads)
    assert seen == [expected, expected]


@pytest.mark.parametrize("num_threads", [1, 3])
def test_drones_together_fly_as_each_alone(num_threads: int) -> None:
    together = simulator(5, num_threads=num_threads)
    commands = actions(20, 5)
    paths = torch.stack([together.step(action) for action in commands])
    for index in range(5):
        alone = simulator(1)
        alone.reset(everyone(1), *(values[index : index + 1] for values in poses(5)))
        path = torch.stack([alone.step(action[index : index + 1]) for action in commands])
        torch.testing.assert_close(path[:, :, 0], paths[:, :, index], rtol=0, atol=1e-12)


def test_path_holds_every_physics_step() -> None:
    made = simulator(3, preset="faithful")
    steps = PRESETS["faithful"].physics_steps
    before = made.state.position.clone()
    first = made.step(actions(1, 3)[0])
    assert first.shape == (steps + 1, 3, 3)
    torch.testing.assert_close(first[0], before, rtol=0, atol=0)
    torch.testing.assert_close(first[-1], made.state.position, rtol=0, atol=0)
    kept = first.clone()
    second = made.step(actions(1, 3)[0])
    torch.testing.assert_close(second[0], kept[-1], rtol=0, atol=0)
    torch.testing.assert_close(first, kept, rtol=0, atol=0)  # a path is not overwritten by the next
    assert (second.diff(dim=0).norm(dim=-1) > 0).all()


def test_kernels_fly_what_torch_and_mujocos_own_step_fly() -> None:
    made = simulator(1, preset="faithful")
    parameters = PRESETS["faithful"]
    model = build_scene(KIDNEY, parameters).compile()
    data = mujoco.MjData(model)
    position, attitude, velocity = poses(1)
    data.qpos[:3], data.qpos[3:], data.qvel[:3] = position[0], attitude[0], velocity[0]
    quadrotor = Quadrotor(parameters, 1, generator=torch.Generator().manual_seed(0))
    quadrotor.reset(everyone(1))
    views = [torch.from_numpy(array).unsqueeze(0) for array in (data.qpos, data.qvel, data.qfrc_applied)]
    flight = TorchFlight(quadrotor, *views, lambda: mujoco.mj_step(model, data))
    for action in actions(10, 1):
        path = made.step(action)
        quadrotor.command(action)
        for index in range(parameters.physics_steps):
            flight.step(index)
        np.testing.assert_allclose(path[-1, 0].numpy(), data.qpos[:3], rtol=0, atol=1e-10)
    np.testing.assert_allclose(made.quadrotor.rotor_speed, quadrotor.rotor_speed, rtol=0, atol=1e-9)


@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_partial_reset_leaves_the_others_untouched(preset: str) -> None:
    mask = torch.tensor([False, True, False])
    commands = actions(20, 3)
    ends = []
    for reset in (False, True):
        made = simulator(3, preset=preset)
        for action in commands[:10]:
            made.step(action)
        if reset:
            made.reset(mask, *poses(3, seed=9))
            torch.testing.assert_close(made.state.position[1], poses(3, seed=9)[0][1], rtol=0, atol=0)
            assert not made.state.body_rates[1].any()
        for action in commands[10:]:
            made.step(action)
        ends.append(snapshot(made))
    assert torch.equal(ends[0][~mask], ends[1][~mask])
    assert not torch.allclose(ends[0][mask], ends[1][mask])


def test_broken_state_of_one_drone_stays_its_own() -> None:
    ends = []
    for broken in (False, True):
        made = simulator(3)
        if broken:
            made.state.body_rates[1] = 1e200
        for action in actions(5, 3):
            path = made.step(action)
        ends.append(snapshot(made))
    assert not path[:, 1].isfinite().all()  # seen by the race, not repaired by MuJoCo
    assert torch.equal(ends[0][::2], ends[1][::2])
    made.reset(torch.tensor([False, True, False]), *poses(3))
    assert made.step(actions(1, 3)[0]).isfinite().all()


# --- images ---


def level(*yaws_degrees: float, position: tuple[float, float, float] = (0.0, -1.0, 1.35)) -> tuple[Tensor, ...]:
    """Level drones at one place, at rest."""
    yaw = torch.tensor(yaws_degrees, dtype=torch.float64).deg2rad()
    zero = torch.zeros_like(yaw)
    place = torch.tensor(position, dtype=torch.float64).repeat(len(yaw), 1)
    return place, from_roll_pitch_yaw(zero, zero, yaw), torch.zeros_like(place)


def images(renderer: str, start: tuple[Tensor, ...], **arguments) -> Tensor:
    made = simulator(len(start[0]), renderer_or_skip(renderer), **arguments)
    made.reset(everyone(len(start[0])), *start)
    return made.render()


@pytest.mark.parametrize("renderer", IN_PROCESS)
def test_image_sizes_show_the_same(renderer: str) -> None:
    """Every third pixel of a side three times as long looks along the same ray."""
    start = poses(6, seed=3)
    small, large = (images(renderer, start, camera=Camera(size + size // 2, size)) for size in (32, 96))
    assert (small.shape, large.shape) == ((6, 32, 48, 3), (6, 96, 144, 3))
    same = (small.int() - large[:, 1::3, 1::3]).abs().amax(-1) <= 2
    assert same.float().mean() > 0.97  # pixels on an edge may go either way
    assert (small.int() - large[:, ::3, ::3]).abs().amax(-1).gt(2).float().mean() > 0.03


def test_osmesa_draws_what_warp_draws(tmp_path: Path) -> None:
    renderer_or_skip("osmesa")
    poses = level(0.0, 90.0, 180.0)
    torch.save(poses[:2], tmp_path / "poses.pt")
    script = (  # PyOpenGL is bound to one platform for the life of a process, and this one may have taken EGL
        "import sys, torch\n"
        "from dreamer_racing.envs.simulator.scene import Camera, build_scene\n"
        "from dreamer_racing.envs.simulator.rendering import make_renderer\n"
        "from dreamer_racing.envs.drone.parameters import PRESETS\n"
        "from dreamer_racing.envs.tracks import load_track\n"
        "for size in (32, 64, 96):\n"
        "    camera = Camera(size, size)\n"
        "    model = build_scene(load_track('kidney'), PRESETS['easy'], camera).compile()\n"
        "    renderer = make_renderer('osmesa', model, camera, 3, 2)\n"
        "    torch.save(renderer.render(*torch.load('poses.pt')), f'images_{size}.pt')\n"
        "    renderer.close()\n"
    )
    environment = {key: value for key, value in os.environ.items() if key not in ("PYOPENGL_PLATFORM", "MUJOCO_GL")}
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, check=True, timeout=120)
    for size in (32, 64, 96):
        drawn, expected = torch.load(tmp_path / f"images_{size}.pt"), images("warp", poses, camera=Camera(size, size))
        assert (drawn.float() - expected.float()).abs().mean() < 3.0


def test_image_shows_what_rays_hit() -> None:
    """An oracle of its own: colours along rays cast by MuJoCo's C engine."""
    camera = Camera()
    (image,) = simulator(1, renderer_or_skip("egl")).render().numpy()
    model = build_scene(KIDNEY, EASY, camera).compile()
    data = mujoco.MjData(model)
    position, attitude, _ = poses(1)
    data.qpos[:3], data.qpos[3:] = position[0], attitude[0]
    mujoco.mj_forward(model, data)
    right, up, backwards = data.camera("nose").xmat.reshape(3, 3).T
    hall = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    agree = []
    for row in range(2, 64, 6):
        for column in range(2, 64, 6):
            x, y = (column + 0.5) / 32 - 1, 1 - (row + 0.5) / 32  # 90° of view: tangents from -1 to 1
            geom = np.zeros(1, np.int32)
            mujoco.mj_ray(model, data, data.camera("nose").xpos, x * right + y * up - backwards, hall, 1, -1, geom)
            color = model.mat_rgba[model.geom_matid[geom[0]], :3]
            seen = image[row, column] / 255.0
            # light scales a colour, so compare directions
            agree.append(seen @ color / (np.linalg.norm(seen) * np.linalg.norm(color)) > 0.99)
    assert np.mean(agree) > 0.9  # pixels on an edge may go either way


@pytest.mark.parametrize("renderer", IN_PROCESS)
def test_drone_does_not_see_itself(renderer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(tilt=-60.0)  # down at its own arms
    start = level(0.0, 120.0)
    drawn = images(renderer, start, camera=camera)
    bare = build_scene(KIDNEY, EASY, camera)
    for geom in list(bare.body("drone").geoms):
        assert geom.group == DRONE_GROUP
        bare.delete(geom)
    monkeypatch.setattr("dreamer_racing.envs.simulator.simulators.build_scene", lambda *arguments: bare)
    assert torch.equal(drawn, images(renderer, start, camera=camera))


def test_nothing_hangs_in_mid_air() -> None:
    """OpenGL draws the hall and nothing else: no sites, frames or cameras."""
    renderer_or_skip("egl")
    model = build_scene(KIDNEY, EASY).compile()
    worker = opengl.OpenGLScene("egl", model, Camera())
    kinds = {worker._scene.geoms[index].objtype for index in range(worker._scene.ngeom)}
    worker.close()
    assert kinds == {int(mujoco.mjtObj.mjOBJ_GEOM)}


@pytest.mark.parametrize("renderer", IN_PROCESS)
@pytest.mark.parametrize("num_threads", [1, 2])
def test_masked_images_are_rows_of_all_images(renderer: str, num_threads: int) -> None:
    made = simulator(5, renderer_or_skip(renderer), num_threads=num_threads)
    whole = made.render()
    for mask in ([1, 0, 1, 1, 0], [0, 0, 0, 0, 1], [1] * 5, [0] * 5):
        rows = torch.tensor(mask, dtype=torch.bool)
        assert torch.equal(made.render(rows), whole[rows])
    assert len({image.numpy().tobytes() for image in whole}) == 5
    made.step(actions(1, 5)[0])
    assert not torch.equal(made.render(), whole)  # and the first images were not overwritten in place


def test_auto_falls_back_and_says_why(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    assert not opengl.loads("libno_such_library.so.1")
    monkeypatch.setattr(opengl, "loads", lambda library: False)
    rendering.log_once.cache_clear()
    with caplog.at_level(logging.INFO, logger=rendering.__name__):
        made = simulator(2, "auto")
    assert made.renderer is not None
    assert made.renderer.name == "warp"
    assert made.render().shape == (2, 64, 64, 3)
    assert "renderer: warp" in caplog.text
    assert "egl needs libEGL.so.1, which is not installed (Debian: apt-get install libegl1" in caplog.text
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_renderer_that_was_asked_for_is_no_warning_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    rendering.log_once.cache_clear()
    with caplog.at_level(logging.INFO, logger=rendering.__name__):
        simulator(2, "warp")
        simulator(2, "warp")  # of evaluations, say
    assert [(record.levelname, record.message[:14]) for record in caplog.records] == [("INFO", "renderer: warp")]


def test_renderer_that_was_asked_for_is_not_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opengl, "loads", lambda library: "libEGL" not in library)
    with pytest.raises(RendererUnavailableError, match="egl needs libEGL.so.1"):
        simulator(1, "egl")


def test_opengl_that_does_not_start_is_a_reason_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> None:
        raise RuntimeError("no device")

    renderer_or_skip("egl")
    monkeypatch.setattr(opengl, "OpenGLScene", broken)
    with pytest.raises(RendererUnavailableError, match=r"egl did not start \(RuntimeError: no device\)"):
        simulator(1, "egl")


def test_unknown_renderers_are_refused_and_those_without_a_worker_are_no_other_one(monkeypatch) -> None:
    known = ", ".join(("auto", *rendering.RENDERERS, rendering.WARP_CUDA))
    with pytest.raises(ValueError, match=f"Unknown renderer 'vulkan': use {known}, or None"):
        simulator(1, "vulkan")
    monkeypatch.setattr(rendering, "RENDERERS", (*rendering.RENDERERS, "vulkan"))
    with pytest.raises(NotImplementedError, match="'vulkan' is among the renderers, but no worker"):
        simulator(1, "vulkan")


@pytest.mark.parametrize("name", [*rendering.RENDERERS, rendering.WARP_CUDA])
def test_every_renderer_is_in_the_docstring_and_has_a_worker(name: str) -> None:
    assert f"`{name}`" in (rendering.__doc__ or "")
    renderer_or_skip(name)


@pytest.mark.parametrize(("renderer", "words"), [(None, "was made with renderer=None"), ("auto", "is closed")])
def test_without_a_renderer_or_after_closing_there_are_no_images(renderer: str | None, words: str) -> None:
    made = simulator(2, renderer)
    if renderer is not None:
        made.close()
    for _ in range(2):  # closing twice is safe
        with pytest.raises(RuntimeError, match=f"cannot render images: it {words}.$"):
            made.render()
        made.close()


OURS = "from dreamer_racing.envs.torchrl_env import DroneRacingEnv; env = DroneRacingEnv('circle', 2, renderer='egl')"
THEIRS = "from dm_control import suite; theirs = suite.load('cartpole', 'swingup'); theirs.physics.render(8, 8)"


@pytest.mark.slow
@pytest.mark.parametrize("order", [(OURS, THEIRS), (THEIRS, OURS)], ids=["ours first", "theirs first"])
def test_nothing_is_printed_at_the_end_beside_dm_controls_renderer(order: tuple[str, str]) -> None:
    renderer_or_skip("egl")
    script = "\n".join((*order, "env.reset()"))
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    assert "Error" not in done.stderr and "Traceback" not in done.stderr
