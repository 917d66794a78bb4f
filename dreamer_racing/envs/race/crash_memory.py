"""States in which flights went wrong, from which others begin again.

Shape legend: N drones, K control steps remembered. SI units, world z up, quaternions wxyz.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from dreamer_racing.envs.race.starts import StartPose
from dreamer_racing.envs.simulator.base import DroneState


def check_share(share: float) -> None:
    """Refuse what is no share of episodes, and all of them, for only others leave crashes."""
    if not 0.0 <= share < 1.0:
        raise ValueError(f"start_before_crash={share}: a share of episodes, at least 0 and below 1.")


class CrashMemory:
    """Remembers where each drone was before it crashed, and lets a share of new episodes begin there.

    A drone that crashes leaves the state that it was in 0.4–2 s earlier [choice], at a time drawn at random; the
    newest of each drone is kept. An episode that begins again takes that of a random drone: position, attitude,
    velocity and target gate; body rates and motors are as at any start. An episode that began so leaves nothing
    itself, or else the memory would fill with states that nobody can save. What is practised is thus what the policy
    does wrong now, on the way that it flies itself, however rarely it gets there. Reference: Salimans and Chen 2018,
    "Learning Montezuma's Revenge from a single demonstration", who move starts backwards along a way that is known.

    Args:
        num_envs: N.
        share: of episodes that begin again, once every drone has left a state; less before.
        control_dt: duration of a control step, s.
        device: where everything lives.
        dtype: floating-point type of the poses.

    Raises:
        ValueError: ``share`` is none.
    """

    BEFORE = (0.4, 2.0)  # s
    _KEPT = ("recent", "recent_target", "now", "state", "target", "filled", "again", "crashed", "steps")

    def __init__(
        self, num_envs: int, share: float, control_dt: float, device: torch.device | str, dtype: torch.dtype
    ) -> None:
        check_share(share)
        self.share = share
        self._lags = tuple(max(1, round(seconds / control_dt)) for seconds in self.BEFORE)  # control steps
        depth = self._lags[1] + 1
        # all stay in place, so that a CUDA graph can advance them
        self.recent = torch.zeros(depth, num_envs, 10, device=device, dtype=dtype)  # position, attitude, velocity
        self.recent_target = torch.zeros(depth, num_envs, dtype=torch.int64, device=device)
        self.now = torch.zeros(1, dtype=torch.int64, device=device)  # row of the latest step
        self.state = torch.zeros(num_envs, 10, device=device, dtype=dtype)
        self.target = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.filled = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.again = torch.zeros(num_envs, dtype=torch.bool, device=device)  # whether this episode began from memory
        self.crashed = torch.zeros(num_envs, dtype=torch.bool, device=device)  # in the latest step
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=device)  # of the episode that were noted here

    def note(self, state: DroneState, target_gate: Tensor, crashed: Tensor) -> None:
        """Remember every drone after a control step.

        Args:
            state: of the N drones.
            target_gate: to be passed next, (N,) int64.
            crashed: in this step, (N,) bool.
        """
        row = torch.cat((state.position, state.attitude, state.linear_velocity), -1)
        self.now.add_(1).remainder_(len(self.recent))
        self.recent.index_copy_(0, self.now, row.unsqueeze(0))
        self.recent_target.index_copy_(0, self.now, target_gate.unsqueeze(0))
        self.crashed.copy_(crashed)
        self.steps.add_(1)

    def begin(self, mask: Tensor, start: StartPose, generator: torch.Generator) -> StartPose:
        """Keep what the drones that begin anew have left, and put some of them where one has crashed.

        Args:
            mask: which drones begin, (N,) bool.
            start: where they begin otherwise.
            generator: source of randomness, on the device.

        Returns:
            Where they begin, (N, ...); read only where masked.
        """
        num, device, (least, most) = len(mask), mask.device, self._lags
        draw = torch.rand(num, 3, generator=generator, device=device, dtype=self.state.dtype)
        lag = least + (draw[:, 0] * (most - least + 1)).long()
        lag = torch.minimum(lag, self.steps - 1)  # not before the episode
        row, each = (self.now - lag) % len(self.recent), torch.arange(num, device=device)
        state = self.recent[row, each]
        leaves = mask & self.crashed & ~self.again & (lag >= least) & state.isfinite().all(-1)
        self.state.copy_(torch.where(leaves.unsqueeze(-1), state, self.state))
        self.target.copy_(torch.where(leaves, self.recent_target[row, each], self.target))
        self.filled.logical_or_(leaves)

        chosen = (draw[:, 1] * num).long()
        again = (draw[:, 2] < self.share) & self.filled[chosen]
        self.again.copy_(torch.where(mask, again, self.again))
        self.crashed.masked_fill_(mask, value=False)
        self.steps.masked_fill_(mask, 0)
        position, attitude, velocity = self.state[chosen].split((3, 4, 3), -1)
        column = again.unsqueeze(-1)  # (N, 1)
        return dataclasses.replace(
            start,
            position=torch.where(column, position, start.position),
            attitude=torch.where(column, attitude, start.attitude),
            linear_velocity=torch.where(column, velocity, start.linear_velocity),
            target_gate=torch.where(again, self.target[chosen], start.target_gate),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that is remembered."""
        return {name: getattr(self, name).clone() for name in self._KEPT}

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name in self._KEPT:
            getattr(self, name).copy_(state_dict[name])
