"""Fly a track with a scripted pilot and look at it: lap times, a plot from above, an on-board video and a small GIF.

    python recipes/fly.py track=kidney preset=easy pilot=scripted run_dir=runs/fly

`viewer=true` opens MuJoCo's interactive viewer instead, which needs a display. The pilot sees the true state, not
images: it shows what a track asks for, and what lap times are in reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import hydra
import torch
from command_line import CONFIG_DIR, plain_errors, start_logging
from hydra.core.config_store import ConfigStore
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from dreamer_racing.envs.pilot import PilotPolicy, ScriptedPilot
from dreamer_racing.envs.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation import Trajectory, evaluate
from dreamer_racing.plotting import plot_top_down
from dreamer_racing.recording import onboard_beside_map, write_gif, write_video

GIF_SIZE = 256  # pixels, side of either picture
GIF_STRIDE = 2  # of 50 control steps a second: 25 frames a second
GIF_STEPS = 300  # if no lap was completed

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass
class FlyConfig:
    """`recipes/fly.py`."""

    track: str = "kidney"  # name of a built-in track, or path to a YAML file
    preset: str = "easy"  # physics: easy | faithful
    pilot: str = "scripted"  # scripted | hover
    run_dir: str = "runs/fly"
    image_size: int = 64  # pixels, side of the nose camera's image; 64 is what the agent sees
    renderer: str = "auto"  # auto | egl | osmesa | warp
    viewer: bool = False  # watch in MuJoCo's viewer instead of writing files
    seed: int = 0


ConfigStore.instance().store(name="fly_schema", node=FlyConfig)


def scripted(env: DroneRacingEnv) -> Policy:
    """The planning pilot."""
    return PilotPolicy(ScriptedPilot(env.track, env.worlds.parameters))


def hover(env: DroneRacingEnv) -> Policy:
    """Stay where the start is."""
    action = torch.zeros(*env.batch_size, 4)
    action[:, 0] = env.worlds.parameters.hover_action
    return TensorDictModule(lambda position: action.clone(), [("privileged", "position")], ["action"])


PILOTS: dict[str, Callable[[DroneRacingEnv], Policy]] = {"scripted": scripted, "hover": hover}


def one_lap(trajectory: Trajectory) -> Trajectory:
    """Cut out the second lap, which begins and ends at racing speed; the beginning if there is none."""
    gate = trajectory.target_gate
    wraps = (torch.nonzero((gate[1:] == 0) & (gate[:-1] != 0)).flatten() + 1).tolist()
    first, last = (wraps[0], wraps[1]) if len(wraps) > 1 else (0, min(GIF_STEPS, len(gate) - 1))
    rows = slice(first, last + 1)
    names = ("position", "attitude", "linear_velocity", "target_gate", "pixels")
    values = {name: getattr(trajectory, name)[rows] for name in names}
    whole = last == len(gate) - 1
    return replace(trajectory, **values, action=trajectory.action[first:last], outcome=trajectory.outcome if whole else None)


def fly(config: FlyConfig) -> None:
    """Fly one episode and write what there is to see."""
    with plain_errors():
        if config.pilot not in PILOTS:
            raise ValueError(f"pilot={config.pilot}: there are {', '.join(PILOTS)}.")
        if config.image_size < 1 or GIF_SIZE % config.image_size:
            raise ValueError(f"image_size={config.image_size}: must divide {GIF_SIZE}, for instance 64, 128 or 256.")
        camera = Camera(width=config.image_size, height=config.image_size)
        env = DroneRacingEnv(
            config.track, 1, preset=config.preset, seed=config.seed, evaluation=True, camera=camera, renderer=config.renderer
        )
    print(f"{config.pilot} pilot, {env.track.name} track, {env.track.laps} laps, physics {config.preset}")
    result = evaluate(env, PILOTS[config.pilot](env), episodes=1)
    env.close()
    print(result.summary())
    print(f"{'laps':<18} {', '.join(f'{time:.2f} s' for time in result.lap_times) or 'none'}")
    write(Path(config.run_dir), env, result.trajectories[0])
    (Path(config.run_dir) / "evaluation.json").write_text(result.to_json())


def write(directory: Path, env: DroneRacingEnv, trajectory: Trajectory) -> None:
    """Write plot, video and GIF, and say where."""
    assert trajectory.pixels is not None
    plot, video, gif = directory / "top_down.png", directory / "onboard.mp4", directory / "onboard.gif"
    plot_top_down(env.track, trajectory, plot)
    write_video(video, trajectory.pixels, fps=1 / trajectory.control_dt)
    frames = onboard_beside_map(env.track, one_lap(trajectory), GIF_SIZE)[::GIF_STRIDE]
    size = write_gif(gif, frames, fps=1 / trajectory.control_dt / GIF_STRIDE)
    print(f"wrote {plot}, {video}, {gif} ({size / 1e6:.2f} MB)")


def watch(config: FlyConfig) -> None:
    """Open the interactive viewer, if this machine has a display."""
    from dreamer_racing.envs.viewer import ViewerUnavailableError, check_viewer, view

    try:
        check_viewer()
        with plain_errors():
            pilot = VIEWER_PILOTS[config.pilot](config)
        view(config.track, config.preset, pilot, evaluation=True)
    except ViewerUnavailableError as error:
        print(f"error: {error} viewer=false writes a plot, a video and a GIF instead.", file=sys.stderr)
        raise SystemExit(2) from error


@hydra.main(version_base="1.3", config_path=str(CONFIG_DIR), config_name="fly")
def main(config: FlyConfig) -> None:
    start_logging()
    if config.viewer:
        watch(config)
    else:
        fly(config)


if __name__ == "__main__":
    main()
