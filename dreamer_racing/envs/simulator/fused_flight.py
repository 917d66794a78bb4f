"""A physics step as two warp kernels: controller, motors and corrections around MuJoCo's own step of the rigid bodies.

The proportional controller acts on the body rates half a step ahead, rotors have their mid-step speeds, and the force
its mid-step direction. Still, MuJoCo's Euler step is first order: v' = v + h·a(x, v), then x' = x + h·v', which
accumulates an error of 7 cm over two seconds of racing. Two corrections make it second order (docs/simulation.md has
the figures): the torque is corrected for the difference between the gyroscopic torques at the start and in the middle
of the step, and half of the overshoot h·(v' − v) is subtracted from the pose. RK4 needs neither.

The wrench gives a body of *nominal* mass and inertia the acceleration of the randomised drone, so that all worlds share
one MuJoCo model. `tests/torch_flight.py` states the same in torch; the kernels take a tenth of its time on a CPU, and
a third of the nodes of a CUDA graph.

Shapes: N drones, P physics steps per control step. SI units, attitude wxyz, body frame FLU.
"""

# warp evaluates annotations, which mypy does not accept as types: no `from __future__ import annotations` here
# mypy: disable-error-code="valid-type,index,no-untyped-def"

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.envs.drone import rate_loop
from dreamer_racing.envs.drone.parameters import GRAVITY, ROTOR_SPINS
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rate_loop import DroneParameter
from dreamer_racing.envs.drone.rotation import rotate_inverse
from dreamer_racing.envs.simulator.warp_device import load_warp


class FusedFlight:
    """Simulates N quadrotors with MuJoCo's rigid bodies and fused kernels; on CUDA, within `warp_device.scope`.

    Args:
        quadrotor: controllers and motors, whose tensors are updated in place.
        qpos: (N, 7) view of MuJoCo's positions and attitudes.
        qvel: (N, 6) view of MuJoCo's velocities and body rates.
        qfrc_applied: (N, 6) view of MuJoCo's applied force (world frame) and torque (body frame).
        integrate: makes one physics step with the current `qfrc_applied`.

    Attributes:
        qvel_before: (N, 6) `qvel` before the last physics step, to be set to `qvel` where an episode begins.
    """

    def __init__(
        self, quadrotor: Quadrotor, qpos: Tensor, qvel: Tensor, qfrc_applied: Tensor, integrate: Callable[[], None]
    ) -> None:
        warp = load_warp()
        apply_controls, correct_step, struct = make_kernels(qpos.dtype)
        steps, num_drones = quadrotor.parameters.physics_steps, len(qpos)
        self._integrate, self._qpos, self._qvel, self._dt = integrate, qpos, qvel, quadrotor.parameters.physics_dt
        self._path = torch.empty(steps + 1, num_drones, 3, dtype=qpos.dtype, device=qpos.device)
        self.qvel_before = before = torch.zeros_like(qvel, memory_format=torch.contiguous_format)
        arrays = [warp.from_torch(tensor) for tensor in (qpos, qvel, quadrotor.rotor_speed, quadrotor.setpoints)]
        own = [*map(warp.from_torch, quadrotor.drones.values()), *rate_loop.arrays(quadrotor.rate_loop, qpos)]
        constants = _constants(quadrotor, struct)
        force, saved, path = (warp.from_torch(tensor) for tensor in (qfrc_applied, before, self._path))
        effort = warp.from_torch(quadrotor.effort)
        device = warp.device_from_torch(qpos.device)
        self._apply_controls, self._correct_step = (
            [
                warp.launch(kernel, num_drones, inputs=[index, constants, *inputs], device=device, record_cmd=True)
                for index in range(steps)
            ]
            for kernel, inputs in (
                (apply_controls, [*arrays, *own, effort, force, saved]),
                (correct_step, [*arrays[:2], saved, path]),
            )
        )

    def fly(self) -> Tensor:
        """Simulate one control step with the current command; return the positions (P + 1, N, 3)."""
        self._path[0] = self._qpos[:, :3]
        for index in range(len(self._apply_controls)):
            self.step(index)
        return self._path.clone()

    def step(self, physics_step: int) -> None:
        """Simulate one physics step, given its index in the control step; a larger index is taken as the last."""
        index = min(physics_step, len(self._apply_controls) - 1)
        self._apply_controls[index].launch()
        self._integrate()
        self._correct_step[index].launch()

    def ideal_imu(self) -> Tensor:
        """Return ideal gyro and accelerometer measurements of each drone: body rates and specific force (N, 6).

        At its centre, in rad/s and m/s², body frame; the specific force is (0, 0, 9.81) at rest. It is that of the last
        physics step; after a reset, that of an unaccelerated drone.
        """
        change = self._qvel[:, :3] - self.qvel_before[:, :3]
        change[:, 2] += GRAVITY * self._dt
        return torch.cat((self._qvel[:, 3:], rotate_inverse(self._qpos[:, 3:], change / self._dt)), dim=1)


def _constants(quadrotor: Quadrotor, struct: Any) -> Any:
    """Fill the kernels' struct of constants common to all drones."""
    p = quadrotor.parameters
    x, y = zip(*p.rotor_positions, strict=True)
    constants = struct()
    constants.physics_steps = p.physics_steps
    constants.oldest = len(quadrotor.setpoints) - 1
    constants.perturbed = int(any(p.drag) or p.randomisation is not None)
    constants.corrected = int(p.integrator != "RK4")
    idle = 0.0 if p.betaflight is None else p.betaflight.motor_idle
    constants.limit, constants.low = p.rotor_thrust_max, p.rotor_thrust_max * idle**2
    constants.decay, constants.decay_half = quadrotor.motor_decay, quadrotor.motor_decay**0.5
    constants.half_step = 0.5 * p.physics_dt
    constants.rate_gain = p.rate_gain
    constants.controlled = int(quadrotor.rate_loop is not None)
    if quadrotor.rate_loop is not None:
        constants.firmware = quadrotor.rate_loop.constants
    constants.lag_of_thrust = int(p.motor_lag_of == "thrust")
    constants.mass, constants.gravity = p.mass, (0.0, 0.0, -GRAVITY)
    constants.inertia, constants.drag = p.inertia, p.drag
    constants.rotor_x, constants.rotor_y = x, y
    constants.rotor_yaw = rotor_yaw = [spin * p.torque_constant for spin in ROTOR_SPINS]
    # thrust and torques x, y, z of a unit thrust of each rotor; the inverse's first row is a quarter each
    effectiveness = [(1.0, left, -ahead, yaw) for ahead, left, yaw in zip(x, y, rotor_yaw, strict=True)]
    allocation = torch.linalg.inv(torch.tensor(effectiveness, dtype=torch.float64))  # (4, 4)
    constants.from_roll, constants.from_pitch, constants.from_yaw = allocation[1:].tolist()
    return constants


@cache
def make_kernels(dtype: torch.dtype) -> tuple[Any, Any, Any]:
    """Make both kernels and the struct of constants of all drones, for a type of numbers.

    `apply_controls` runs controller and motors for a physics step and writes the force and torque that MuJoCo applies;
    `correct_step` corrects MuJoCo's Euler step and stores the position. warp compiles them at the first launch.
    """
    wp = load_warp()
    real = wp.dtype_from_torch(dtype)
    vec3, vec4 = wp.types.vector(3, real), wp.types.vector(4, real)
    Firmware, motor_commands = rate_loop.make_kernels(dtype)[:2]

    @wp.struct
    class Constants:
        firmware: Firmware
        controlled: int  # whether there is a Betaflight flight controller
        lag_of_thrust: int  # whether thrusts have first-order lag, or speeds
        physics_steps: int
        oldest: int  # index of the oldest command kept
        perturbed: int  # whether there is drag, or drones are randomised
        corrected: int  # whether MuJoCo's step is first order and is corrected
        limit: real  # N, maximum thrust of a rotor
        low: real  # N, minimum thrust of a rotor
        decay: real  # factor of a rotor's deviation from its target per physics step
        decay_half: real  # per half step
        half_step: real  # s
        rate_gain: real  # 1/s
        mass: real  # kg
        gravity: vec3  # m/s²
        inertia: vec3
        drag: vec3
        rotor_x: vec4
        rotor_y: vec4
        rotor_yaw: vec4  # N m of yaw torque per N
        from_roll: vec4  # rotor thrusts per N m
        from_pitch: vec4
        from_yaw: vec4

    @wp.func
    def gyroscopic(c: Constants, rates: vec3) -> vec3:
        return wp.cross(rates, wp.cw_mul(c.inertia, rates))

    @wp.func
    def torque_of(c: Constants, thrusts: vec4) -> vec3:
        return vec3(wp.dot(thrusts, c.rotor_y), -wp.dot(thrusts, c.rotor_x), wp.dot(thrusts, c.rotor_yaw))

    @wp.func
    def half_a_step_later(c: Constants, rates: vec3, torque: vec3) -> vec3:
        return rates + c.half_step * wp.cw_div(torque - gyroscopic(c, rates), c.inertia)

    @wp.func
    def rotate(w: real, v: vec3, vector: vec3) -> vec3:
        cross = real(2.0) * wp.cross(v, vector)
        return vector + w * cross + wp.cross(v, cross)

    @wp.func
    def mix(c: Constants, thrust: real, torque: vec3) -> vec4:
        # at the limits yaw torque is reduced first, then total thrust, and roll and pitch last, together [choice]
        roll_pitch = torque[0] * c.from_roll + torque[1] * c.from_pitch
        low, high = wp.min(roll_pitch), wp.max(roll_pitch)
        scale = real(1.0)
        if high - low > c.limit:
            scale = c.limit / (high - low)
        each = wp.min(wp.max(real(0.25) * thrust, -scale * low), c.limit - scale * high)
        yaw = torque[2] * c.from_yaw
        share = real(1.0)
        for rotor in range(4):
            base = each + scale * roll_pitch[rotor]
            room = base
            if yaw[rotor] > real(0.0):
                room = c.limit - base
            share = wp.min(share, wp.max(room, real(0.0)) / wp.max(wp.abs(yaw[rotor]), real(1.0e-12)))
        thrusts = vec4()
        for rotor in range(4):
            thrusts[rotor] = wp.clamp(each + scale * roll_pitch[rotor] + share * yaw[rotor], real(0.0), c.limit)
        return thrusts

    @wp.func
    def accumulate_effort(c: Constants, i: int, step: int, asked: real, target: vec4, effort: wp.array2d(dtype=real)):
        share = real(1.0) / real(c.physics_steps)
        at_limit = real(0.0)
        if wp.min(target) <= c.low + real(1.0e-6) or wp.max(target) >= c.limit - real(1.0e-6):
            at_limit = real(1.0)
        missing = wp.max(asked - (target[0] + target[1] + target[2] + target[3]), real(0.0))
        if step == 0:
            for column in range(3):
                effort[i, column] = real(0.0)
        effort[i, 0] = effort[i, 0] + share * at_limit
        effort[i, 1] = effort[i, 1] + share * asked
        effort[i, 2] = effort[i, 2] + share * missing

    @wp.func
    def turn_rotors(
        c: Constants,
        i: int,
        target: vec4,
        speed: vec4,
        decay: real,
        decay_half: real,
        rotor_speed: wp.array2d(dtype=real),
    ):  # moves rotors towards target thrusts; returns the thrusts at mid-step
        if c.lag_of_thrust != 0:
            lag = wp.cw_mul(speed, speed) - target
            for rotor in range(4):
                rotor_speed[i, rotor] = wp.sqrt(target[rotor] + decay * lag[rotor])
            return target + decay_half * lag
        goal = vec4()
        for rotor in range(4):
            goal[rotor] = wp.sqrt(target[rotor])
            rotor_speed[i, rotor] = goal[rotor] + decay * (speed[rotor] - goal[rotor])
        middle = goal + decay_half * (speed - goal)
        return wp.cw_mul(middle, middle)

    # the wrench that gives the nominal body the acceleration of the randomised drone
    @wp.func
    def randomised_force(
        c: Constants, thrust: vec3, velocity: vec3, rates: vec3, gravity: vec3, mass: real, drag: real
    ):
        now = (thrust - drag * wp.cw_mul(c.drag, velocity)) / mass
        middle = velocity + c.half_step * (now / c.mass + gravity - wp.cross(rates, velocity))
        return (thrust - drag * wp.cw_mul(c.drag, middle)) / mass

    @wp.func
    def randomised_torque(c: Constants, torque: vec3, rates: vec3, factors: vec3):
        own_gyroscopic = wp.cross(rates, wp.cw_mul(wp.cw_mul(factors, c.inertia), rates))
        return wp.cw_div(torque - own_gyroscopic, factors) + gyroscopic(c, rates)

    @wp.kernel(module="unique", enable_backward=False)
    def apply_controls(
        physics_step: int,
        c: Constants,
        qpos: wp.array2d(dtype=real),
        qvel: wp.array2d(dtype=real),
        rotor_speed: wp.array2d(dtype=real),
        setpoints: wp.array3d(dtype=real),
        mass: wp.array2d(dtype=real),
        inertia: wp.array2d(dtype=real),
        drag: wp.array2d(dtype=real),
        thrust_factor: wp.array2d(dtype=real),
        torque_factor: wp.array2d(dtype=real),
        delay_steps: wp.array(dtype=wp.int64),
        memory: wp.array2d(dtype=vec3),
        own: wp.array2d(dtype=vec3),
        effort: wp.array2d(dtype=real),
        qfrc_applied: wp.array2d(dtype=real),
        before: wp.array2d(dtype=real),
    ):
        i = wp.tid()
        late = wp.max(int(delay_steps[i]) - physics_step, 0)
        age = wp.min((late + c.physics_steps - 1) / c.physics_steps, c.oldest)
        wanted = vec3(setpoints[age, i, 1], setpoints[age, i, 2], setpoints[age, i, 3])
        w, v = qpos[i, 3], vec3(qpos[i, 4], qpos[i, 5], qpos[i, 6])
        rates = vec3(qvel[i, 3], qvel[i, 4], qvel[i, 5])
        speed = vec4(rotor_speed[i, 0], rotor_speed[i, 1], rotor_speed[i, 2], rotor_speed[i, 3])
        decay, decay_half, sag = real(c.decay), real(c.decay_half), real(0.0)
        target = vec4()  # thrusts
        if c.controlled != 0:
            commands = motor_commands(c.firmware, i, setpoints[age, i, 0], wanted, rates, memory, own)
            target = c.limit * wp.cw_mul(commands, commands)
            motors = own[i, DroneParameter.MOTORS]
            decay, decay_half, sag = motors[0], motors[1], motors[2]
        else:
            middle_rates = half_a_step_later(c, rates, torque_of(c, wp.cw_mul(speed, speed)))
            torque = gyroscopic(c, middle_rates) + c.rate_gain * wp.cw_mul(c.inertia, wanted - middle_rates)
            target = mix(c, setpoints[age, i, 0], torque)
        accumulate_effort(c, i, physics_step, setpoints[age, i, 0], target, effort)
        thrusts = turn_rotors(c, i, target, speed, decay, decay_half, rotor_speed)
        load = real(0.25) * (thrusts[0] + thrusts[1] + thrusts[2] + thrusts[3]) / c.limit
        thrusts = (real(1.0) - sag * load) * thrusts
        force = vec3(real(0.0), real(0.0), thrusts[0] + thrusts[1] + thrusts[2] + thrusts[3])
        torque = torque_of(c, thrusts)

        if c.perturbed != 0:
            velocity, gravity = rotate(w, -v, vec3(qvel[i, 0], qvel[i, 1], qvel[i, 2])), rotate(w, -v, c.gravity)
            force = randomised_force(c, thrust_factor[i, 0] * force, velocity, rates, gravity, mass[i, 0], drag[i, 0])
            torque = thrust_factor[i, 0] * vec3(torque[0], torque[1], torque_factor[i, 0] * torque[2])
            torque = randomised_torque(c, torque, rates, vec3(inertia[i, 0], inertia[i, 1], inertia[i, 2]))

        # rotate the force to its mid-step direction, and correct the torque for the mid-step gyroscopic torque
        middle_rates = half_a_step_later(c, rates, torque)
        force = rotate(w, v, force + c.half_step * wp.cross(middle_rates, force))
        if c.corrected != 0:
            torque = torque + gyroscopic(c, rates) - gyroscopic(c, middle_rates)
        for axis in range(3):
            qfrc_applied[i, axis] = force[axis]
            qfrc_applied[i, axis + 3] = torque[axis]
        for axis in range(6):
            before[i, axis] = qvel[i, axis]

    @wp.kernel(module="unique", enable_backward=False)
    def correct_step(
        physics_step: int,
        c: Constants,
        qpos: wp.array2d(dtype=real),
        qvel: wp.array2d(dtype=real),
        before: wp.array2d(dtype=real),
        path: wp.array3d(dtype=real),
    ):
        i = wp.tid()
        if c.corrected != 0:
            for axis in range(3):
                qpos[i, axis] = qpos[i, axis] + c.half_step * (before[i, axis] - qvel[i, axis])
            half = vec3()
            for axis in range(3):
                half[axis] = real(0.5) * c.half_step * (before[i, axis + 3] - qvel[i, axis + 3])
            w, v = qpos[i, 3], vec3(qpos[i, 4], qpos[i, 5], qpos[i, 6])
            turned = v + w * half + wp.cross(v, half)
            attitude = wp.normalize(vec4(w - wp.dot(v, half), turned[0], turned[1], turned[2]))
            for axis in range(4):
                qpos[i, axis + 3] = attitude[axis]
        for axis in range(3):
            path[physics_step + 1, i, axis] = qpos[i, axis]

    return apply_controls, correct_step, Constants
