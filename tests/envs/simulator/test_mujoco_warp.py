"""The mujoco_warp backend, and its kernels compiled for CUDA."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.simulator import simulators
from dreamer_racing.envs.simulator.looks import load_looks
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.simulator.simulators import MujocoSimulator, WarpSimulator, memory_of_worlds
from dreamer_racing.envs.simulator.warp_device import load_warp
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.envs.worlds import RaceWorlds

KIDNEY = load_track("kidney")
N = 6
CUDA = pytest.param("cuda", marks=pytest.mark.gpu)
everywhere = pytest.mark.parametrize("device", ["cpu", CUDA])


def generator(device: str, seed: int = 0) -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def on_warp(device: str, preset: str = "easy", **arguments) -> WarpSimulator:
    arguments = {"images": False, **arguments}
    return WarpSimulator(KIDNEY, PRESETS[preset], N, device=device, generator=generator(device), **arguments)


def on_mujoco(preset: str = "easy", renderer: str | None = None) -> MujocoSimulator:
    made = MujocoSimulator(KIDNEY, PRESETS[preset], N, renderer=renderer, generator=generator("cpu"))
    start = StartSampler(KIDNEY, generator("cpu", 1), dtype=torch.float64).sample(N)
    made.reset(torch.ones(N, dtype=torch.bool), start.position, start.attitude, start.linear_velocity)
    return made


def smooth_actions(steps: int, device: str = "cpu") -> Tensor:
    """Actions (T, N, 4) that change every tenth of a second, as hard as a pilot's."""
    targets = torch.rand(steps // 5 + 1, N, 4, generator=generator("cpu", 2)) * 2 - 1
    return (targets.repeat_interleave(5, 0)[:steps] * torch.tensor([0.5, 0.3, 0.3, 1.0])).to(device)


@everywhere
@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_physics_is_that_of_the_c_engine(preset: str, device: str) -> None:
    ours, reference = on_warp(device, preset), on_mujoco(preset)
    ours.load_state_dict(reference.state_dict())  # the same drones, where parameters are randomised
    errors = []
    for action in smooth_actions(100):
        path, expected = ours.step(action.to(device)), reference.step(action)
        errors.append((path.cpu() - expected).norm(dim=-1).amax())
    assert errors[0] < 1e-5
    assert max(errors) < 2e-3  # m after 2 s, in float32
    assert (expected[-1] - expected[0]).norm(dim=-1).min() > 0.01  # they do move


@everywhere
def test_partial_reset_leaves_the_others_untouched(device: str) -> None:
    made = on_warp(device, "faithful")
    made.load_state_dict(on_mujoco("faithful").state_dict())
    for action in smooth_actions(5, device):
        made.step(action)
    mask = torch.tensor([False, True, False, True, False, False], device=device)
    before = torch.cat((made._qpos, made._qvel, made.quadrotor.rotor_speed), 1).clone()
    start = StartSampler(KIDNEY, generator(device, 3), device, torch.float32).sample(N)
    made.reset(mask, start.position, start.attitude, start.linear_velocity)
    after = torch.cat((made._qpos, made._qvel, made.quadrotor.rotor_speed), 1)
    assert torch.equal(before[~mask], after[~mask])
    assert torch.equal(made.state.position[mask], start.position[mask])
    assert (after[mask] != before[mask]).any(1).all()


@everywhere
def test_images_are_those_of_the_cpu_backends_ray_caster(device: str) -> None:
    camera = Camera(width=48, height=32)
    reference = MujocoSimulator(KIDNEY, PRESETS["easy"], N, camera, "warp", num_threads=1)
    reference.load_state_dict(on_mujoco().state_dict())
    ours = on_warp(device, images=True, camera=camera)
    ours.load_state_dict(reference.state_dict())
    images, expected = ours.render(), reference.render()
    assert images.shape == (N, 32, 48, 3)
    assert images.device.type == device
    difference = (images.cpu().float() - expected.float()).abs()
    assert difference.mean() < 0.5  # float32 poses move an edge pixel now and then
    assert expected.float().std() > 30.0
    mask = torch.tensor([True, False, False, True, True, False], device=device)
    assert torch.equal(ours.render(mask), images[mask])


@everywhere
def test_race_is_the_same_race(device: str) -> None:
    """The same starts and actions: the same passes, crashes and rewards until float32 matters."""
    worlds = [RaceWorlds("kidney", N, from_pixels=False, seed=0, device=device, backend="mujoco_warp"),
              RaceWorlds("kidney", N, from_pixels=False, seed=0)]  # fmt: skip
    start = StartSampler(KIDNEY, generator("cpu", 1), dtype=torch.float64).sample(N)
    for each in worlds:
        each.reset()
        mask = torch.ones(N, dtype=torch.bool, device=each.device)
        poses = (value.to(each.device) for value in (start.position, start.attitude, start.linear_velocity))
        each.simulator.reset(mask, *poses)
        each.race.begin(mask, start.position.to(each.device), start.target_gate.to(each.device))
    ends = torch.zeros(N, dtype=torch.bool)
    for action in smooth_actions(60):
        ours, reference = (each.step(action.to(each.device)) for each in worlds)
        for name in ("reward_base", "gate_offset", "body_rate_norm"):
            torch.testing.assert_close(getattr(ours, name).cpu(), getattr(reference, name), rtol=0, atol=2e-3)
        for name in ("terminated", "truncated", "gates_passed", "crash", "target_gate"):
            assert torch.equal(getattr(ours, name).cpu(), getattr(reference, name)), name
        ends |= reference.terminated
        torch.testing.assert_close(worlds[0].vector().cpu(), worlds[1].vector(), rtol=0, atol=1e-3)
    assert ends.any()


@everywhere
@pytest.mark.parametrize("from_pixels", [True, False])
def test_torchrl_environment(from_pixels: bool, device: str) -> None:
    env = DroneRacingEnv("circle", N, device, from_pixels, seed=0, episode_steps=8, backend="mujoco_warp")
    check_env_specs(env, seed=0)
    rollout = env.rollout(20, break_when_any_done=False)
    assert rollout.device.type == device
    assert rollout["next", "truncated"].any()
    if from_pixels:
        assert rollout["pixels"].float().std() > 20.0
    env.close()


@pytest.mark.gpu
@pytest.mark.parametrize("from_pixels", [True, False])
def test_a_step_is_one_graph_that_never_waits(from_pixels: bool) -> None:
    worlds = RaceWorlds("kidney", N, from_pixels=from_pixels, seed=0, device="cuda", preset="faithful")
    worlds.reset()
    actions = smooth_actions(20, "cuda")
    state = worlds.state_dict()
    eager = [worlds._fly(action) for action in actions]
    images = worlds.simulator.render() if from_pixels else None
    worlds.load_state_dict(state)
    worlds.step(actions[0])  # captures
    worlds.load_state_dict(state)
    torch.cuda.set_sync_debug_mode("error")
    try:
        graphed = [worlds.step(action) for action in actions]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for one, other in zip(eager, graphed, strict=True):
        for name, value in vars(one).items():
            torch.testing.assert_close(getattr(other, name), value, rtol=0, atol=1e-6)
    if images is not None:
        assert (worlds.render().float() - images.float()).abs().mean() < 0.01


@pytest.mark.gpu
def test_memory_is_estimated() -> None:
    def used() -> int:
        torch.cuda.synchronize()
        free, total = torch.cuda.mem_get_info()
        return total - free

    RaceWorlds("kidney", 4, device="cuda").close()  # what the first simulator of a process loads
    before = used()
    worlds = RaceWorlds("kidney", 4096, device="cuda")
    estimate = memory_of_worlds(KIDNEY, PRESETS["easy"], 4096)
    assert 0.5 * estimate < used() - before < 2.0 * estimate
    worlds.close()


# --- bad input ---


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
@pytest.mark.parametrize("make", [RaceWorlds, DroneRacingEnv])
def test_absent_cuda_is_named(make: type, device: str) -> None:
    with pytest.raises(ValueError, match=rf"device='{device}': torch .*finds no CUDA device here.*device='cpu'"):
        make("circle", device=device)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"device": "meta"}, "device='meta': must be cpu or cuda"),
        ({"device": "gpu"}, "device='gpu': must be cpu or cuda"),
        ({"backend": "bullet", "from_pixels": False}, "Unknown backend 'bullet': use auto, mujoco, mujoco_warp"),
        *(({"backend": "mujoco_warp", "renderer": name},
           rf"renderer='{name}'.*'mujoco_warp'.*renderer='auto' or 'warp'") for name in ("egl", "osmesa")),
    ],
)  # fmt: skip
def test_what_the_backend_lacks_is_refused_by_name(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        RaceWorlds("circle", **arguments)


def test_too_many_worlds_are_refused_before_anything_is_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulators, "available_memory", lambda device: 1e9)
    monkeypatch.setattr(simulators, "_make_bodies", lambda *arguments: pytest.fail("allocated"))
    with pytest.raises(ValueError, match=r"num_envs=100,000 needs about 5.0 GB, and cpu has 1.0 GB left: at most"):
        RaceWorlds("kidney", 100_000, backend="mujoco_warp")


def test_memory_grows_with_worlds_and_images() -> None:
    easy = PRESETS["easy"]
    one, thousand = (memory_of_worlds(KIDNEY, easy, num) for num in (1, 1000))
    assert thousand == 1000 * one
    assert one > 64 * 64 * (4 + 3)  # the frame as it is drawn, and as it is given
    assert memory_of_worlds(KIDNEY, easy, 1, images=False) < one / 10
    assert memory_of_worlds(KIDNEY, easy, 1, Camera(width=128, height=128)) > 3 * one


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_the_hybrid_renderer_needs_cuda() -> None:
    with pytest.raises(RendererUnavailableError, match="warp_cuda needs a CUDA device"):
        RaceWorlds("circle", renderer="warp_cuda")


@pytest.mark.gpu
def test_the_hybrid_renderer_draws_the_same() -> None:
    on_cpu, on_cuda = (on_mujoco(renderer=renderer).render().float() for renderer in ("warp", "warp_cuda"))
    assert (on_cpu - on_cuda).abs().mean() < 0.5


# Every warp kernel that a control step launches compiles for a GPU, which needs none, nor a driver.


ARCHITECTURE = 90  # of an H100 or H200


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that MuJoCo's warp port chooses for a GPU instead of a CPU, if there are any, are not among them."""
    warp = load_warp()
    for looks in ("nominal", "randomised"):
        simulator = on_warp("cpu", "faithful", images=True, looks=load_looks(looks))
        simulator.step(torch.zeros(N, 4))
        simulator.render()
    ran = {name: module for name, module in warp._src.context.user_modules.items() if module.execs}
    for wanted in ("apply_controls", "correct_step", "_render_megakernel", "forward", "smooth"):
        assert any(wanted in name for name in ran), f"{wanted} was not launched, so the test would not see it"
    monkeypatch.setattr(warp.config, "optimization_level", 0)  # whether it compiles is known before any of it
    for name, module in ran.items():
        folder = tmp_path / name
        warp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=folder, use_ptx=True)
        compiled = [file.read_text() for file in folder.glob("*.ptx")]
        assert compiled and all(f".target sm_{ARCHITECTURE}" in text for text in compiled), name
