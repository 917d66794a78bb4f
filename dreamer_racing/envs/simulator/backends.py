"""Choice of the simulator for a device."""

import torch

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.looks import LooksRandomisation
from dreamer_racing.envs.simulator.mujoco_cpu import MujocoSimulator, Simulator
from dreamer_racing.envs.simulator.mujoco_warp import WarpSimulator
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track

BACKENDS = ("mujoco", "mujoco_warp")


def check_device(device: torch.device | str) -> None:
    """Refuse a device that does not exist or is not supported.

    Raises:
        ValueError: the message says what is available.
    """
    if str(device).partition(":")[0] not in ("cpu", "cuda"):
        raise ValueError(f"device={str(device)!r}: must be cpu or cuda.")
    device = torch.device(device)
    if device.type == "cpu":
        return
    if not torch.cuda.is_available():
        build = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        raise ValueError(
            f"device={str(device)!r}: torch {torch.__version__}, built {build}, finds no CUDA device here. Use "
            "device='cpu', or install a torch build for CUDA and NVIDIA's driver."
        )
    if (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device={str(device)!r}: there are {torch.cuda.device_count()} CUDA device(s), from cuda:0.")


def make_simulator(
    track: Track,
    parameters: QuadrotorParameters,
    num_envs: int,
    camera: Camera,
    renderer: str | None,
    num_threads: int | None,
    generator: torch.Generator,
    device: torch.device | str,
    backend: str = "auto",
    looks: LooksRandomisation | None = None,
) -> Simulator:
    """Make the simulator of a backend; `auto` chooses by device. Arguments: `RaceWorlds`; renderer=None: no images.

    Raises:
        ValueError: unknown backend, or one that does not support the device or renderer.
    """
    device = torch.device(device)
    if backend == "auto":
        backend = "mujoco" if device.type == "cpu" else "mujoco_warp"
    if backend not in BACKENDS:
        raise ValueError(f"Unknown backend {backend!r}: use auto, {', '.join(BACKENDS)}.")
    if backend == "mujoco":
        if device.type != "cpu":
            raise ValueError(f"backend='mujoco' runs on cpu, not on {str(device)!r}: set one or the other.")
        return MujocoSimulator(track, parameters, num_envs, camera, renderer, num_threads, generator, looks)
    if renderer not in (None, "auto", "warp"):
        raise ValueError(
            f"renderer={renderer!r} is for backend 'mujoco'. The backend on {str(device)!r} is 'mujoco_warp', which "
            "has its own renderer: use renderer='auto' or 'warp'."
        )
    return WarpSimulator(track, parameters, num_envs, camera, renderer is not None, device, generator, looks)
