"""Comparison of the simulation backends: positions after seconds of racing, and images of the same poses.

    python benchmarks/parity.py --json results/parity.json --images docs/media/renderers.png
    python benchmarks/parity.py --device cuda --json results/parity_cuda.json

The scripted pilot flies each track in the C engine (`mujoco`); its actions are replayed, open loop, in `mujoco_warp` on
the device. `mm_1s` and `mm_2s` are the distances after 1 s and 2 s. Then both render the poses of that flight:
`image_difference` is the mean absolute difference to MuJoCo's OpenGL renderer, of 255, `image_psnr` in dB, and
`ray_casters` the difference to the same ray caster on CPU. `renderer_difference` is the difference between
`--renderer`, a name in `RENDERERS`, and OpenGL. `--images` writes some pairs for inspection.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from measuring import make_parser, report
from PIL import Image
from torch import Tensor

from dreamer_racing.envs.drone.parameters import load_preset, without_randomisation
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.simulator.rendering import RENDERERS
from dreamer_racing.envs.simulator.simulators import MujocoSimulator, Simulator, WarpSimulator
from dreamer_racing.envs.tracks import PLAIN_TRACKS, load_track
from dreamer_racing.envs.worlds import RaceWorlds

SECONDS = 2
VIEWS = 16  # poses rendered per flight
COLUMNS = ("track", "preset", "device", "mm_1s", "mm_2s", "image_difference", "image_psnr", "ray_casters",
           "renderer_difference")  # fmt: skip


def main() -> None:
    """Compare the backends on every track."""
    parser = make_parser(__doc__)
    parser.add_argument("--device", default="cpu", help="device of mujoco_warp")
    parser.add_argument("--renderer", default="warp", choices=RENDERERS, help="renderer to compare with OpenGL, too")
    parser.add_argument("--images", help="PNG of image pairs: OpenGL above, mujoco_warp below")
    arguments = parser.parse_args()
    records, pairs = [], []
    for preset in ("easy", "faithful"):
        for track in PLAIN_TRACKS:
            record, pair = compare(track, preset, arguments.device, arguments.renderer)
            records.append(record)
            pairs.append(pair)
    report(records, COLUMNS, arguments.json)
    if arguments.images:
        sheet = np.concatenate(pairs[: len(PLAIN_TRACKS)], axis=1)
        Path(arguments.images).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(sheet).resize((2 * sheet.shape[1], 2 * sheet.shape[0]), Image.Resampling.NEAREST).save(
            arguments.images
        )


def compare(track: str, preset: str, device: str, renderer: str) -> tuple[dict[str, Any], np.ndarray]:
    """Return one record, and three pairs of images side by side."""
    parameters = without_randomisation(load_preset(preset))
    worlds = RaceWorlds(track, 1, parameters, evaluation=True, from_pixels=False)
    worlds.reset()
    other = WarpSimulator(worlds.track, parameters, 1, device=device)
    other.load_state_dict(worlds.simulator.state_dict())
    pilot = ScriptedPilot(track, parameters, dtype=worlds.dtype)
    errors, poses = [], []
    for _ in range(round(SECONDS / parameters.control_dt)):
        state = worlds.simulator.state
        action = pilot.act(
            state.position, state.attitude, state.linear_velocity, state.body_rates, worlds.race.target_gate
        )
        worlds.step(action)
        other.step(action.to(device))
        errors.append(1000 * (other.state.position.cpu() - state.position).norm().item())
        poses.append((state.position.clone(), state.attitude.clone()))
    drawn = images(track, parameters, poses[:: len(poses) // VIEWS], device, renderer)
    worlds.close()
    opengl, cast, on_cpu = (drawn[name].double() for name in ("egl", "mujoco_warp", "warp"))
    psnr = 10 * torch.log10(255**2 / (opengl - cast).square().mean())
    record = {
        "benchmark": "parity", "track": track, "preset": preset, "device": device,
        "mm_1s": errors[len(errors) // SECONDS - 1], "mm_2s": errors[-1],
        "image_difference": (opengl - cast).abs().mean().item(), "image_psnr": psnr.item(),
        "ray_casters": (cast - on_cpu).abs().mean().item(),
        "renderer": renderer, "renderer_difference": (opengl - drawn[renderer].double()).abs().mean().item(),
    }  # fmt: skip
    chosen = range(0, VIEWS, VIEWS // 3)[:3]
    rows = [np.concatenate([drawn[name][index].numpy() for index in chosen], axis=1) for name in ("egl", "mujoco_warp")]
    return record, np.concatenate(rows)


def images(
    track: str, parameters: Any, poses: list[tuple[Tensor, Tensor]], device: str, renderer: str
) -> dict[str, Tensor]:
    """Render the poses with OpenGL, both ray casters and the requested renderer; return images by name."""
    position, attitude = (torch.cat(values) for values in zip(*poses, strict=True))
    num, built = len(position), load_track(track)
    names = dict.fromkeys(("egl", "warp", renderer))
    simulators: dict[str, Simulator] = {n: MujocoSimulator(built, parameters, num, renderer=n) for n in names}
    simulators["mujoco_warp"] = WarpSimulator(built, parameters, num, device=device)
    drawn = {}
    for name, simulator in simulators.items():
        everyone = torch.ones(num, dtype=torch.bool, device=simulator.device)
        place = (value.to(simulator.device) for value in (position, attitude, torch.zeros(num, 3)))
        simulator.reset(everyone, *place)
        drawn[name] = simulator.render().cpu()
        simulator.close()
    return drawn


if __name__ == "__main__":
    main()
