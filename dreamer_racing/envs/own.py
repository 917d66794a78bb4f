"""Rewards and observations of a user's own: what their functions are given, and what they may return.

``docs/own_rewards.md`` says how to write them. Shapes: N drones. SI units, float32.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from dreamer_racing.envs.race.race import Race, RaceStep, RaceVector
from dreamer_racing.envs.simulator.base import DroneState
from dreamer_racing.settings import import_own, quoted


@dataclass(frozen=True)
class RaceState:
    """N drones at one time, each with the gate that it has to pass next; a number of a state that broke is 0."""

    position: Tensor
    """(N, 3) m, world."""
    attitude: Tensor
    """(N, 4) quaternion wxyz, body → world."""
    linear_velocity: Tensor
    """(N, 3) m/s, world."""
    body_rates: Tensor
    """(N, 3) rad/s, body frame."""
    action: Tensor
    """(N, 4) the action that was flown last, in [-1, 1]; zeros where an episode begins."""
    gate_position: Tensor
    """(N, 3) centre of the target gate, m, world."""
    gate_direction: Tensor
    """(N, 3) unit vector in which the target gate is to be passed, world."""
    time: Tensor
    """(N,) s since the episode began."""
    make_race_vector: Callable[[], Tensor] = field(repr=False)
    """Makes `race_vector`, which few functions read."""

    @cached_property
    def race_vector(self) -> Tensor:
        """(N, 21) all of this and the gate after the target in the drone's own frame, see `RaceVector`."""
        return self.make_race_vector()


@dataclass(frozen=True)
class Transition:
    """One control step of N drones, each for itself: where it led from and to, and what came of it."""

    before: RaceState
    """At the start of the step. Its gate is the one that the step could pass."""
    after: RaceState
    """At its end. Its ``action`` is the one of this step; its gate is the next one where one was passed."""
    outcome: RaceStep
    """Passes, crashes and ends, each (N,)."""

    @property
    def default_reward(self) -> Tensor:
        """(N,) Eq. 1 of the paper with the environment's weights, but for the penalty of body rates."""
        return self.outcome.reward_base


RewardFunction: TypeAlias = Callable[[Transition], Tensor]
"""Returns rewards, (N,) or (N, 1)."""
VectorFunction: TypeAlias = Callable[[RaceState], Tensor]
"""Returns what the agent sees under ``vector``, (N, V)."""


class RaceStates:
    """Tells how N drones' race stands.

    Args:
        race: Its rules, and where each episode is.
        vector: Of its track.
    """

    def __init__(self, race: Race, vector: RaceVector) -> None:
        device = race.position.device
        self._race, self._vector = race, vector
        self._positions, self._directions = race.track.gate_positions(device), race.track.gate_normals(device)

    def __call__(self, state: DroneState, action: Tensor) -> RaceState:
        """Return copies of the drones' state, with the action (N, 4) that was flown last and the target gate."""
        race = self._race
        whole = DroneState(**{each.name: getattr(state, each.name).nan_to_num(0.0, 0.0, 0.0) for each in fields(state)})
        return RaceState(
            **{name: value.float() for name, value in vars(whole).items()},
            action=action.clone(),
            gate_position=self._positions[race.target_gate],
            gate_direction=self._directions[race.target_gate],
            time=race.step_count * race.control_dt,
            make_race_vector=partial(self._vector, whole, race.target_gate.clone()),
        )


class OwnFunction:
    """A function of a user's own, and the checks of what it returns.

    On a CUDA device numbers are looked at only when `check` is called: to look at once would let each step wait.

    Args:
        argument: By which it is given: ``reward`` or ``vector``.
        given: The function, a class whose objects are called, or ``module:name`` of either.
        num_envs: N.
        device: Where its numbers live.

    Raises:
        ValueError: It is none, or cannot be imported; the message says what it should be.
    """

    def __init__(self, argument: str, given: Any, num_envs: int, device: torch.device) -> None:
        found = import_own(given, f"{argument}={given}") if isinstance(given, str) and ":" in given else given
        found = found() if isinstance(found, type) else found
        if not callable(found):
            raise ValueError(f"{argument}={quoted(given)}: must be a function of your own, or module:function of one.")
        self.name = (
            f"{argument}={given if isinstance(given, str) else getattr(found, '__name__', type(found).__name__)}"
        )
        self._function, self._num_envs, self._size = found, num_envs, 0
        self._broken = torch.zeros((), dtype=torch.bool, device=device)

    def rewards(self, transition: Transition) -> Tensor:
        """Return the rewards of a step, (N,)."""
        value = self._call(transition)
        if value.shape not in ((self._num_envs,), (self._num_envs, 1)):
            raise self._wrong_shape(value, f"({self._num_envs},) or ({self._num_envs}, 1), a reward for each drone")
        return value.reshape(self._num_envs)

    def vector(self, state: RaceState) -> Tensor:
        """Return what the agents see, (N, V), always of the same V."""
        value = self._call(state)
        size = self._size or "V"
        if value.ndim != 2 or len(value) != self._num_envs or value.shape[1] != (self._size or value.shape[1]):
            raise self._wrong_shape(value, f"({self._num_envs}, {size}), {size} numbers for each drone")
        self._size = value.shape[1]
        return value

    def check(self) -> None:
        """Refuse numbers returned since the last check that are not finite; on a CUDA device it waits."""
        if self._broken:
            self._broken.zero_()
            raise ValueError(f"{self.name} returned numbers that are not finite.")

    def _call(self, moment: Transition | RaceState) -> Tensor:
        """Return the function's numbers, float32."""
        try:
            value = self._function(moment)
        except ValueError as error:  # of the function itself: whoever wrote it wants to see where
            raise RuntimeError(f"{self.name} failed: {error}") from error
        device = self._broken.device
        if not isinstance(value, Tensor) or value.device != device:
            there = f" on {value.device}" if isinstance(value, Tensor) else ""
            raise ValueError(f"{self.name} returned {type(value).__name__}{there}: must be a tensor on {device}.")
        value, finite = value.detach().to(torch.float32, copy=True), value.isfinite()
        if device.type == "cuda":
            self._broken.logical_or_(~finite.all())
        elif not finite.all():
            world = int((~finite).nonzero()[0, 0]) if value.ndim else 0
            raise ValueError(f"{self.name} returned numbers that are not finite, first for world {world}.")
        return value

    def _wrong_shape(self, value: Tensor, right: str) -> ValueError:
        return ValueError(f"{self.name} returned a tensor of shape {tuple(value.shape)}: must be {right}.")
