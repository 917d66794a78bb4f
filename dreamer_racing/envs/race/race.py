"""Race rules for N drones on one track: target gates, laps, time, the reward of Eq. 1, and the race vector.

The reward is split in two parts so that a replayed step can be given the current body-rate weight. The race vector, in
the drone's body frame, is for state-based policies and losses with privileged inputs.

Shape legend: N drones, P physics steps per control step, G race gates. SI units, of the vector before scaling; world z
up, body frame FLU, quaternions wxyz. Reference: paper, Eq. 1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import align, rotate, rotate_inverse
from dreamer_racing.envs.race.gates import CrashCause, GateSweeper
from dreamer_racing.envs.simulator.simulators import DroneState
from dreamer_racing.envs.tracks import Track
from dreamer_racing.settings import FINITE, check_settings, quoted, setting

EPISODE_TIME = 20.0
"""Time after which a training episode is truncated, s [choice]."""

MAX_SPEED = 50.0
"""Speed up to which two gates passed in one control step both count, m/s: a thrust of 2.7 times the weight plus the
weight, over 30 m without drag, gives 47 [choice]."""

EVALUATION_TIME = 30.0
"""Time after which an evaluation episode is truncated, s: three laps of split_s take a good pilot 22 s [choice]."""

RACE_VECTOR_SIZE = 21
VELOCITY, RATES, DISTANCE = 5.0, 5.0, 4.0  # m/s, rad/s, m
RACE_VECTOR_ENTRIES = (
    ("linear velocity of the drone", "m/s", VELOCITY),
    ("body rates of the drone", "rad/s", RATES),
    ("direction of the world's up", "1", 1.0),
    ("from the drone to the centre of the target gate", "m", DISTANCE),
    ("direction of flight through the target gate", "1", 1.0),
    ("from the drone to the centre of the gate after it", "m", DISTANCE),
    ("direction of flight through the gate after it", "1", 1.0),
)
"""Meaning, unit and divisor of each triple x, y, z of a race vector, all in the body frame."""


@dataclasses.dataclass(frozen=True)
class RaceStep:
    """Outcome of one control step for each drone; every tensor is (N,)."""

    reward_base: Tensor
    """float: the reward at b₂ = 0 (Eq. 1)."""
    body_rate_norm: Tensor
    """float: ‖ω‖ in steps in which Eq. 1 has a rate term, 0 on a pass or crash, rad/s."""
    terminated: Tensor
    """bool: the drone crashed."""
    truncated: Tensor
    """bool: out of time, or the last lap is complete; never together with ``terminated``."""
    passes: Tensor
    """int64: gates passed in this step; 2 only if gates lie within a control step's reach of each other."""
    gates_passed: Tensor
    """int64: gates passed in this episode."""
    gate_offset: Tensor
    """float: distance from the gate's centre at a pass in this step, else 0, m."""
    lap_time: Tensor
    """float: duration of the lap completed in this step, else 0, s."""
    crash: Tensor
    """int64: ``CrashCause``, 0 while flying."""
    finished: Tensor
    """bool: the last lap was completed, without a crash in the same step."""
    target_gate: Tensor
    """int64: the gate to pass next, after this step."""

    def reward(self, body_rate_weight: float) -> Tensor:
        """Return the reward (N,) for a body-rate weight b₂. Reference: paper, Eq. 1."""
        return self.reward_base - body_rate_weight * self.body_rate_norm


class Race:
    """Tracks the race progress of N drones and computes their rewards.

    A lap is G passes, whichever gate the episode began at. Lap 1 is timed from the start of the episode, a later lap
    from the completion of the previous one; times are whole control steps. A pass before a crash in the same step
    counts (gate, lap time), but the reward is the collision's and the episode is terminated.

    Args:
        weights: the weights of Eq. 1.
        episode_steps: control steps after which an episode is truncated; None for 20 s.
        laps: laps after which an episode is truncated as finished (evaluation); None to fly until time is up.
        miss_radius: see `GateSweeper`.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
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
        episode_steps: int | None = None,
        laps: int | None = None,
        control_dt: float = 0.02,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        miss_radius: float = 0.0,
    ):
        if not isinstance(weights, RewardWeights | None):
            raise ValueError(f"weights={quoted(weights)}: must be RewardWeights, from dreamer_racing.envs.race.race.")
        self.track = track
        self.weights = weights or RewardWeights()
        if episode_steps is not None and episode_steps < 1:
            raise ValueError(f"episode_steps={episode_steps}: must be at least 1.")
        self.episode_steps = round(EPISODE_TIME / control_dt) if episode_steps is None else episode_steps
        self.laps = laps
        self.control_dt = control_dt
        self._sweep = GateSweeper(track, device, dtype, miss_radius, reach=MAX_SPEED * control_dt)
        self.gate_positions = track.gate_positions(device, dtype)  # (G, 3) m
        self.gate_normals = track.gate_normals(device, dtype)  # (G, 3)
        self._dtype = dtype

        def zeros() -> Tensor:
            return torch.zeros(num_envs, dtype=torch.int64, device=device)

        # updated in place, so that a CUDA graph can advance them
        self.target_gate = zeros()  # (N,) gate to pass next
        self.gates_passed = zeros()  # (N,) in this episode
        self.step_count = zeros()  # (N,) control steps of this episode
        self.lap_start_step = zeros()  # (N,) step at which the current lap began
        self.position = torch.zeros(num_envs, 3, dtype=dtype, device=device)  # (N, 3) at the last control step, m

    def begin(self, mask: Tensor, position: Tensor, target_gate: Tensor) -> None:
        """Begin episodes where masked (N,) bool, at positions (N, 3) in m, with the first gates to pass (N,) int64."""
        self.position.copy_(torch.where(mask.unsqueeze(-1), position.to(self._dtype), self.position))
        self.target_gate.copy_(torch.where(mask, target_gate, self.target_gate))
        self.gates_passed.masked_fill_(mask, 0)
        self.step_count.masked_fill_(mask, 0)
        self.lap_start_step.masked_fill_(mask, 0)

    def step(self, path: Tensor, body_rates: Tensor, invalid_action: Tensor) -> RaceStep:
        """Apply the rules to one control step and advance every episode.

        Args:
            path: positions at the start of the step and after each physics step, (P + 1, N, 3), m.
            body_rates: angular velocity at the end of the step, (N, 3), rad/s.
            invalid_action: the action was not finite, (N,) bool: a crash that voids all events of the step's path.

        Returns:
            The outcome for each drone; its tensors are not changed by later steps.
        """
        path, body_rates = path.to(self._dtype), body_rates.to(self._dtype)
        passes, gate_offset, crash = self._judge(path, body_rates, invalid_action)
        crashed = crash != CrashCause.NONE
        gate = self.gate_positions[self.target_gate]
        reward_base, body_rate_norm = race_reward(
            self.weights, gate, self.position, path[-1], body_rates, passes, crashed
        )
        lap_complete, lap_time = self._advance(passes, path[-1])
        if self.laps is None:
            finished = torch.zeros_like(crashed)
        else:
            finished = lap_complete & ~crashed & (self.gates_passed >= self.laps * len(self.gate_positions))
        return RaceStep(
            reward_base=reward_base,
            body_rate_norm=body_rate_norm,
            terminated=crashed,
            truncated=~crashed & (finished | (self.step_count >= self.episode_steps)),
            passes=passes,
            gates_passed=self.gates_passed.clone(),
            gate_offset=gate_offset,
            lap_time=lap_time,
            crash=crash,
            finished=finished,
            target_gate=self.target_gate.clone(),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return the progress of every episode."""
        return {name: getattr(self, name).clone() for name in self._EPISODE}

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name in self._EPISODE:
            getattr(self, name).copy_(state_dict[name])

    def _judge(self, path: Tensor, body_rates: Tensor, invalid_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return passes, offsets and crashes (N,), from the path, a non-finite action and non-finite body rates."""
        passes, offset, crash = self._sweep(path, self.target_gate)
        rates_lost = (crash == CrashCause.NONE) & ~body_rates.isfinite().all(-1)
        crash = crash.masked_fill(rates_lost, CrashCause.NON_FINITE_STATE)
        crash = crash.masked_fill(invalid_action, CrashCause.INVALID_ACTION)
        return passes.masked_fill(invalid_action, 0), offset.masked_fill(invalid_action, 0.0), crash

    def _advance(self, passes: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Advance every episode by one control step; return whether a lap was completed and its time, (N,), s."""
        num_gates = len(self.gate_positions)
        self.position.copy_(position)
        self.step_count += 1
        self.gates_passed += passes
        self.target_gate.add_(passes).remainder_(num_gates)
        lap_complete = self.gates_passed.remainder(num_gates) < passes
        lap_steps = self.step_count - self.lap_start_step
        lap_time = torch.where(lap_complete, lap_steps * self.control_dt, 0.0).to(self._dtype)
        self.lap_start_step.copy_(torch.where(lap_complete, self.step_count, self.lap_start_step))
        return lap_complete, lap_time


@dataclasses.dataclass(frozen=True)
class RewardWeights:
    """The weights of Eq. 1.

    Raises:
        ValueError: a weight is not finite.
    """

    # b₁, reward per metre of progress to the target gate. Reference: paper, Table of reward parameters.
    progress: float = setting(1.0, FINITE)
    body_rate: float = setting(0.0, FINITE)  # b₂, penalty per rad/s of body rate; a curriculum raises it to 0.01
    gate: float = setting(10.0, FINITE)  # reward per gate passed, in place of the progress reward in that control step
    # reward of a control step that ends in a crash, in place of all other terms
    collision: float = setting(-4.0, FINITE)

    def __post_init__(self) -> None:
        check_settings(self, "RewardWeights.")


def race_reward(
    weights: RewardWeights,
    gate_position: Tensor,
    previous_position: Tensor,
    position: Tensor,
    body_rates: Tensor,
    passes: Tensor,
    crashed: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the two parts of Eq. 1; the reward is ``reward_base - weights.body_rate * body_rate_norm``.

    A crash overrides a pass in the same step. Both distances are to the gate that was the target during the step, so
    after a pass the next step measures both to the new gate. Non-finite values are allowed where crashed.

    Args:
        weights: the weights of Eq. 1; ``body_rate`` is not applied here.
        gate_position: centre of each drone's target gate, (N, 3), m.
        previous_position: at the last control step, (N, 3), m.
        position: (N, 3), m.
        body_rates: (N, 3), rad/s.
        passes: gates passed in this step, each of which is rewarded, (N,) int64.
        crashed: (N,) bool.

    Returns:
        ``reward_base`` and ``body_rate_norm``, (N,) each, as in `RaceStep`.

    Reference: paper, Eq. 1.
    """
    progress = (gate_position - previous_position).norm(dim=-1) - (gate_position - position).norm(dim=-1)
    passed = passes > 0
    reward_base = torch.where(passed, weights.gate * passes, weights.progress * progress)
    reward_base = torch.where(crashed, weights.collision, reward_base)
    body_rate_norm = torch.where(passed | crashed, 0.0, body_rates.norm(dim=-1))
    return reward_base, body_rate_norm


class RaceVector:
    """Computes the race vector of N drones, with the entries listed in ``RACE_VECTOR_ENTRIES``.

    Every entry is of order one [choice of divisors]. ``dtype`` is the floating-point type of the drones' state.

    Example:
        >>> from dreamer_racing.envs.worlds import RaceWorlds
        >>> worlds = RaceWorlds("circle", num_envs=2, from_pixels=False)
        >>> worlds.reset()
        >>> worlds.vector().shape
        torch.Size([2, 21])
    """

    def __init__(self, track: Track, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64) -> None:
        self._positions = track.gate_positions(device, dtype)  # (G, 3)
        self._normals = track.gate_normals(device, dtype)  # (G, 3)
        self._up = torch.tensor([0.0, 0.0, 1.0], device=device, dtype=dtype)

    def __call__(self, state: DroneState, target_gate: Tensor) -> Tensor:
        """Return the vectors, float32 ``(N, 21)``, for the gates to pass next, int64 ``(N,)``."""
        gates = torch.stack((target_gate, (target_gate + 1) % len(self._positions)), 1)  # (N, 2)
        to_gate = (self._positions[gates] - state.position.unsqueeze(1)) / DISTANCE  # (N, 2, 3)
        world = torch.cat(
            (
                (state.linear_velocity / VELOCITY).unsqueeze(1),
                self._up.expand(len(gates), 1, 3),
                torch.stack((to_gate, self._normals[gates]), 2).flatten(1, 2),
            ),
            1,
        )  # (N, 6, 3)
        body = rotate_inverse(state.attitude.unsqueeze(1).expand(-1, 6, 4), world)
        rates = (state.body_rates / RATES).unsqueeze(1)
        return torch.cat((body[:, :1], rates, body[:, 1:]), 1).flatten(1).float()

    def pose(self, vector: Tensor, target_gate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Estimate the poses of drones from race vectors, which may be inexact.

        The attitude is a least-squares fit of the up direction, both gates' directions of flight and the line between
        the gates; the position follows from the attitude and the vector to the target gate.

        Args:
            vector: As ``__call__`` returns them, ``(N, 21)``.
            target_gate: The gate to pass next, int64 ``(N,)``.

        Returns:
            Positions ``(N, 3)`` in m, attitudes ``(N, 4)``, wxyz, and the misfit ``(N,)``: the mean squared residual of
            the fit, for unit vectors.
        """
        gates = torch.stack((target_gate, (target_gate + 1) % len(self._positions)), 1)  # (N, 2)
        up, to_gate, direction, to_next, next_direction = vector.to(self._up.dtype).view(-1, 7, 3)[:, 2:].unbind(1)
        places, normals = self._positions[gates], self._normals[gates]
        body = torch.stack((up, direction, next_direction, DISTANCE * (to_next - to_gate)), 1)
        world = torch.cat((self._up.expand(len(gates), 1, 3), normals, places[:, 1:] - places[:, :1]), 1)  # (N, 4, 3)
        length = world.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        body, world = body / length, world / length
        attitude = align(body, world)
        misfit = (rotate(attitude.unsqueeze(1), body) - world).square().sum(-1).mean(-1)
        return places[:, 0] - rotate(attitude, DISTANCE * to_gate), attitude, misfit
