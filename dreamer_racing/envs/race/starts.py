"""Start poses of episodes: at the start, before and behind gates, and on the racing line.

Shape legend: N drones, G race gates. SI units, world z up, quaternions wxyz.
"""

from __future__ import annotations

import dataclasses
import math

import torch

from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw, rotate, rotate_inverse, turn
from dreamer_racing.envs.race.racing_line import RacingLine
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.tracks.validation import START_CLEARANCE, flyable_box
from dreamer_racing.settings import SHARE, check_numbers, check_setting


@dataclasses.dataclass(frozen=True)
class StartPose:
    """Poses, velocities and target gates with which N episodes begin."""

    position: torch.Tensor  # (N, 3) m
    attitude: torch.Tensor  # (N, 4) unit quaternion wxyz, body → world
    linear_velocity: torch.Tensor  # (N, 3) in the world, m/s
    target_gate: torch.Tensor  # (N,) int64: the first gate to pass


class StartSampler:
    """Draws the start poses of episodes [choice].

    Evaluation episodes start at the track's start pose, at rest, with ``start_noise`` times the noise of training.
    Training episodes start there too, except a share ``at_gate``, which starts 1–3 m before a random race gate, facing
    it and flying towards its centre at 1.5–2.5 m/s. Both have uniform noise of ±0.5/0.5/0.3 m (forward/left/up of the
    pose), ±5° roll and pitch, ±10° yaw. Positions are then clipped to the free box, 0.3 m from its sides.
    ``load_track`` accepts only tracks on which neither the noise nor the clipping can move a drone across the plane of
    its first gate. If a pose would be within the frame of another gate, the drone begins at the start pose instead, at
    rest, without noise.

    A share of the drones may begin beyond a gate instead: 0.6–2 m behind a random gate, facing and flying along its
    direction at 1.5–5 m/s. They practise the turn from one gate to the next before the policy flies through the first
    well enough to get there.

    A share of the drones may begin on a racing line instead: at a random time of a lap, at a random fraction of the
    line's speed, with the attitude that this flight needs and the nose pointing ahead along the line. The position
    noise is 0.6 times the above, along the world's axes; the attitude noise is the same. Every part of a lap is
    practised from the first episode on, also turns whose gate is out of view. Reference: Peng et al. 2018,
    "DeepMimic", Section 6.2 (reference state initialisation).

    Args:
        generator: source of randomness, on the sampler's device; None for torch's own.
        beyond_gate: share of the training episodes not on the line that begin beyond a gate.
        at_gate: share of the remaining training episodes that begin before a gate.
        on_line: share of training episodes that begin on ``line``.
        line: the racing line; needed if ``on_line`` is above zero.
        start_noise: noise of evaluation starts, as a multiple of the noise of training.

    Raises:
        ValueError: a share is none, there is no line, or ``start_noise`` is negative or could carry a drone across the
            plane of its first gate.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> pose = StartSampler(load_track("circle")).sample(2, evaluation=True)
        >>> pose.position[0]
        tensor([ 4.0000, -2.5000,  1.3500])
    """

    POSITION_NOISE = (0.5, 0.5, 0.3)  # m
    ATTITUDE_NOISE_DEGREES = (5.0, 5.0, 10.0)  # roll, pitch, yaw
    GATE_DISTANCE = (1.0, 3.0)  # m before a random gate
    SPEED = (1.5, 2.5)  # m/s towards a random gate
    BEYOND_DISTANCE = (0.6, 2.0)  # m behind a random gate: more than the noise
    BEYOND_SPEED = (1.5, 5.0)  # m/s along the gate's direction
    PACE = (0.2, 1.0)  # fraction of the line's speed
    LINE_NOISE = 0.6  # factor of the position noise, below 1 to stay inside the gates that the line goes through
    LOOK_AHEAD = 0.5  # s: the nose points to the line's position this much later
    PAST_GATE = 1.0  # m around a gate's centre in which the side of its plane decides whether it has been passed

    def __init__(
        self,
        track: Track,
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        beyond_gate: float = 0.0,
        start_noise: float = 0.0,
        on_line: float = 0.0,
        line: RacingLine | None = None,
        at_gate: float = 0.5,
    ):
        check_setting("start_beyond_gate", beyond_gate, SHARE)
        check_setting("start_at_gate", at_gate, SHARE)
        _check_start_noise(start_noise, track)
        self._beyond_gate, self._at_gate = beyond_gate, at_gate
        self._line = line.to(device, dtype) if line is not None else None
        self.on_line = on_line
        self._start_noise = start_noise
        self._generator = generator
        self._device, self._dtype = device, dtype
        self._gate_positions = track.gate_positions(device, dtype)
        self._gate_normals = track.gate_normals(device, dtype)
        self._gate_yaws = track.gate_yaws(device, dtype)
        self._start_position = torch.tensor(track.start_position, device=device, dtype=dtype)
        self._start_yaw = torch.tensor(math.radians(track.start_yaw_degrees), device=device, dtype=dtype)
        level = torch.zeros_like(self._start_yaw)
        self._start_attitude = from_roll_pitch_yaw(level, level, self._start_yaw)
        self._shape, self._half_opening = track.shape, track.shape.pass_half_width
        low, high = flyable_box(track, START_CLEARANCE)
        self._low = torch.tensor(low, device=device, dtype=dtype)
        self._high = torch.tensor(high, device=device, dtype=dtype)
        self._position_noise = torch.tensor(self.POSITION_NOISE, device=device, dtype=dtype)
        self._attitude_noise = torch.tensor(self.ATTITUDE_NOISE_DEGREES, device=device, dtype=dtype).deg2rad()

    def sample(self, num: int, evaluation: bool = False) -> StartPose:
        """Draw N start poses; those of evaluation without noise draw no random numbers."""
        if evaluation:
            return self._start(num)
        pose = self._training_start(num)
        return self._put_on_line(self._line, pose) if self._line is not None and self._on_line else pose

    @property
    def on_line(self) -> float:
        """Share of training episodes that begin on the line; settable if there is a line."""
        return self._on_line

    @on_line.setter
    def on_line(self, share: float) -> None:
        check_setting("start_on_line", share, SHARE)
        if share and self._line is None:
            raise ValueError(f"start_on_line={share}: needs a racing line, line=plan_racing_line(track, parameters).")
        self._on_line = share

    def _start(self, num: int) -> StartPose:
        """Return the track's start pose, at rest, with the noise of evaluation."""
        origin, yaw = self._start_position.expand(num, 3), self._start_yaw.expand(num)
        noise = torch.zeros(num, 6, device=self._device, dtype=self._dtype)
        if self._start_noise:
            noise = noise.uniform_(-self._start_noise, self._start_noise, generator=self._generator)
        position, attitude = self._disturb(origin, yaw, noise)
        blocked = self._in_a_frame(position).unsqueeze(-1)  # of another gate than the first
        return StartPose(
            position=torch.where(blocked, self._start_position, position),
            attitude=torch.where(blocked, self._start_attitude, attitude),
            linear_velocity=torch.zeros(num, 3, device=self._device, dtype=self._dtype),
            target_gate=torch.zeros(num, dtype=torch.int64, device=self._device),
        )

    def _training_start(self, num: int) -> StartPose:
        """Draw noisy poses at the start, before random gates and behind them."""
        draw = torch.rand(num, 9, generator=self._generator, device=self._device, dtype=self._dtype)
        gate = torch.randint(len(self._gate_yaws), (num,), generator=self._generator, device=self._device)
        beyond = draw[:, 0] < self._beyond_gate  # (N,)
        at_gate = draw[:, 0] < self._beyond_gate + (1.0 - self._beyond_gate) * self._at_gate  # before or beyond one
        before = _spread(draw[:, 1], self.GATE_DISTANCE)
        distance = torch.where(beyond, -_spread(draw[:, 1], self.BEYOND_DISTANCE), before)
        speed = torch.where(beyond, _spread(draw[:, 2], self.BEYOND_SPEED), _spread(draw[:, 2], self.SPEED))
        noise = 2 * draw[:, 3:] - 1  # (N, 6)

        before_gate = self._gate_positions[gate] - distance.unsqueeze(-1) * self._gate_normals[gate]
        origin = torch.where(at_gate.unsqueeze(-1), before_gate, self._start_position)  # (N, 3)
        yaw = torch.where(at_gate, self._gate_yaws[gate], self._start_yaw)  # (N,)
        position, attitude = self._disturb(origin, yaw, noise)
        towards = torch.nn.functional.normalize(self._gate_positions[gate] - position, dim=-1)
        direction = torch.where(beyond.unsqueeze(-1), self._gate_normals[gate], towards)
        target = (gate + beyond) % len(self._gate_yaws)
        blocked = self._in_a_frame(position)
        return StartPose(
            position=torch.where(blocked.unsqueeze(-1), self._start_position, position),
            attitude=torch.where(blocked.unsqueeze(-1), self._start_attitude, attitude),
            linear_velocity=torch.where(at_gate & ~blocked, speed, 0.0).unsqueeze(-1) * direction,
            target_gate=torch.where(at_gate & ~blocked, target, 0),
        )

    def _in_a_frame(self, position: torch.Tensor) -> torch.Tensor:
        """Return whether positions (N, 3) are within a race gate's frame, as `GateSweeper` defines it, (N,) bool."""
        # (N, 1, 3) from (G, 3) -> (N, G) each
        x, y, up = (position.unsqueeze(1) - self._gate_positions).unbind(-1)
        cos, sin, _ = self._gate_normals.unbind(-1)
        forward, left = x * cos + y * sin, y * cos - x * sin
        aside = torch.maximum(left.abs(), up.abs())
        in_bars = (aside >= self._half_opening) & (aside <= self._shape.outer / 2)
        return (in_bars & (forward.abs() <= self._shape.depth / 2)).any(-1)

    def _put_on_line(self, line: RacingLine, pose: StartPose) -> StartPose:
        """Move a share of the drones onto the racing line."""
        num = len(pose.target_gate)
        draw = torch.rand(num, 9, generator=self._generator, device=self._device, dtype=self._dtype)
        noise = 2 * draw[:, 3:] - 1  # (N, 6)
        time, pace = draw[:, 1] * line.lap_time, _spread(draw[:, 2:3], self.PACE)
        reference = line.at(time)
        position = reference.position + self.LINE_NOISE * self._position_noise * noise[:, :3]
        position = torch.minimum(torch.maximum(position, self._low), self._high)
        velocity = pace * reference.velocity
        # On the same curve, acceleration scales with the square of the speed.
        force = line.dynamics.force(velocity, pace.square() * reference.acceleration)
        ahead = line.at(time + self.LOOK_AHEAD).position - reference.position
        attitude = turn(_pointing(force, ahead), self._attitude_noise * noise[:, 3:])
        on_line = ((draw[:, 0] < self._on_line) & ~self._in_a_frame(position)).unsqueeze(-1)
        return StartPose(
            position=torch.where(on_line, position, pose.position),
            attitude=torch.where(on_line, attitude, pose.attitude),
            linear_velocity=torch.where(on_line, velocity, pose.linear_velocity),
            target_gate=torch.where(on_line[:, 0], self._next_gate(line, time, position), pose.target_gate),
        )

    def _next_gate(self, line: RacingLine, time: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
        """Return the next gate (N,) of drones near the line, corrected if noise moved a drone across a gate's plane."""
        num_gates = len(self._gate_yaws)
        gate = (time.unsqueeze(-1) >= line.gate_times).sum(-1) % num_gates
        last = (gate - 1) % num_gates
        near, beyond = self._beside_gate(position, gate)
        near_last, beyond_last = self._beside_gate(position, last)
        gate = torch.where(near & beyond, (gate + 1) % num_gates, gate)
        return torch.where(near_last & ~beyond_last, last, gate)

    def _beside_gate(self, position: torch.Tensor, gate: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return which drones (N,) are near their gate's centre, and which are beyond its plane."""
        offset = position - self._gate_positions[gate]
        return offset.norm(dim=-1) < self.PAST_GATE, (offset * self._gate_normals[gate]).sum(-1) >= 0.0

    def _disturb(
        self, origin: torch.Tensor, yaw: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Add noise (N, 6) to level poses at (N, 3) with yaws (N,); return clipped positions and attitudes (N, 4).

        The noise is of forward, left, up, roll, pitch and yaw, in units of the training noise.
        """
        level = torch.zeros_like(yaw)
        position = origin + rotate(from_roll_pitch_yaw(level, level, yaw), noise[:, :3] * self._position_noise)
        position = torch.minimum(torch.maximum(position, self._low), self._high)
        roll, pitch, yaw_noise = (noise[:, 3:] * self._attitude_noise).unbind(-1)
        return position, from_roll_pitch_yaw(roll, pitch, yaw + yaw_noise)


def _check_start_noise(start_noise: float, track: Track) -> None:
    """Refuse noise that could carry a drone from the start across the plane of the first gate."""
    check_numbers({}, {"start_noise": start_noise})
    gate, start = track.gates[0], track.start_position
    ahead = sum((a - b) * c for a, b, c in zip(gate.position, start, gate.forward, strict=True))
    most = ahead / math.hypot(*StartSampler.POSITION_NOISE[:2])
    if not 0.0 <= start_noise < most:
        raise ValueError(
            f"start_noise={start_noise}: must be at least 0 and below {most:.2f} on track {track.name!r}, "
            f"where the start is {ahead:.2f} m before the plane of the first gate."
        )


def _spread(draw: torch.Tensor, interval: tuple[float, float]) -> torch.Tensor:
    """Scale draws from [0, 1) to an interval."""
    low, high = interval
    return low + (high - low) * draw


def _pointing(up: torch.Tensor, ahead: torch.Tensor) -> torch.Tensor:
    """Return attitudes (N, 4) with z along ``up`` (N, 3) and x as close to ``ahead`` (N, 3) as possible."""
    x, y, z = torch.nn.functional.normalize(up, dim=-1).unbind(-1)
    tilt = torch.nn.functional.normalize(torch.stack((1.0 + z, -y, x, torch.zeros_like(x)), -1), dim=-1)
    forward, left, _ = rotate_inverse(tilt, ahead).unbind(-1)
    half = torch.atan2(left, forward).unsqueeze(-1) / 2.0
    w, x, y, z = tilt.unbind(-1)
    # tilt times a rotation about its own z axis
    return tilt * half.cos() + torch.stack((-z, y, -x, w), dim=-1) * half.sin()
