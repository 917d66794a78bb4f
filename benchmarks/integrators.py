"""How far integrators stray from RK4 in 2 s of racing, and what each costs.

    python benchmarks/integrators.py --json results/integrators.json
    python benchmarks/integrators.py --preset faithful --json results/integrators_faithful.json

The scripted pilot's actions of 2 s at racing speed on every track are replayed open loop. Two effects are told apart:

* `wrench`: a given sequence of body wrenches, each held for 2 ms, moves the rigid body. The reference is RK4 with
  0.5 ms steps under the same wrenches, so the difference is the integrator's alone.
* `loop`: rate loop and motors run with the physics step too. Errors are against `midpoint` RK4 at 1 ms (`loop_vs_1ms`)
  and at 0.1 ms (`loop_vs_limit`), which is the continuous-time drone to a few µm.

Variants: `plain` is an explicit step: the loop takes the rates at its beginning, the thrust is that of the motors'
speed at its end, in the direction of its middle. `+position` and `+pose` bring MuJoCo's x' = x + dt v' to the
trapezoidal rule after each step (position only; attitude too). `midpoint` is what the package does: `Quadrotor.wrench`
is of the middle of the step, and unless the integrator is RK4, `RigidStep` corrects torque and pose. Columns in mm are
the greatest position error over all tracks. Of `faithful` only `midpoint` is flown, at nominal parameters, and
`wrench` is left out: with drag a wrench is no given thing.
"""

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import torch
from measuring import print_table, write_json
from mujoco.batch import Batch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import PRESETS, QuadrotorParameters, without_randomisation
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rigid_step import RigidStep
from dreamer_racing.envs.drone.rotation import turn
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.simulator.scene import build_drone
from dreamer_racing.envs.tracks import PLAIN_TRACKS
from dreamer_racing.envs.worlds import RaceWorlds

SECONDS, WARM_UP = 2.0, 3.0  # s of racing replayed, and flown before, so that it is at racing speed
HOLD = 0.002  # s


class PlainQuadrotor(Quadrotor):
    """A `Quadrotor` whose loop sees the rates of the step's beginning, and whose thrust is that of its end."""

    def wrench(self, physics_step: int, attitude: Tensor, linear_velocity: Tensor, body_rates: Tensor) -> Tensor:
        """Advance controller and motors by one physics step and return the wrench at its end."""
        setpoint = self._setpoint(physics_step)
        gyroscopic = self.gyroscopic_torque(body_rates)
        torque = torch.addcmul(gyroscopic, self._rate_gain, setpoint[:, 1:] - body_rates)
        target = self.mix(setpoint[:, :1], torque).sqrt()
        self.rotor_speed = torch.lerp(target, self.rotor_speed, self.motor_decay)
        return self.rotor_speed.square() @ self._effectiveness


class Drones:
    """N drones of a variant, and their bodies in MuJoCo.

    Args:
        drone: preset.
        variant: see the head of this file.
        integrator: MuJoCo's name of it.
        step: s.
        num: N.
    """

    def __init__(self, drone: QuadrotorParameters, variant: str, integrator: str, step: float, num: int) -> None:
        # the package takes no implicit ones, and treats them as Euler
        self.parameters = replace(drone, physics_dt=step, integrator="RK4" if integrator == "RK4" else "Euler")
        midpoint = variant == "midpoint"
        self.quadrotor = (Quadrotor if midpoint else PlainQuadrotor)(self.parameters, num)
        model = build_drone(self.parameters).compile()
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        batch = Batch(model, num, min(2, num))
        self.qpos, self.qvel, force = (torch.from_numpy(batch.bind(name)) for name in ("qpos", "qvel", "qfrc_applied"))
        corrected = None if midpoint else False
        self._flight = RigidStep(self.quadrotor, self.qpos, self.qvel, force, batch.step, corrected)
        self._variant = variant

    def wrench(self, index: int) -> Tensor:
        """The drones' own wrench (N, 6) in a physics step of the control step."""
        return self.quadrotor.wrench(index, self.qpos[:, 3:], self.qvel[:, :3], self.qvel[:, 3:])

    def apply(self, wrench: Tensor) -> None:
        """Move the bodies for one physics step."""
        before = self.qvel.clone() if self._variant.startswith("+") else None
        self._flight.apply(wrench)
        if before is None:
            return
        overshoot = 0.5 * self.parameters.physics_dt * (before - self.qvel)
        self.qpos[:, :3] += overshoot[:, :3]
        if self._variant == "+pose":
            self.qpos[:, 3:] = turn(self.qpos[:, 3:], overshoot[:, 3:])


@dataclass(frozen=True)
class Recording:
    """What the pilot did with a drone on each of the tracks; N tracks."""

    drone: QuadrotorParameters
    qpos: Tensor  # (N, 7) at the beginning
    qvel: Tensor  # (N, 6)
    rotor_speed: Tensor  # (N, 4)
    actions: Tensor  # (T, N, 4)


def record(drone: QuadrotorParameters) -> Recording:
    """Fly each track for a while and record the last two seconds."""
    rows = [_record_one(track, drone) for track in PLAIN_TRACKS]
    qpos, qvel, rotor_speed, actions = zip(*rows, strict=True)
    return Recording(drone, torch.cat(qpos), torch.cat(qvel), torch.cat(rotor_speed), torch.cat(actions, dim=1))


def _record_one(track: str, drone: QuadrotorParameters) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """State at the beginning (position and attitude, velocities, rotor speeds), and the actions (T, 1, 4)."""
    worlds = RaceWorlds(track, 1, drone, evaluation=True, from_pixels=False)
    pilot = ScriptedPilot(track, drone, dtype=worlds.dtype)
    worlds.reset()
    simulator: Any = worlds.simulator
    actions = []
    warm_up, steps = (round(seconds / drone.control_dt) for seconds in (WARM_UP, SECONDS))
    for step in range(warm_up + steps):
        state = simulator.state
        if step == warm_up:
            position, attitude = state.position.clone(), state.attitude.clone()
            velocity, rates = state.linear_velocity.clone(), state.body_rates.clone()
            rotor_speed = simulator.quadrotor.rotor_speed.clone()
        actions.append(
            pilot.act(state.position, state.attitude, state.linear_velocity, state.body_rates, worlds.race.target_gate)
        )
        worlds.step(actions[-1])
    pose, velocities = torch.cat((position, attitude), dim=1), torch.cat((velocity, rates), dim=1)
    return pose, velocities, rotor_speed, torch.stack(actions[warm_up:])


def fly_loop(recording: Recording, variant: str, integrator: str, step: float) -> tuple[Tensor, Tensor]:
    """Replay the actions; return positions (T·10, N, 3) every `HOLD`, and the wrenches (T·10, N, 6) applied then."""
    drones = Drones(recording.drone, variant, integrator, step, len(PLAIN_TRACKS))
    drones.qpos[:], drones.qvel[:] = recording.qpos, recording.qvel
    drones.quadrotor.rotor_speed.copy_(recording.rotor_speed)
    every = round(HOLD / step)
    positions, wrenches = [], []
    for action in recording.actions:
        drones.quadrotor.command(action)
        for index in range(drones.parameters.physics_steps):
            wrench = drones.wrench(index)
            drones.apply(wrench)
            if (index + 1) % every == 0:
                positions.append(drones.qpos[:, :3].clone())
                wrenches.append(wrench.clone())
    return torch.stack(positions), torch.stack(wrenches)


def fly_wrenches(recording: Recording, wrenches: Tensor, variant: str, integrator: str, step: float) -> Tensor:
    """Apply wrenches (T·10, N, 6), each for `HOLD`; return the positions (T·10, N, 3)."""
    drones = Drones(recording.drone, variant, integrator, step, len(PLAIN_TRACKS))
    drones.qpos[:], drones.qvel[:] = recording.qpos, recording.qvel
    positions = []
    for wrench in wrenches:
        for _ in range(round(HOLD / step)):
            drones.apply(wrench)
        positions.append(drones.qpos[:, :3].clone())
    return torch.stack(positions)


def error_mm(positions: Tensor, reference: Tensor) -> list[float]:
    """Greatest distance per track, mm."""
    return [1000.0 * float(value) for value in (positions - reference).norm(dim=-1).amax(0)]


def cost(
    drone: QuadrotorParameters, variant: str, integrator: str, step: float, num: int = 1024
) -> tuple[float, float]:
    """µs per world and physics step, of the body (with its correction) and of controller and motors."""
    drones = Drones(drone, variant, integrator, step, num)
    drones.quadrotor.command(torch.zeros(num, 4))
    spent = []
    for _ in range(300):
        start = time.perf_counter()
        wrench = drones.wrench(0)
        middle = time.perf_counter()
        drones.apply(wrench)
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
    parser.add_argument("--preset", choices=sorted(PRESETS), default="easy")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    drone = without_randomisation(PRESETS[arguments.preset])
    bare = not any(drone.drag)
    recording = record(drone)
    reference, _ = fly_loop(recording, "midpoint", "RK4", 0.001)
    limit, _ = fly_loop(recording, "midpoint", "RK4", 0.0001)
    _, wrenches = fly_loop(recording, "midpoint", "RK4", HOLD)
    exact = fly_wrenches(recording, wrenches, "plain", "RK4", 0.0005)
    records = []
    for variant, integrator, step in [case for case in CASES if bare or case[0] == "midpoint"]:
        positions, _ = fly_loop(recording, variant, integrator, step)
        by_wrench = error_mm(fly_wrenches(recording, wrenches, variant, integrator, step), exact) if bare else None
        against_reference, against_limit = error_mm(positions, reference), error_mm(positions, limit)
        body_us, drone_us = cost(drone, variant, integrator, step)
        records.append(
            {
                "preset": arguments.preset,
                "variant": variant,
                "integrator": integrator,
                "step_ms": 1000 * step,
                "wrench": by_wrench and max(by_wrench),
                "loop_vs_1ms": max(against_reference),
                "loop_vs_limit": max(against_limit),
                "body_us": body_us,
                "drone_us": drone_us,
                "env_steps_per_s": 1e6 / (body_us + drone_us) / round(drone.control_dt / step),
                **{f"loop_vs_limit_{track}": value for track, value in zip(PLAIN_TRACKS, against_limit, strict=True)},
            }
        )
    columns = ("variant", "integrator", "step_ms", "wrench", "loop_vs_1ms", "loop_vs_limit")
    print_table(records, (*columns, "body_us", "drone_us", "env_steps_per_s"))
    write_json(records, arguments.json)


if __name__ == "__main__":
    main()
