"""One drone of this project's physics, which may differ from the one that a policy was trained on.

SI units, world z up, body frame FLU, attitude wxyz.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters, load_preset, without_randomisation
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.race import Race
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.envs.simulator.scene import build_drone
from dreamer_racing.envs.tracks import GROUND_HEIGHT, Track, load_track
from dreamer_racing.hil.vehicle import Command, Pose, at_rest
from dreamer_racing.settings import Range, setting

logger = logging.getLogger(__name__)

LIFT_OFF = 0.5  # share of a drone's weight that commanded thrust must exceed before the stand releases it [choice]

HOVER_SHARE = 0.99
"""Share of a drone's weight that must be commanded, as long, before the stand lets it sink: hover thrust, rounded."""

STAND_RADIUS = 0.1  # m from its start, sideways, within which the stand supports a released drone [choice]
SPIN_UP = 5.0  # motor lags for which that thrust must be commanded: rotors then give 98.7 % of it [choice]


@dataclass
class Mismatch:
    """How a drone differs from the nominal one of its preset."""

    mass: float = setting(1.0, Range(0.5, 2.0))  # relative; the flight controller assumes the nominal one
    thrust: float = setting(1.0, Range(0.4, 2.0))  # relative, of all rotors, as with another battery voltage
    drag: float = setting(1.0, Range(0.0, 10.0))  # relative
    motor_lag: float | None = setting(None, Range(0.001, 0.5))  # s, first order on rotor speed; null: the preset's
    delay: float | None = setting(None, Range(0.0, 0.5))  # s, from a command to its effect; null: the preset's

    def apply(self, nominal: QuadrotorParameters) -> QuadrotorParameters:
        """Return the parameters of a nominal drone with these differences."""
        x, y, z = nominal.drag
        return replace(
            nominal,
            mass=nominal.mass * self.mass,
            rotor_thrust_max=nominal.rotor_thrust_max * self.thrust,
            rate_gain=nominal.rate_gain * self.thrust,  # torques come from the same rotors
            drag=(x * self.drag, y * self.drag, z * self.drag),
            motor_time_constant=nominal.motor_time_constant if self.motor_lag is None else self.motor_lag,
            command_delay=nominal.command_delay if self.delay is None else self.delay,
        )


class PlantVehicle:
    """A drone that takes commands and flies, until it crashes.

    It begins on a stand at the track's start pose, which holds it until it is armed and commanded to more than half of
    its weight for as long as its rotors take to spin up (`LIFT_OFF`, `SPIN_UP`); at hover thrust it then stays there.
    Until it is commanded to its full weight for as long, it may slide off the stand (`STAND_RADIUS`), but not sink
    through it. Laps are timed from the release. Passes and crashes are those of `Race`, checked once a control step of
    the preset; after a crash the motors are off for good, and the drone falls to the ground and stays there.

    Args:
        track: Name, path, or a `Track`.
        preset: Name of the nominal drone's physics, or its parameters; without their randomisation.
        mismatch: Differences of this drone from it.

    Attributes:
        parameters: Of this drone.
        control_dt: Control step of the preset, s.
        time: Physics time since construction, s; a reset does not change it.
        armed: Whether motors may turn, by the command now in effect.
        on_stand: Whether the stand still holds it.
        crash: Why it crashed; `CrashCause.NONE` while it has not.
        crash_description: The same in words, with its time and whether the drone was disarmed then.
        gates_passed: Number of gates passed in order since it was last on the stand.
        lap_times: s, of the laps since then.

    Example:
        >>> from dreamer_racing.hil.vehicle import hover
        >>> vehicle = PlantVehicle("circle")
        >>> vehicle.command(Command(True, hover()))
        >>> vehicle.advance(1.0)
        >>> vehicle.pose().position.round(2)
        array([ 4.  , -2.5 ,  1.35])
    """

    def __init__(
        self, track: str | Track, preset: str | QuadrotorParameters = "faithful", mismatch: Mismatch | None = None
    ) -> None:
        self.track = load_track(track)
        nominal = without_randomisation(load_preset(preset))
        self._differs = mismatch or Mismatch()
        self.parameters = self._differs.apply(nominal)
        self.control_dt = nominal.control_dt
        self._nominal_mass = nominal.mass
        self._race = Race(self.track, num_envs=1, control_dt=self.control_dt)
        self._build()
        self._spin_up_steps = round(SPIN_UP * self.parameters.motor_time_constant / self.parameters.physics_dt)
        self._steps = 0
        self._until = 0.0  # s, requested physics time
        self.reset()

    def _build(self) -> None:
        """Build the simulation, and the two ways to fly in it: by commands, and by rotor speeds."""
        own = self.parameters
        model = build_drone(own).compile()
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # the race detects a broken state
        data = mujoco.MjData(model)

        def integrate() -> None:
            mujoco.mj_step(model, data)

        self._qpos, self._qvel = data.qpos, data.qvel
        qpos, qvel, force = (torch.from_numpy(array[None]) for array in (data.qpos, data.qvel, data.qfrc_applied))
        # a command may change at any physics step; this class delays it, and arming with it
        controller = Quadrotor(replace(own, control_dt=own.physics_dt, command_delay=0.0), 1)
        bare = replace(controller.parameters, motor_time_constant=math.inf, motor_lag_of="speed", betaflight=None)
        rotors = Quadrotor(bare, 1)
        rotors.rotor_speed = controller.rotor_speed  # with an infinite lag they stay as set
        self._by_commands = FusedFlight(controller, qpos, qvel, force, integrate)
        self._by_rotors = FusedFlight(rotors, qpos, qvel, force, integrate)
        self._setpoint = controller.setpoints[0, 0].numpy()  # (4,) N and rad/s
        self._rotor_speed = controller.rotor_speed[0].numpy()  # (4,) √N
        self._decay = controller.motor_decay
        self._rate_loop = controller.rate_loop

    def reset(self) -> None:
        """Put the drone back on the stand: whole, disarmed, rotors at rest, with no gate passed."""
        yaw = 0.5 * math.radians(self.track.start_yaw_degrees)
        self._start = np.array((*self.track.start_position, math.cos(yaw), 0.0, 0.0, math.sin(yaw)))
        self._pending: deque[tuple[int, Command]] = deque()  # physics step from which a command acts, and the command
        self._target_speed: np.ndarray | None = None  # (4,) √N, commanded by an external flight controller
        self._acceleration = np.zeros(3)
        self._lift_off_step: int | None = None
        self.on_stand, self.gates_passed = True, 0
        self._supported = True  # whether the stand keeps it from sinking, even after release
        self._hover_steps = 0  # consecutive physics steps with commanded thrust of its full weight
        self.crash, self.crash_description = CrashCause.NONE, "none"
        self.lap_times: list[float] = []
        self._rotor_speed[:], self.armed = 0.0, False
        self._act(at_rest())
        self._hold(self._start)
        self._path = [self._qpos[:3].copy()]

    @property
    def time(self) -> float:
        """Physics time since construction, s."""
        return self._steps * self.parameters.physics_dt

    @property
    def specific_force(self) -> np.ndarray:
        """Reading of an accelerometer at its centre: (3,) m/s², body frame, +9.81 upwards at rest."""
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, self._qpos[3:])
        return rotation.reshape(3, 3).T @ (self._acceleration + np.array((0.0, 0.0, GRAVITY)))

    def read_imu(self) -> np.ndarray:
        """Return the sample of an IMU at its centre: (6,) body rates, rad/s, and specific force, m/s², body frame."""
        return np.concatenate((self._qvel[3:], self.specific_force))

    def pose(self) -> Pose:
        """Return its pose and velocities at its own `time`."""
        numbers = (self._qpos[:3], self._qpos[3:], self._qvel[:3], self._qvel[3:])
        return Pose(self.time, *(array.copy() for array in numbers))

    def command(self, command: Command) -> None:
        """Queue a command, which acts after the drone's delay; body rates are clipped to the flight controller's.

        Raises:
            ValueError: It is not finite.
        """
        if not (math.isfinite(command.setpoint.collective_thrust) and np.isfinite(command.setpoint.body_rates).all()):
            raise ValueError(f"{command}: a setpoint must be finite.")
        delay = round(self.parameters.command_delay / self.parameters.physics_dt)
        self._pending.append((self._steps + delay, command))

    def turn_rotors(self, motors: np.ndarray) -> None:
        """Apply the motor commands of an external flight controller, without delay.

        Args:
            motors: (4,) in [0, 1], in Betaflight's order; thrust goes with their square. Any above 0 means armed.
        """
        self.armed = bool((motors > 0.0).any())
        self._target_speed = motors * math.sqrt(self.parameters.rotor_thrust_max)

    def cut(self) -> None:
        """Stop the motors now, whatever was commanded."""
        self._pending.clear()
        self._target_speed = None
        self._act(at_rest())

    def advance(self, seconds: float) -> None:
        """Advance by whole physics steps; fractions of a step carry over to later calls."""
        self._until += seconds
        step = self.parameters.physics_dt
        for _ in range(math.floor(self._until / step + 1e-6) - self._steps):
            self._step()

    def _act(self, command: Command) -> None:
        """Apply a command; the flight controller assumes the nominal mass and full thrust."""
        if command.armed and not self.armed and self._rate_loop is not None:
            self._rate_loop.reset(torch.ones(1, 1, dtype=torch.bool))  # integrators start at zero
        self.armed = command.armed
        limits = self.parameters.body_rate_max
        thrust = max(command.setpoint.collective_thrust, 0.0) * self._nominal_mass * self._differs.thrust
        self._setpoint[0] = thrust
        self._setpoint[1:] = np.clip(command.setpoint.body_rates, np.negative(limits), limits)

    def _step(self) -> None:
        """Make one physics step, and apply stand, race and ground."""
        while self._pending and self._pending[0][0] <= self._steps:
            self._act(self._pending.popleft()[1])
        self._steps += 1
        before = self._qvel[:3].copy()
        own_controller = self._target_speed is None and self.armed and self.crash is CrashCause.NONE
        if own_controller:
            self._by_commands.step(0)
        else:
            self._turn_and_step()
        if self._supported:
            hovers = self.armed and self._commanded_thrust() >= HOVER_SHARE * self.parameters.mass * GRAVITY
            self._hover_steps = self._hover_steps + 1 if hovers else 0
        if self.on_stand:
            self._hold(self._start)
            self._maybe_release()
        elif self.crash is CrashCause.NONE:
            if self._supported:
                self._support()
            self._check_race()
        elif not self._qpos[2] > GROUND_HEIGHT:  # also true of NaN
            self._rest_on_ground()
        self._acceleration = (self._qvel[:3] - before) / self.parameters.physics_dt

    def _turn_and_step(self) -> None:
        """Make a physics step with rotors that follow external commands, or run down."""
        given = self._target_speed if self.crash is CrashCause.NONE else None
        target = np.zeros(4) if given is None else given
        speed = self._rotor_speed.copy()
        self._rotor_speed[:] = self._follow(target, speed, math.sqrt(self._decay))  # at the step's middle
        self._by_rotors.step(0)
        self._rotor_speed[:] = self._follow(target, speed, self._decay)

    def _follow(self, target: np.ndarray, speed: np.ndarray, decay: float) -> np.ndarray:
        """Return speeds (4,) in √N on their way to a target, with the share ``decay`` of the way left."""
        if self.parameters.motor_lag_of == "speed":
            return target + decay * (speed - target)
        return np.sqrt(target**2 + decay * (speed**2 - target**2))

    def _hold(self, place: np.ndarray) -> None:
        """Keep the body at a place (7,), at rest."""
        self._qpos[:], self._qvel[:] = place, 0.0

    def _rest_on_ground(self) -> None:
        """Keep a fallen drone on the ground where it fell, or at the start if its state is not finite."""
        place = self._qpos if np.isfinite(self._qpos).all() else self._start
        self._hold(np.array((*place[:2], GROUND_HEIGHT, *place[3:])))

    def _commanded_thrust(self) -> float:
        """Return the commanded thrust, N."""
        return float(self._setpoint[0] if self._target_speed is None else np.square(self._target_speed).sum())

    def _maybe_release(self) -> None:
        """Release the drone once enough thrust has been commanded for long enough."""
        if not (self.armed and self._commanded_thrust() > LIFT_OFF * self.parameters.mass * GRAVITY):
            self._lift_off_step = None
            return
        if self._lift_off_step is None:
            self._lift_off_step = self._steps + self._spin_up_steps
        if self._steps >= self._lift_off_step:
            self.on_stand = False
            position = torch.from_numpy(self._start[:3]).unsqueeze(0)
            self._race.begin(torch.tensor([True]), position, torch.tensor([0]))
            logger.info("plant: the stand released it at %.2f s", self.time)

    def _support(self) -> None:
        """Keep a released drone that does not carry its weight yet from sinking through the stand."""
        away = self._qpos[:3] - self._start[:3]
        self._supported = self._hover_steps < self._spin_up_steps and math.hypot(*away[:2]) < STAND_RADIUS
        if self._supported and away[2] < 0.0:
            self._qpos[2], self._qvel[2] = self._start[2], max(self._qvel[2], 0.0)

    def _check_race(self) -> None:
        """Record the path of a control step, and let the race check it at the end."""
        self._path.append(self._qpos[:3].copy())
        if len(self._path) <= round(self.control_dt / self.parameters.physics_dt):
            return
        path = torch.from_numpy(np.stack(self._path)).unsqueeze(1)  # (P + 1, 1, 3)
        outcome = self._race.step(path, torch.from_numpy(self._qvel[3:]).unsqueeze(0), torch.tensor([False]))
        self._path = self._path[-1:]
        self.gates_passed = int(outcome.gates_passed)
        if outcome.lap_time > 0.0:
            self.lap_times.append(float(outcome.lap_time))
            logger.info("plant: lap %d in %.2f s", len(self.lap_times), self.lap_times[-1])
        self.crash = CrashCause(int(outcome.crash))
        if self.crash is not CrashCause.NONE:
            words = self.crash.name.lower().replace("_", " ")
            self.crash_description = f"{words} at {self.time:.2f} s" + ("" if self.armed else ", when disarmed")
            logger.info(
                "plant: crash: %s; it stays there: restart the plant for the next flight", self.crash_description
            )
