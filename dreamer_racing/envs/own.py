"""User-defined reward and observation functions: their inputs and the checks of their outputs.

``docs/own_rewards.md`` explains how to write them. Shapes: N drones. SI units, float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from dreamer_racing.envs.race.race import Race, RaceStep, RaceVector
from dreamer_racing.envs.simulator.simulators import DroneState
from dreamer_racing.settings import import_own, quoted


@dataclass(frozen=True)
class RaceState:
    """State of N drones and their target gates at one time; values that are not finite are replaced by 0."""

    position: Tensor
    """(N, 3) m, world."""
    attitude: Tensor
    """(N, 4) quaternion wxyz, body → world."""
    linear_velocity: Tensor
    """(N, 3) m/s, world."""
    body_rates: Tensor
    """(N, 3) rad/s, body frame."""
    action: Tensor
    """(N, 4) last applied action, in [-1, 1]; zeros at the start of an episode."""
    gate_position: Tensor
    """(N, 3) centre of the target gate, m, world."""
    gate_direction: Tensor
    """(N, 3) unit vector of the direction in which the target gate must be passed, world."""
    time: Tensor
    """(N,) s since the start of the episode."""
    make_race_vector: Callable[[], Tensor] = field(repr=False)
    """Computes `race_vector` on first access, because few functions read it."""

    @cached_property
    def race_vector(self) -> Tensor:
        """(N, 21) the drone's state, the target gate and the gate after it, in the body frame; see `RaceVector`."""
        return self.make_race_vector()

    @classmethod
    def of(cls, race: Race, vector: RaceVector, state: DroneState, action: Tensor) -> RaceState:
        """Return copies of the drones' state, with their last applied action (N, 4) and target gate."""
        whole = DroneState(**{each.name: getattr(state, each.name).nan_to_num(0.0, 0.0, 0.0) for each in fields(state)})
        return cls(
            **{name: value.float() for name, value in vars(whole).items()},
            action=action.clone(),
            gate_position=race.gate_positions[race.target_gate],
            gate_direction=race.gate_normals[race.target_gate],
            time=race.step_count * race.control_dt,
            make_race_vector=partial(vector, whole, race.target_gate.clone()),
        )


@dataclass(frozen=True)
class Transition:
    """One control step of N drones: the states before and after it, and its outcome."""

    before: RaceState
    """State at the start of the step; its gate is the target during the step."""
    after: RaceState
    """State at the end; its ``action`` is that of this step; its gate is the next one if the step passed a gate."""
    outcome: RaceStep
    """Gate passes, crashes and episode ends, each (N,)."""

    @property
    def default_reward(self) -> Tensor:
        """(N,) Eq. 1 of the paper with the environment's weights, without the body-rate penalty."""
        return self.outcome.reward_base


RewardFunction: TypeAlias = Callable[[Transition], Tensor]
"""Function that returns the rewards, (N,) or (N, 1)."""
VectorFunction: TypeAlias = Callable[[RaceState], Tensor]
"""Function that returns the observation ``vector``, (N, V)."""


class CustomFunction:
    """A user-defined reward or vector function whose return values are checked.

    On a CUDA device, non-finite values are reported only when `check` is called, to avoid a synchronisation per step.

    Args:
        argument: The environment argument it was given as: ``reward`` or ``vector``.
        given: The function, a class with callable instances, or ``module:name`` of either.
        device: Device of its return values.

    Raises:
        ValueError: ``given`` is not callable or cannot be imported; the message says what it should be.
    """

    def __init__(self, argument: str, given: Any, num_envs: int, device: torch.device) -> None:
        found = import_own(given, f"{argument}={given}") if isinstance(given, str) and ":" in given else given
        found = found() if isinstance(found, type) else found
        if not callable(found):
            raise ValueError(f"{argument}={quoted(given)}: must be a function, or its name as module:function.")
        name = given if isinstance(given, str) else getattr(found, "__name__", type(found).__name__)
        self.name = f"{argument}={name}"
        self._function, self._num_envs, self._size = found, num_envs, 0
        self._broken = torch.zeros((), dtype=torch.bool, device=device)

    def rewards(self, transition: Transition) -> Tensor:
        """Return the rewards (N,) of a step."""
        value = self._call(transition)
        if value.shape not in ((self._num_envs,), (self._num_envs, 1)):
            raise self._wrong_shape(value, f"({self._num_envs},) or ({self._num_envs}, 1), a reward for each drone")
        return value.reshape(self._num_envs)

    def vector(self, state: RaceState) -> Tensor:
        """Return the observation (N, V); V must be the same in every call."""
        value = self._call(state)
        size = self._size or "V"
        if value.ndim != 2 or len(value) != self._num_envs or value.shape[1] != (self._size or max(value.shape[1], 1)):
            raise self._wrong_shape(value, f"({self._num_envs}, {size}), {size} numbers for each drone")
        self._size = value.shape[1]
        return value

    def check(self) -> None:
        """Raise if values returned since the last check were not finite; synchronises with a CUDA device."""
        if self._broken:
            self._broken.zero_()
            raise ValueError(f"{self.name} returned numbers that are not finite.")

    def _call(self, moment: Transition | RaceState) -> Tensor:
        """Return the function's value as float32."""
        try:
            value = self._function(moment)
        except ValueError as error:  # raised in the user's function: keep its traceback
            raise RuntimeError(f"{self.name} failed: {error}") from error
        device = self._broken.device
        if not isinstance(value, Tensor) or value.device != device:
            there = f" on {value.device}" if isinstance(value, Tensor) else ""
            raise ValueError(f"{self.name} returned {type(value).__name__}{there}: must be a tensor on {device}.")
        value = value.detach().to(torch.float32, copy=True)
        finite = value.isfinite()
        if device.type == "cuda":
            self._broken.logical_or_(~finite.all())
        elif not finite.all():
            world = int((~finite).nonzero()[0, 0]) if value.ndim else 0
            raise ValueError(f"{self.name} returned numbers that are not finite, first for world {world}.")
        return value

    def _wrong_shape(self, value: Tensor, right: str) -> ValueError:
        return ValueError(f"{self.name} returned a tensor of shape {tuple(value.shape)}: must be {right}.")
