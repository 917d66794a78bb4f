"""Evaluation of a scripted pilot: fly whole episodes and summarise them.

Shapes: N drones, L laps, T control steps. SI units.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters, load_preset
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.race.race import EVALUATION_TIME
from dreamer_racing.envs.simulator.rendering import is_in_view, points_in_camera
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
    random_starts: bool = False,
    seed: int = 0,
) -> PilotStatistics:
    """Fly N complete episodes and return their statistics.

    Args:
        track: name, path or `Track`.
        preset: physics preset or parameters.
        num_envs: N.
        laps: L.
        pilot: the pilot; a `ScriptedPilot` with default limits if None.
        random_starts: start as in training, instead of at the start pose.
        seed: seed of randomisation and starts.
    """
    parameters = load_preset(preset)
    worlds = RaceWorlds(
        track,
        num_envs,
        parameters,
        evaluation=not random_starts,
        from_pixels=False,
        episode_steps=round(EVALUATION_TIME / parameters.control_dt),
        seed=seed,
    )
    worlds.race.laps = laps
    pilot = pilot or ScriptedPilot(worlds.track, parameters, dtype=worlds.dtype)
    steps, time = _fly(worlds, pilot)
    worlds.close()
    at_lap = (steps["gates_passed"] // worlds.track.num_gates).unsqueeze(-1)  # (T, N, 1)
    of_lap = at_lap == torch.arange(1, laps + 1, device=worlds.device)  # (T, N, L)
    lap_times = (steps["lap_time"].unsqueeze(-1) * of_lap).amax(0)  # (N, L)
    return PilotStatistics(
        gates=steps["gates_passed"].amax(0),
        finished=steps["finished"].any(0),
        crash=steps["crash"].amax(0),
        lap_times=torch.where(lap_times > 0.0, lap_times, math.nan),
        speed_mean=steps["speed"].sum(0) / time,
        speed_max=steps["speed"].amax(0),
        gate_offset_max=steps["gate_offset"].amax(0),
        gate_in_view=steps["seen"].sum(0) / time,
    )


def _fly(worlds: RaceWorlds, pilot: ScriptedPilot) -> tuple[dict[str, Tensor], Tensor]:
    """Fly one episode in every world; return its steps (T, N), zero after its end, and its number of steps (N,)."""
    pilot.reset()
    worlds.reset()
    names = ("gates_passed", "lap_time", "finished", "crash", "gate_offset")
    centres = worlds.track.gate_positions(worlds.device, worlds.dtype)
    state, flying, steps = worlds.simulator.state, torch.ones_like(worlds.race.target_gate, dtype=torch.bool), []
    while flying.any():
        gate = worlds.race.target_gate
        in_camera = points_in_camera(state.position, state.attitude, centres[gate].unsqueeze(1), worlds.camera)
        seen = is_in_view(in_camera, worlds.camera).squeeze(1)  # the target gate's centre; occlusion is ignored
        outcome = worlds.step(pilot.act(state.position, state.attitude, state.linear_velocity, state.body_rates, gate))
        values = {name: getattr(outcome, name) for name in names}
        values |= {"speed": state.linear_velocity.norm(dim=-1), "seen": seen, "flew": flying}
        steps.append({name: value * flying for name, value in values.items()})
        flying = flying & ~(outcome.terminated | outcome.truncated)
    stacked = {name: torch.stack([step[name] for step in steps]) for name in steps[0]}
    flew = stacked.pop("flew")
    return stacked, flew.sum(0)
