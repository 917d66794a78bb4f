"""Evaluation of a scripted pilot: fly whole episodes and summarise them.

Shapes: N drones, L laps, T control steps. SI units.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters, load_preset, without_randomisation
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.race.race import EVALUATION_TIME, RaceStep
from dreamer_racing.envs.simulator.camera_view import is_in_view, points_in_camera
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.worlds import RaceWorlds


@dataclass(frozen=True)
class PilotStatistics:
    """Statistics of N episodes."""

    gates: Tensor  # (N,) int64, passed
    finished: Tensor  # (N,) bool: all laps, no crash
    crash: Tensor  # (N,) int64 `CrashCause`
    lap_times: Tensor  # (N, L) s; NaN if not completed; the first lap begins at rest
    speed_mean: Tensor  # (N,) m/s
    speed_max: Tensor  # (N,) m/s
    gate_offset_max: Tensor  # (N,) m
    gate_in_view: Tensor  # (N,) fraction of time with the target gate's centre in the nose camera's image


def evaluate_pilot(
    track: str | Track,
    preset: str | QuadrotorParameters = "easy",
    num_envs: int = 1,
    *,
    laps: int = 3,
    pilot: ScriptedPilot | None = None,
    randomise: bool = True,
    random_starts: bool = False,
    seed: int = 0,
    episode_steps: int | None = None,
) -> PilotStatistics:
    """Fly N complete episodes and return their statistics.

    Args:
        track: name, path or `Track`.
        preset: physics preset or parameters.
        num_envs: N.
        laps: L.
        pilot: the pilot; a `ScriptedPilot` with default limits if None.
        randomise: whether to use the preset's randomisation.
        random_starts: start as in training, instead of at the start pose.
        seed: seed of randomisation and starts.
        episode_steps: control steps until an episode is truncated; None for 30 s.
    """
    parameters = load_preset(preset)
    worlds = RaceWorlds(
        track,
        num_envs,
        parameters if randomise else without_randomisation(parameters),
        evaluation=not random_starts,
        from_pixels=False,
        episode_steps=episode_steps or round(EVALUATION_TIME / parameters.control_dt),
        seed=seed,
    )
    worlds.race.laps = laps
    pilot = pilot or ScriptedPilot(worlds.track, parameters, dtype=worlds.dtype)
    steps = _fly(worlds, pilot)
    worlds.close()
    return _summarise(steps, worlds.track.num_gates, laps)


@dataclass(frozen=True)
class _Step:
    """One control step of a flight; tensors (N,)."""

    outcome: RaceStep
    speed: Tensor  # m/s
    seen: Tensor  # bool: the target gate's centre was in view
    flew: Tensor  # bool: the episode had not ended before


def _fly(worlds: RaceWorlds, pilot: ScriptedPilot) -> list[_Step]:
    """Fly one complete episode in every world."""
    pilot.reset()
    worlds.reset()
    flying = torch.ones(worlds.num_envs, dtype=torch.bool, device=worlds.device)
    steps = []
    while flying.any():
        state, gate = worlds.simulator.state, worlds.race.target_gate
        seen = _in_view(worlds, state.position, state.attitude)
        outcome = worlds.step(pilot.act(state.position, state.attitude, state.linear_velocity, state.body_rates, gate))
        steps.append(_Step(outcome, worlds.simulator.state.linear_velocity.norm(dim=-1), seen, flying))
        flying = flying & ~(outcome.terminated | outcome.truncated)
    return steps


def _in_view(worlds: RaceWorlds, position: Tensor, attitude: Tensor) -> Tensor:
    """Return whether the target gate's centre is inside the nose camera's image, (N,); occlusion is ignored."""
    gates = worlds.track.gate_positions(position.device, position.dtype)[worlds.race.target_gate]
    seen = points_in_camera(position, attitude, gates.unsqueeze(1), worlds.camera)  # (N, 1, 3)
    return is_in_view(seen, worlds.camera).squeeze(1)


def _summarise(steps: list[_Step], num_gates: int, laps: int) -> PilotStatistics:
    """Compute the statistics of a flight from its control steps."""
    flew = torch.stack([step.flew for step in steps])  # (T, N)
    time = flew.sum(0)

    def outcomes(name: str) -> Tensor:
        return torch.stack([getattr(step.outcome, name) for step in steps]) * flew

    speed = torch.stack([step.speed for step in steps]) * flew
    gates, lap_time = outcomes("gates_passed"), outcomes("lap_time")
    at_lap = (gates // num_gates).unsqueeze(-1)  # (T, N, 1)
    lap_times = (lap_time.unsqueeze(-1) * (at_lap == torch.arange(1, laps + 1, device=speed.device))).amax(0)  # (N, L)
    return PilotStatistics(
        gates=gates.amax(0),
        finished=outcomes("finished").any(0),
        crash=outcomes("crash").amax(0),
        lap_times=torch.where(lap_times > 0.0, lap_times, math.nan),
        speed_mean=speed.sum(0) / time,
        speed_max=speed.amax(0),
        gate_offset_max=outcomes("gate_offset").amax(0),
        gate_in_view=(torch.stack([step.seen for step in steps]) & flew).sum(0) / time,
    )
