"""How far integrators of preset `easy` stray from RK4 in 2 s of racing, and what each costs.

    python benchmarks/integrators.py --json results/integrators.json

The scripted pilot's actions of 2 s at racing speed on every track are replayed open loop. Two effects are told apart:

* `wrench`: a given sequence of body wrenches, each held for 2 ms, moves the rigid body. The reference is RK4 with
  0.5 ms steps under the same wrenches, so the difference is the integrator's alone.
* `loop`: rate loop and motors run with the physics step too. Errors are against RK4 at 1 ms (`loop_vs_1ms`), and
  against `midpoint` RK4 at 0.1 ms (`loop_vs_limit`), which is the continuous-time drone to a few µm.

Variants: `plain` is the code as it is. `+position` and `+pose` correct MuJoCo's x' = x + dt v' to the trapezoidal rule
after each step (position only; attitude too). `midpoint` also evaluates the motors, the rates in the loop and the
direction of the force at the middle of the step. Columns in mm are the greatest position error over all tracks.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from measuring import print_table, write_json
from mujoco.batch import Batch
from torch import Tensor

from dreamer_racing.envs.pilot import ScriptedPilot
from dreamer_racing.envs.quadrotor import PRESETS, Quadrotor, QuadrotorParameters
from dreamer_racing.envs.pilot import _turn as turn
from dreamer_racing.envs.scene import build_scene
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.envs.worlds import RaceWorlds

TRACKS = ("circle", "kidney", "figure8", "split_s")
SECONDS, WARM_UP = 2.0, 3.0  # s of racing replayed, and flown before, so that it is at racing speed
HOLD = 0.002  # s
EASY = PRESETS["easy"]
CORRECTIONS = {"plain": "", "+position": "position", "+pose": "pose", "midpoint": "midpoint"}


class MidpointQuadrotor(Quadrotor):
    """A `Quadrotor` whose wrench is that of the middle of the step."""

    def wrench(self, physics_step: int, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor) -> Tensor:
        """Advance controller and motors by one physics step and return the wrench of its middle."""
        half = 0.5 * self.parameters.physics_dt
        setpoint = self._setpoint(physics_step)
        torque_now = self.rotor_speed.square() @ self._effectiveness[:, 3:]
        rates = middle_rates(body_rates, torque_now, self._inertia, half)
        gyroscopic = torch.linalg.cross(rates, self._inertia * rates)
        torque = torch.addcmul(gyroscopic, self._rate_gain, setpoint[:, 1:] - rates)
        target = self.mix(setpoint[:, :1], torque).sqrt()
        middle = torch.lerp(target, self.rotor_speed, self._motor_decay**0.5)
        self.rotor_speed = torch.lerp(target, self.rotor_speed, self._motor_decay)
        return middle.square() @ self._effectiveness


def middle_rates(body_rates: Tensor, torque: Tensor, inertia: Tensor, half: float) -> Tensor:
    """Body rates (N, 3) in rad/s half a step of `half` s later, under a torque (N, 3) in N m."""
    gyroscopic = torch.linalg.cross(body_rates, inertia * body_rates)
    return body_rates + half * (torque - gyroscopic) / inertia


@dataclass
class Body:
    """N rigid bodies in MuJoCo."""

    parameters: QuadrotorParameters
    correction: str  # "", "position", "pose" or "midpoint"
    num: int

    def __post_init__(self) -> None:
        self._batch = Batch(build_scene(load_track("circle"), self.parameters).compile(), self.num, min(2, self.num))
        self.qpos = torch.from_numpy(self._batch.bind("qpos"))
        self.qvel = torch.from_numpy(self._batch.bind("qvel"))
        self._inertia = torch.tensor(self.parameters.inertia, dtype=torch.float64)
        self._ctrl = torch.from_numpy(self._batch.bind("ctrl"))

    def step(self, wrench: Tensor) -> None:
        """Move by one physics step."""
        self._ctrl.copy_(self._midpoint(wrench) if self.correction == "midpoint" else wrench)
        before = self.qvel.clone() if self.correction else None
        self._batch.step()
        if before is None:
            return
        overshoot = (-0.5 * self.parameters.physics_dt) * (self.qvel - before)
        self.qpos[:, :3] += overshoot[:, :3]
        if self.correction != "position":
            self.qpos[:, 3:] = turn(self.qpos[:, 3:], overshoot[:, 3:])

    def _midpoint(self, wrench: Tensor) -> Tensor:
        """The wrench that does in an Euler step, which takes attitude and rates at its beginning, what this one would
        do with those in the middle.
        """
        half = 0.5 * self.parameters.physics_dt
        force, torque = wrench[:, :3], wrench[:, 3:]
        rates = middle_rates(self.qvel[:, 3:], torque, self._inertia, half)
        force = force + half * torch.linalg.cross(rates, force)
        momentum = torch.linalg.cross(self.qvel[:, 3:], self._inertia * self.qvel[:, 3:])
        torque = torque + momentum - torch.linalg.cross(rates, self._inertia * rates)
        return torch.cat((force, torque), dim=1)


@dataclass(frozen=True)
class Recording:
    """What the pilot did on each of the tracks; N tracks."""

    qpos: Tensor  # (N, 7) at the beginning
    qvel: Tensor  # (N, 6)
    rotor_speed: Tensor  # (N, 4)
    actions: Tensor  # (T, N, 4)


def record() -> Recording:
    """Fly each track for a while and record the last two seconds."""
    rows = [list(_record_one(track)) for track in TRACKS]
    start = [torch.cat([row[0][i] for row in rows]) for i in range(3)]
    return Recording(*start, torch.stack([torch.cat(row[1:]) for row in rows], dim=1))


def _record_one(track: str) -> Iterator[Any]:
    """Yield the state at the beginning, then the actions (1, 4)."""
    worlds = RaceWorlds(track, 1, EASY, evaluation=True, from_pixels=False)
    pilot = ScriptedPilot(track, EASY, dtype=worlds.dtype)
    worlds.reset()
    simulator: Any = worlds.simulator
    warm_up, steps = (round(seconds / EASY.control_dt) for seconds in (WARM_UP, SECONDS))
    for step in range(warm_up + steps):
        if step == warm_up:
            yield simulator._qpos.clone(), simulator._qvel.clone(), simulator.quadrotor.rotor_speed.clone()
        state = simulator.state
        action = pilot.act(
            state.position, state.attitude, state.linear_velocity, state.body_rates, worlds.race.target_gate
        )
        if step >= warm_up:
            yield action
        worlds.step(action)


def make(variant: str, integrator: str, step: float, num: int) -> tuple[Body, Quadrotor]:
    """Body and drone of a variant; `step` in s."""
    parameters = replace(EASY, physics_dt=step, integrator=integrator)
    correction = CORRECTIONS[variant] if integrator != "RK4" else ""
    drone = MidpointQuadrotor if variant == "midpoint" else Quadrotor
    return Body(parameters, correction, num), drone(parameters, num)


def fly_loop(recording: Recording, variant: str, integrator: str, step: float) -> tuple[Tensor, Tensor]:
    """Replay the actions; return positions (T·10, N, 3) every `HOLD`, and the wrenches applied then."""
    body, drone = make(variant, integrator, step, len(TRACKS))
    body.qpos[:], body.qvel[:] = recording.qpos, recording.qvel
    drone.rotor_speed = recording.rotor_speed
    every = round(HOLD / step)
    positions, wrenches = [], []
    for action in recording.actions:
        drone.command(action)
        for index in range(body.parameters.physics_steps):
            wrench = drone.wrench(index, body.qpos[:, 3:], body.qvel[:, :3], body.qvel[:, 3:])
            body.step(wrench)
            if (index + 1) % every == 0:
                positions.append(body.qpos[:, :3].clone())
                wrenches.append(wrench.clone())
    return torch.stack(positions), torch.stack(wrenches)


def fly_wrenches(recording: Recording, wrenches: Tensor, variant: str, integrator: str, step: float) -> Tensor:
    """Apply wrenches (T·10, N, 6), each for `HOLD`; return the positions (T·10, N, 3)."""
    body, _ = make(variant, integrator, step, len(TRACKS))
    body.qpos[:], body.qvel[:] = recording.qpos, recording.qvel
    positions = []
    for wrench in wrenches:
        for _ in range(round(HOLD / step)):
            body.step(wrench)
        positions.append(body.qpos[:, :3].clone())
    return torch.stack(positions)


def error_mm(positions: Tensor, reference: Tensor) -> list[float]:
    """Greatest distance per track, mm."""
    return [1000.0 * float(value) for value in (positions - reference).norm(dim=-1).amax(0)]


def cost(variant: str, integrator: str, step: float, num: int = 1024) -> tuple[float, float]:
    """µs per world and physics step, of the body (with its correction) and of controller and motors."""
    body, drone = make(variant, integrator, step, num)
    drone.command(torch.zeros(num, 4))
    spent = []
    for _ in range(300):
        start = time.perf_counter()
        wrench = drone.wrench(0, body.qpos[:, 3:], body.qvel[:, :3], body.qvel[:, 3:])
        middle = time.perf_counter()
        body.step(wrench)
        spent.append((time.perf_counter() - middle, middle - start))
    # the median, because other processes disturb
    body_seconds, drone_seconds = torch.tensor(spent).median(0).values.tolist()
    return 1e6 * body_seconds / num, 1e6 * drone_seconds / num


CASES = (
    ("plain", "Euler", 0.002),
    ("plain", "implicitfast", 0.002),
    ("+position", "Euler", 0.002),
    ("+pose", "Euler", 0.002),
    ("midpoint", "Euler", 0.002),
    ("midpoint", "implicitfast", 0.002),
    ("plain", "RK4", 0.002),
    ("midpoint", "RK4", 0.002),
    ("plain", "Euler", 0.001),
    ("midpoint", "Euler", 0.001),
    ("plain", "RK4", 0.001),
    ("midpoint", "RK4", 0.001),
    ("plain", "RK4", 0.0005),
    ("midpoint", "RK4", 0.0005),
)


def main() -> None:
    """Replay through every case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    recording = record()
    reference, _ = fly_loop(recording, "plain", "RK4", 0.001)
    limit, _ = fly_loop(recording, "midpoint", "RK4", 0.0001)
    _, wrenches = fly_loop(recording, "plain", "RK4", HOLD)
    exact = fly_wrenches(recording, wrenches, "plain", "RK4", 0.0005)
    records = []
    for variant, integrator, step in CASES:
        positions, _ = fly_loop(recording, variant, integrator, step)
        by_wrench = error_mm(fly_wrenches(recording, wrenches, variant, integrator, step), exact)
        against_reference, against_limit = error_mm(positions, reference), error_mm(positions, limit)
        body_us, drone_us = cost(variant, integrator, step)
        records.append(
            {
                "variant": variant,
                "integrator": integrator,
                "step_ms": 1000 * step,
                "wrench": max(by_wrench),
                "loop_vs_1ms": max(against_reference),
                "loop_vs_limit": max(against_limit),
                "body_us": body_us,
                "drone_us": drone_us,
                "env_steps_per_s": 1e6 / (body_us + drone_us) / round(EASY.control_dt / step),
                **{f"loop_vs_limit_{track}": value for track, value in zip(TRACKS, against_limit, strict=True)},
            }
        )
    columns = ("variant", "integrator", "step_ms", "wrench", "loop_vs_1ms", "loop_vs_limit")
    print_table(records, (*columns, "body_us", "drone_us", "env_steps_per_s"))
    write_json(records, arguments.json)


if __name__ == "__main__":
    main()
