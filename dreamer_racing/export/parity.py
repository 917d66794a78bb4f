"""Proof that copies of an actor fly alike: a recorded flight, what flies it again, and the comparison.

Shape legend: A action, L latents of C classes, V numbers, T steps of a recorded flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export.onnx_actor import RecurrentActor
from dreamer_racing.modules import DreamerPolicy
from dreamer_racing.modules.agent import Agent

ACTION_TOLERANCE = 1e-4
"""Largest deviation of an action, in [−1, 1], from the original's: 1.3 mm/s² of thrust, 0.001 rad/s."""
LATENT_TOLERANCE = 1e-3
"""Largest deviation of a latent's class from the original's: of its probability, or 1 where a sample is of another."""
MIN_STEPS = 200
"""Steps of a recorded flight that an export must reproduce at least."""
MIN_EPISODES = 4
"""Episodes, hence resets, that those steps are made of at least."""


class ParityError(RuntimeError):
    """An exported copy of the actor does not fly as the original does."""


@dataclass(frozen=True)
class RecordedFlight:
    """A recorded flight of T steps.

    Attributes:
        observations: uint8 ``(T, height, width, 3)`` or float32 ``(T, V)``.
        is_init: Whether each step is its episode's first, bool ``(T,)``.
        actions: What the policy did, ``(T, A)``.
        imu: What the IMU told, float32 ``(T, 6)``; None without one.
    """

    observations: np.ndarray
    is_init: np.ndarray
    actions: np.ndarray
    imu: np.ndarray | None = None

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return int(self.is_init.sum())


@torch.no_grad()
def record_flight(env: DroneRacingEnv, agent: Agent, steps: int) -> RecordedFlight:
    """Fly the deterministic policy in an environment of one drone and keep what it sees.

    Args:
        env: ``num_envs=1``; give it ``episode_steps`` of `episode_steps`, so that there are resets.
        agent: Whose policy flies.
        steps: T.

    Raises:
        ValueError: An environment of several drones.
    """
    if env.batch_size != (1,):
        raise ValueError(f"env has batch size {list(env.batch_size)}; a flight is recorded with num_envs=1.")
    policy = DreamerPolicy(agent.world_model, agent.actor, deterministic=True)
    flying = with_memory(env, policy.make_primer())
    names = (*agent.interface.observation_keys, "is_init", "action")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    tensordict = flying.reset()
    for _ in range(steps):
        flown, tensordict = flying.step_and_maybe_reset(policy(tensordict))
        for name in names:
            rows[name].append(flown[name][0].numpy().copy())
    observations, *imu, is_init, actions = (np.stack(rows[name]) for name in names)
    return RecordedFlight(observations, is_init[:, 0], actions, *imu)


def episode_steps(steps: int) -> int:
    """Return after how many steps to end an episode, so that a flight has several.

    Raises:
        ValueError: Fewer than ``MIN_STEPS`` steps.
    """
    check_steps(steps)
    return math.ceil(steps / MIN_EPISODES)


def check_steps(steps: int) -> None:
    """Refuse a flight that is too short to prove anything.

    Raises:
        ValueError: Fewer than ``MIN_STEPS`` steps.
    """
    if steps < MIN_STEPS:
        raise ValueError(f"steps={steps}: an export must be compared over at least {MIN_STEPS} steps.")


class TorchActor(RecurrentActor):
    """Flies a step in torch as `OnnxActor` does in onnxruntime.

    Args:
        contract: Of the step.
        step: An `ActorStep`, or the module of its ``torch.export`` program.
        seed: Of the noise that samples latents.
    """

    def __init__(
        self, contract: dict[str, Any], step: Callable[..., Sequence[Tensor]], seed: int | None = None
    ) -> None:
        super().__init__(contract, seed)
        self._step = step

    @torch.no_grad()
    def _run(self, feed: dict[str, np.ndarray]) -> Sequence[np.ndarray]:
        return [output.numpy() for output in self._step(*(torch.tensor(feed[name]) for name in self._shapes))]


def check_parity(actors: Mapping[str, RecurrentActor], flight: RecordedFlight, seed: int = 0) -> dict[str, float]:
    """Fly actors through a recorded flight, each carrying its own state, and compare them with the first.

    Where no latents are sampled, the first one is compared with what the policy did in that flight.

    Args:
        actors: By name; the first is the original.
        flight: What they see, and where episodes begin.
        seed: Of the noise that samples latents, the same for all.

    Returns:
        Largest deviation of an action by name, without the first actor's.

    Raises:
        ParityError: If an action deviates by more than ``ACTION_TOLERANCE``, or a latent by more than
            ``LATENT_TOLERANCE``.
    """
    original, *others = actors
    shape = actors[original].noise_shape
    steps = len(flight.observations)
    noise = None if shape is None else np.random.default_rng(seed).random((steps, *shape), np.float32)
    flown = {name: _replay(actor, flight, noise) for name, actor in actors.items()}
    if noise is None:
        _compare("the policy", (flight.actions, flown[original][1]), original, flown[original])
    try:
        return {name: _compare(original, flown[original], name, flown[name]) for name in others}
    except ParityError as error:
        if noise is None:
            raise
        hint = "A sample may also fall where two classes are equal to within rounding: try another seed."
        raise ParityError(f"{error} {hint}") from None


def _replay(actor: RecurrentActor, flight: RecordedFlight, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions (T, A) and latents (T, L, C), samples or probabilities of their classes."""
    actions, latents = [], []
    for index, observation in enumerate(flight.observations):
        if flight.is_init[index]:
            actor.reset()
        imu = None if flight.imu is None else flight.imu[index]
        actions.append(actor.step(observation, None if noise is None else noise[index], imu))
        latents.append(actor.state["z"].reshape(actor.contract["model"]["latents"], -1).copy())
    return np.stack(actions), np.stack(latents)


def _compare(
    original: str, expected: tuple[np.ndarray, np.ndarray], name: str, got: tuple[np.ndarray, np.ndarray]
) -> float:
    """Return the largest deviation of an action, or raise at the first step where it or a latent's is too large."""
    deviation = np.abs(expected[0] - got[0]).max(1)  # (T,)
    drift = np.abs(expected[1] - got[1]).max(-1)  # (T, L)
    off = ~(drift <= LATENT_TOLERANCE)
    bad = ~(deviation <= ACTION_TOLERANCE) | off.any(1)
    if not bad.any():
        return float(deviation.max())
    step = int(bad.argmax())
    latents = ", ".join(
        f"latent {latent} by {drift[step, latent]:.2e} (allowed: {LATENT_TOLERANCE:.0e})"
        for latent in np.flatnonzero(off[step])[:3]
    )
    raise ParityError(
        f"{name} does not fly as {original} does: at step {step} of {len(bad)} the action deviates by "
        f"{deviation[step]:.2e} (allowed: {ACTION_TOLERANCE:.0e}){', ' + latents if latents else ''}; "
        f"{int(bad.sum())} steps are affected, the largest deviation is {deviation.max():.2e}. Nothing was written."
    )
