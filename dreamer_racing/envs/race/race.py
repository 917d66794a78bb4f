"""Episodes of N drones on one track: target gates, laps, time and rewards.

Shape legend: N drones, P physics steps per control step, G race gates. SI units, world z up, quaternions wxyz.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch

from dreamer_racing.envs.race.gates import CrashCause, GateSweeper
from dreamer_racing.envs.race.rewards import RewardWeights, race_reward
from dreamer_racing.envs.tracks import Track
from dreamer_racing.settings import quoted

EPISODE_TIME = 20.0
"""Time after which a training episode is truncated, s [choice]."""

MAX_SPEED = 50.0
"""Up to which two gates in one control step both count, m/s: 2.7 times a drone's weight, and that weight, without drag
over 30 m, give 47 [choice]."""

EVALUATION_TIME = 30.0
"""The same in evaluation, s: three laps of split_s take a good pilot 22 s [choice]."""


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
    passes: torch.Tensor
    """int64: gates passed in this step; 2 only where gates lie within a control step's reach of each other."""
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

    def reward(self, body_rate_weight: float) -> torch.Tensor:
        """Return the reward (N,) with a weight b₂ of the body rates. Reference: paper, Eq. 1."""
        return self.reward_base - body_rate_weight * self.body_rate_norm


class Race:
    """Keeps the episode of each of N drones.

    A lap is G passes, from whichever gate the episode began. Lap 1 is timed from the start of the episode, a later lap
    from the completion of the one before; times are whole control steps. A pass that comes before a crash in the same
    step counts (gate, lap time), but the reward is the collision's and the episode is terminated.

    Args:
        track: the track.
        num_envs: number of drones N.
        weights: the weights of Eq. 1.
        episode_steps: control steps after which an episode is truncated; None for those of 20 s.
        laps: laps after which an episode is truncated as finished (evaluation); None to fly until time is up.
        control_dt: duration of a control step, s.
        device: where all tensors live.
        dtype: floating-point type of positions and rewards.
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
            raise ValueError(f"weights={quoted(weights)}: must be RewardWeights, of dreamer_racing.envs.race.rewards.")
        self.track = track
        self.weights = weights or RewardWeights()
        if episode_steps is not None and episode_steps < 1:
            raise ValueError(f"episode_steps={episode_steps}: must be at least 1.")
        self.episode_steps = round(EPISODE_TIME / control_dt) if episode_steps is None else episode_steps
        self.laps = laps
        self.control_dt = control_dt
        self._sweep = GateSweeper(track, device, dtype, miss_radius, reach=MAX_SPEED * control_dt)
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
        passes, gate_offset, crash = self._judge(path, body_rates, invalid_action)
        crashed = crash != CrashCause.NONE
        reward_base, body_rate_norm = race_reward(
            self.weights,
            self._gate_positions[self.target_gate],
            self.position,
            path[-1],
            body_rates,
            passes,
            crashed,
        )
        lap_complete, lap_time = self._advance(passes, path[-1])
        if self.laps is None:
            finished = torch.zeros_like(crashed)
        else:
            finished = lap_complete & ~crashed & (self.gates_passed >= self.laps * self.track.num_gates)
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
        passes, offset, crash = self._sweep(path, self.target_gate)
        rates_lost = (crash == CrashCause.NONE) & ~body_rates.isfinite().all(-1)
        crash = crash.masked_fill(rates_lost, CrashCause.NON_FINITE_STATE)
        crash = crash.masked_fill(invalid_action, CrashCause.INVALID_ACTION)
        return passes.masked_fill(invalid_action, 0), offset.masked_fill(invalid_action, 0.0), crash

    def _advance(self, passes: torch.Tensor, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Move every episode on by one control step; return which laps it completed and their times (N,), s."""
        num_gates = self.track.num_gates
        self.position.copy_(position)
        self.step_count += 1
        self.gates_passed += passes
        self.target_gate.add_(passes).remainder_(num_gates)
        lap_complete = self.gates_passed.remainder(num_gates) < passes
        lap_steps = self.step_count - self.lap_start_step
        lap_time = torch.where(lap_complete, lap_steps * self.control_dt, 0.0).to(self._dtype)
        self.lap_start_step.copy_(torch.where(lap_complete, self.step_count, self.lap_start_step))
        return lap_complete, lap_time
