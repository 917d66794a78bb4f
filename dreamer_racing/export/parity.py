"""Parity check of exported actors: replay a recorded flight with each copy and compare actions and latents.

Shape legend: A action, L latents of C classes, V vector entries, T steps of a recorded flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export.onnx_actor import CONTRACT, OnnxActor, RecurrentActor, measure_latency, read_contract
from dreamer_racing.modules import DreamerPolicy
from dreamer_racing.modules.agent import Agent

ACTION_TOLERANCE = 1e-4
"""Largest allowed deviation of an action, in [−1, 1], from the original's: 1.3 mm/s² of thrust, 0.001 rad/s."""
LATENT_TOLERANCE = 1e-3
"""Largest allowed deviation of a class probability from the original's; a sample of another class deviates by 1."""
MIN_STEPS, MIN_EPISODES = 200, 4
"""Minimum numbers of steps, and of episodes and so of resets, of a recorded flight."""


class ParityError(RuntimeError):
    """The actions or latents of an exported actor deviate too much from the original's."""


@dataclass(frozen=True)
class RecordedFlight:
    """A recorded flight of T steps."""

    observations: np.ndarray  # uint8 (T, height, width, 3) or float32 (T, V)
    is_init: np.ndarray  # bool (T,): whether each step is its episode's first
    actions: np.ndarray  # (T, A), of the policy
    imu: np.ndarray | None = None  # float32 (T, 6); None without an IMU

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return int(self.is_init.sum())


@torch.no_grad()
def record_flight(env: DroneRacingEnv, agent: Agent, steps: int) -> RecordedFlight:
    """Record T steps of the deterministic policy in an environment with one drone and episodes of `episode_steps`."""
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
    """Return the length of episodes with which a flight has ``MIN_EPISODES``; raise ValueError if it is too short."""
    check_steps(steps)
    return math.ceil(steps / MIN_EPISODES)


def check_steps(steps: int) -> None:
    """Raise ValueError if a flight is too short for a comparison."""
    if steps < MIN_STEPS:
        raise ValueError(f"steps={steps}: an export must be compared over at least {MIN_STEPS} steps.")


class TorchActor(RecurrentActor):
    """A `RecurrentActor` that runs an `ActorStep`, or the module of its ``torch.export`` program, in torch."""

    def __init__(self, contract: dict[str, Any], step: Callable[..., Sequence[Tensor]]) -> None:
        super().__init__(contract)
        self._step = step

    @torch.no_grad()
    def _run(self, feed: dict[str, np.ndarray]) -> Sequence[np.ndarray]:
        return [output.numpy() for output in self._step(*(torch.tensor(feed[name]) for name in self._shapes))]


def check_parity(actors: Mapping[str, RecurrentActor], flight: RecordedFlight, seed: int = 0) -> dict[str, float]:
    """Replay a recorded flight with each actor; return each one's largest deviation of an action from the first's.

    If latents are not sampled, the first actor, the original, is also compared with the recorded actions. Else all get
    the same noise, of the seed.

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
        hint = "Rounding may also change a sample on the border of two classes: try another seed."
        raise ParityError(f"{error} {hint}") from None


def measure_latencies(
    step: Callable[..., Sequence[Tensor]], flight: RecordedFlight, output: Path, parts: bool
) -> Iterator[str]:
    """Yield lines on how long an `ActorStep` takes, and its export; with ``parts`` also from image to action."""
    contract = read_contract(output.parent / CONTRACT)
    actors = {"onnxruntime": OnnxActor(output, whole=True), "torch": TorchActor(contract, step)}
    imu = {} if flight.imu is None else {"imu": flight.imu[0]}
    for name, actor in actors.items():
        yield f"one step, 1 thread, {name}: {measure_latency(partial(actor.step, **imu), flight.observations)}"
    if parts:
        actor = OnnxActor(output)
        latency = measure_latency(partial(actor.step, **imu), flight.observations, actor.prepare)
        yield f"of this, from image to action: {latency}"


def _replay(actor: RecurrentActor, flight: RecordedFlight, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions (T, A) and the latents (T, L, C), as one-hot samples or class probabilities."""
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
    """Return the largest deviation of an action; raise if any deviation of an action or latent is too large."""
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
        f"{name} does not match {original}: at step {step} of {len(bad)} the action deviates by "
        f"{deviation[step]:.2e} (allowed: {ACTION_TOLERANCE:.0e}){', ' + latents if latents else ''}; "
        f"{int(bad.sum())} steps are affected, the largest deviation is {deviation.max():.2e}. Nothing was written."
    )
