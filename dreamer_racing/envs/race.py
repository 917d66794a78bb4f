"""Episodes of N drones on one track: target gates, laps, time, rewards, and where an episode starts.

Shape legend: N drones, P physics steps per control step, G race gates. SI units, world z up, quaternions wxyz.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import torch

from dreamer_racing.envs.gates import CrashCause, GateSweeper
from dreamer_racing.envs.rewards import RewardWeights, race_reward
from dreamer_racing.envs.rotation import from_roll_pitch_yaw, rotate
from dreamer_racing.envs.tracks import Track
from dreamer_racing.envs.tracks.validation import START_CLEARANCE, flyable_box

EPISODE_STEPS = 1000
"""Control steps after which a training episode is truncated: 20 s [choice]."""

EVALUATION_STEPS = 1500
"""The same in evaluation: 30 s, because three laps of split_s take a good pilot 22 s [choice]."""


@dataclasses.dataclass(frozen=True)
class RaceStep:
    """What one control step did to each drone; every tensor is (N,)."""

    reward_base: torch.Tensor
    """float: the reward at b₂ = 0 (Eq. 1)."""
    body_rate_norm: torch.Tensor
    """float: ‖ω‖ where Eq. 1 has a rate term, 0 on a pass or crash, rad/s."""
    terminated: torch.Tensor
    """bool: the drone crashed."""
    truncated: torch.Tensor
    """bool: out of time, or the last lap is complete; never together with ``terminated``."""
    passed: torch.Tensor
    """bool: the target gate was passed in this step."""
    gates_passed: torch.Tensor
    """int64: gates passed in this episode."""
    gate_offset: torch.Tensor
    """float: distance from the gate's centre at a pass in this step, else 0, m."""
    lap_time: torch.Tensor
    """float: duration of the lap completed in this step, else 0, s."""
    crash: torch.Tensor
    """int64: ``CrashCause``, 0 while flying."""
    finished: torch.Tensor
    """bool: the last lap was completed, without a crash in the same step."""
    target_gate: torch.Tensor
    """int64: the gate to pass next, after this step."""


class Race:
    """Keeps the episode of each of N drones.

    A lap is G passes, from whichever gate the episode began. Lap 1 is timed from the start of the episode, a later lap
    from the completion of the one before; times are whole control steps. A pass that comes before a crash in the same
    step counts (gate, lap time), but the reward is the collision's and the episode is terminated.

    Args:
        track: the track.
        num_envs: number of drones N.
        weights: the weights of Eq. 1.
        episode_steps: control steps after which an episode is truncated.
        laps: laps after which an episode is truncated as finished (evaluation); None to fly until time is up.
        control_dt: duration of a control step, s.
        device: where all tensors live.
        dtype: floating-point type of positions and rewards.

    Example:
        >>> race = Race(load_track("circle"), num_envs=1)
        >>> start = torch.tensor([[4.0, -2.5, 1.35]])
        >>> race.begin(torch.tensor([True]), start, torch.tensor([0]))
        >>> path = torch.stack((start, start + torch.tensor([0.0, 0.1, 0.0])))
        >>> race.step(path, torch.zeros(1, 3), torch.tensor([False])).reward_base
        tensor([0.1000])
    """

    _EPISODE = ("target_gate", "gates_passed", "step_count", "lap_start_step", "position")

    def __init__(
        self,
        track: Track,
        num_envs: int,
        weights: RewardWeights | None = None,
        episode_steps: int = EPISODE_STEPS,
        laps: int | None = None,
        control_dt: float = 0.02,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        self.track = track
        self.weights = weights or RewardWeights()
        self.episode_steps = episode_steps
        self.laps = laps
        self.control_dt = control_dt
        self._sweep = GateSweeper(track, device, dtype)
        self._gate_positions = track.gate_positions(device, dtype)
        self._dtype = dtype

        def zeros() -> torch.Tensor:
            return torch.zeros(num_envs, dtype=torch.int64, device=device)

        # all stay in place, so that a CUDA graph can advance them
        self.target_gate = zeros()  # (N,) gate to pass next
        self.gates_passed = zeros()  # (N,) in this episode
        self.step_count = zeros()  # (N,) control steps of this episode
        self.lap_start_step = zeros()  # (N,) step at which the present lap began
        self.position = torch.zeros(num_envs, 3, dtype=dtype, device=device)  # (N, 3) at the last control step, m

    def begin(self, mask: torch.Tensor, position: torch.Tensor, target_gate: torch.Tensor) -> None:
        """Begin an episode for some of the drones and leave the others alone.

        Args:
            mask: which drones begin, (N,) bool.
            position: where they begin, (N, 3), m; read only where masked.
            target_gate: the first gate to pass, (N,) int64; read only where masked.
        """
        self.position.copy_(torch.where(mask.unsqueeze(-1), position.to(self._dtype), self.position))
        self.target_gate.copy_(torch.where(mask, target_gate, self.target_gate))
        self.gates_passed.masked_fill_(mask, 0)
        self.step_count.masked_fill_(mask, 0)
        self.lap_start_step.masked_fill_(mask, 0)

    def step(self, path: torch.Tensor, body_rates: torch.Tensor, invalid_action: torch.Tensor) -> RaceStep:
        """Judge one control step and advance every episode by it.

        Args:
            path: positions at the start of the step and after each physics step, (P + 1, N, 3), m.
            body_rates: angular velocity at the end of the step, (N, 3), rad/s.
            invalid_action: the action was not finite, (N,) bool: a crash before the step's path, whose events are void.

        Returns:
            The outcome for each drone; its tensors are not changed by later steps.
        """
        path, body_rates = path.to(self._dtype), body_rates.to(self._dtype)
        passed, gate_offset, crash = self._judge(path, body_rates, invalid_action)
        crashed = crash != CrashCause.NONE
        reward_base, body_rate_norm = race_reward(
            self.weights,
            self._gate_positions[self.target_gate],
            self.position,
            path[-1],
            body_rates,
            passed,
            crashed,
        )
        lap_complete, lap_time = self._advance(passed, path[-1])
        if self.laps is None:
            finished = torch.zeros_like(crashed)
        else:
            finished = lap_complete & ~crashed & (self.gates_passed >= self.laps * self.track.num_gates)
        return RaceStep(
            reward_base=reward_base,
            body_rate_norm=body_rate_norm,
            terminated=crashed,
            truncated=~crashed & (finished | (self.step_count >= self.episode_steps)),
            passed=passed,
            gates_passed=self.gates_passed.clone(),
            gate_offset=gate_offset,
            lap_time=lap_time,
            crash=crash,
            finished=finished,
            target_gate=self.target_gate.clone(),
        )

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return where every episode stands."""
        return {name: getattr(self, name).clone() for name in self._EPISODE}

    def load_state_dict(self, state_dict: Mapping[str, torch.Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name in self._EPISODE:
            getattr(self, name).copy_(state_dict[name])

    def _judge(
        self, path: torch.Tensor, body_rates: torch.Tensor, invalid_action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return passes, offsets and crashes (N,) of the path, the action before it and the body rates after it."""
        passed, offset, crash = self._sweep(path, self.target_gate)
        rates_lost = (crash == CrashCause.NONE) & ~body_rates.isfinite().all(-1)
        crash = crash.masked_fill(rates_lost, CrashCause.NON_FINITE_STATE)
        crash = crash.masked_fill(invalid_action, CrashCause.INVALID_ACTION)
        return passed & ~invalid_action, offset.masked_fill(invalid_action, 0.0), crash

    def _advance(self, passed: torch.Tensor, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Move every episode on by one control step; return which laps it completed and their times (N,), s."""
        num_gates = self.track.num_gates
        self.position.copy_(position)
        self.step_count += 1
        self.gates_passed += passed
        self.target_gate.add_(passed).remainder_(num_gates)
        lap_complete = passed & (self.gates_passed % num_gates == 0)
        lap_steps = self.step_count - self.lap_start_step
        lap_time = torch.where(lap_complete, lap_steps * self.control_dt, 0.0).to(self._dtype)
        self.lap_start_step.copy_(torch.where(lap_complete, self.step_count, self.lap_start_step))
        return lap_complete, lap_time


@dataclasses.dataclass(frozen=True)
class StartPose:
    """Where episodes begin."""

    position: torch.Tensor
    """(N, 3) m."""
    attitude: torch.Tensor
    """(N, 4) unit quaternion wxyz, body → world."""
    linear_velocity: torch.Tensor
    """(N, 3) in the world, m/s."""
    target_gate: torch.Tensor
    """(N,) int64: the first gate to pass."""


class StartSampler:
    """Draws the poses in which episodes begin [choice].

    Evaluation starts at the track's start pose, at rest; ``start_noise`` adds that many times the noise of training. In
    training half of the drones start there too and half
    1–3 m before a random race gate, facing it and flying towards its centre at 1.5–2.5 m/s; all of them with uniform
    noise of ±0.5/0.5/0.3 m (forward/left/up of the pose), ±5° roll and pitch, ±10° yaw. Positions are then moved into
    the free box, 0.3 m from its sides. ``load_track`` accepts only tracks on which neither the noise nor this move can
    carry a drone across the plane of its first gate.

    A share of the drones may begin beyond a gate instead: 0.6–2 m behind a random one, facing and flying along its
    direction at 1.5–5 m/s, to the next gate. They practise the turn from one gate to the next before the policy flies
    through the first well enough to get there.

    Args:
        track: the track.
        generator: source of randomness, on the sampler's device; None for torch's own.
        device: where the poses are wanted.
        dtype: floating-point type of the poses.
        beyond_gate: share of training episodes that begin beyond a gate; the others are as above.
        start_noise: of evaluation starts, as a multiple of the noise of training.

    Raises:
        ValueError: ``beyond_gate`` is not a share, or ``start_noise`` is negative or could carry a drone across the
            plane of its first gate.

    Example:
        >>> pose = StartSampler(load_track("circle")).sample(2, evaluation=True)
        >>> pose.position[0]
        tensor([ 4.0000, -2.5000,  1.3500])
    """

    POSITION_NOISE = (0.5, 0.5, 0.3)  # m
    ATTITUDE_NOISE_DEGREES = (5.0, 5.0, 10.0)  # roll, pitch, yaw
    GATE_DISTANCE = (1.0, 3.0)  # m before a random gate
    SPEED = (1.5, 2.5)  # m/s towards a random gate
    BEYOND_DISTANCE = (0.6, 2.0)  # m behind a random gate: more than the noise
    BEYOND_SPEED = (1.5, 5.0)  # m/s along its direction

    def __init__(
        self,
        track: Track,
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        beyond_gate: float = 0.0,
        start_noise: float = 0.0,
    ):
        if not 0.0 <= beyond_gate <= 1.0:
            raise ValueError(f"beyond_gate={beyond_gate}: a share of episodes lies between 0 and 1.")
        _check_start_noise(start_noise, track)
        self._beyond_gate = beyond_gate
        self._start_noise = start_noise
        self._generator = generator
        self._device, self._dtype = device, dtype
        self._gate_positions = track.gate_positions(device, dtype)
        self._gate_normals = track.gate_normals(device, dtype)
        self._gate_yaws = track.gate_yaws(device, dtype)
        self._start_position = torch.tensor(track.start_position, device=device, dtype=dtype)
        self._start_yaw = torch.tensor(math.radians(track.start_yaw_degrees), device=device, dtype=dtype)
        low, high = flyable_box(track, START_CLEARANCE)
        self._low = torch.tensor(low, device=device, dtype=dtype)
        self._high = torch.tensor(high, device=device, dtype=dtype)
        self._position_noise = torch.tensor(self.POSITION_NOISE, device=device, dtype=dtype)
        self._attitude_noise = torch.tensor(self.ATTITUDE_NOISE_DEGREES, device=device, dtype=dtype).deg2rad()

    def sample(self, num: int, evaluation: bool = False) -> StartPose:
        """Draw start poses.

        Args:
            num: number of poses N.
            evaluation: the track's start pose; without noise it draws nothing from the generator.
        """
        return self._start(num) if evaluation else self._training_start(num)

    def _start(self, num: int) -> StartPose:
        """Return the track's start pose, at rest, with the noise of evaluation."""
        origin, yaw = self._start_position.expand(num, 3), self._start_yaw.expand(num)
        noise = torch.zeros(num, 6, device=self._device, dtype=self._dtype)
        if self._start_noise:
            noise = noise.uniform_(-self._start_noise, self._start_noise, generator=self._generator)
        position, attitude = self._disturb(origin, yaw, noise)
        return StartPose(
            position=position,
            attitude=attitude,
            linear_velocity=torch.zeros(num, 3, device=self._device, dtype=self._dtype),
            target_gate=torch.zeros(num, dtype=torch.int64, device=self._device),
        )

    def _training_start(self, num: int) -> StartPose:
        """Draw noisy poses at the start, before random gates and beyond them."""
        draw = torch.rand(num, 9, generator=self._generator, device=self._device, dtype=self._dtype)
        gate = torch.randint(len(self._gate_yaws), (num,), generator=self._generator, device=self._device)
        beyond = draw[:, 0] < self._beyond_gate  # (N,)
        at_gate = draw[:, 0] < 0.5 * (1.0 + self._beyond_gate)
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
        return StartPose(
            position=position,
            attitude=attitude,
            linear_velocity=torch.where(at_gate, speed, 0.0).unsqueeze(-1) * direction,
            target_gate=torch.where(at_gate, target, 0),
        )

    def _disturb(
        self, origin: torch.Tensor, yaw: torch.Tensor, noise: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Move level poses by noise (N, 6) in units of training's, and into the free box.

        Args:
            origin: (N, 3) m.
            yaw: (N,) rad.
            noise: forward, left, up, roll, pitch, yaw.

        Returns:
            Positions (N, 3) and attitudes (N, 4).
        """
        level = torch.zeros_like(yaw)
        position = origin + rotate(from_roll_pitch_yaw(level, level, yaw), noise[:, :3] * self._position_noise)
        position = torch.minimum(torch.maximum(position, self._low), self._high)
        roll, pitch, yaw_noise = (noise[:, 3:] * self._attitude_noise).unbind(-1)
        return position, from_roll_pitch_yaw(roll, pitch, yaw + yaw_noise)


def _check_start_noise(start_noise: float, track: Track) -> None:
    """Refuse noise that could carry a drone from the start across the plane of the first gate."""
    gate, start = track.gates[0], track.start_position
    ahead = sum((a - b) * c for a, b, c in zip(gate.position, start, gate.forward, strict=True))
    most = ahead / math.hypot(*StartSampler.POSITION_NOISE[:2])
    if not 0.0 <= start_noise < most:
        raise ValueError(
            f"start_noise={start_noise}: on track {track.name!r}, whose start is {ahead:.2f} m before the plane of the "
            f"first gate, at least 0 and below {most:.2f} times the noise of training."
        )


def _spread(draw: torch.Tensor, interval: tuple[float, float]) -> torch.Tensor:
    """Spread draws from [0, 1) over an interval."""
    low, high = interval
    return low + (high - low) * draw
