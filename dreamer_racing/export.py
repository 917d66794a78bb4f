"""Export of the recurrent actor as one explicit step, its contract, and the proof that the copies fly alike.

`ActorStep` takes all recurrent state as inputs and gives it back as outputs: ``(observation, h, z, previous_action,
is_init[, noise]) -> (action, h_next, z_next)``, batch size 1. `export_actor` writes it for onnxruntime and as a
``torch.export`` program, and publishes both only if they fly a recorded flight as the original does.

Shape legend: D belief, S state = L·K, L latents, K classes, A action, V numbers, T steps of a recorded flight.
"""

from __future__ import annotations

import copy
import hashlib
import importlib.util
import json
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.envs import Compose, InitTracker, TransformedEnv

from dreamer_racing.checkpoint import ensure_writable, load_components
from dreamer_racing.envs.quadrotor import QuadrotorParameters
from dreamer_racing.envs.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.learner import Agent
from dreamer_racing.modules import DreamerPolicy, Interface, ModelSize, join_features
from dreamer_racing.modules.encoder import IMAGE_SIZE
from dreamer_racing.modules.rssm import mix_uniform
from dreamer_racing.onnx_actor import CONTRACT, FORMAT, FORMAT_VERSION, OnnxActor, RecurrentActor, hash_file

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
OUTPUTS = ("action", "h_next", "z_next")
ACTION_TOLERANCE = 1e-4
"""Largest deviation of an action, in [−1, 1], from the original's: 1.3 mm/s² of thrust, 0.001 rad/s."""
MIN_STEPS = 200
"""Steps of a recorded flight that an export must reproduce at least."""
MIN_EPISODES = 4
"""Episodes, hence resets, that those steps are made of at least."""
PROTOBUF_LIMIT = 2_000_000_000
"""Bytes that an ONNX file may have without external data."""


class ParityError(RuntimeError):
    """An exported copy of the actor does not fly as the original does."""


class MissingPackagesError(ImportError):
    """Packages that only the export needs are not installed."""


class ActorStep(nn.Module):
    """One acting step of explicit state, with the posterior's mode for z and the actor's mean for the action.

    Args:
        agent: Its encoder, RSSM and actor are copied.

    Attributes:
        noise_shape: Shape of the input ``noise``, or None if there is none.

    Raises:
        ValueError: If the agent sees images and numbers both.

    Example:
        >>> from dreamer_racing.modules import get_size
        >>> step = ActorStep(Agent(get_size("debug"), Interface(), decode=False))
        >>> list(step.example_inputs())
        ['image_u8', 'h', 'z', 'previous_action', 'is_init']
        >>> [tuple(output.shape) for output in step(*step.example_inputs().values())]
        [(1, 4), (1, 32), (1, 16)]
    """

    latent = "mode"

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.interface, self.size = agent.interface, agent.world_model.size
        if len(self.interface.observation_keys) != 1:
            seen = " and ".join(self.interface.observation_keys)
            raise ValueError(f"This agent sees {seen}; only actors of one observation can be exported.")
        self.encoder = copy.deepcopy(agent.world_model.encoder)
        self.rssm = copy.deepcopy(agent.world_model.rssm)
        self.actor = copy.deepcopy(agent.actor)
        for parameter in self.parameters():
            # torch.export saves no channels-last weights.
            parameter.data = parameter.data.cpu().contiguous()
        self.requires_grad_(False)

    @property
    def noise_shape(self) -> tuple[int, int] | None:
        """Shape (L, K) of the noise of one step; None if it takes none."""
        return None

    def forward(
        self, observation: Tensor, h: Tensor, z: Tensor, previous_action: Tensor, is_init: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Step.

        Args:
            observation: uint8 ``(1, 64, 64, 3)``, or float32 ``(1, V)``.
            h: Belief after the last step, ``(1, D)``; like the next two ignored where ``is_init``.
            z: State after the last step, ``(1, S)``.
            previous_action: ``(1, A)``.
            is_init: Whether this is the first step of an episode, bool ``(1,)``.

        Returns:
            Action ``(1, A)`` in [−1, 1], next belief ``(1, D)``, next state ``(1, S)``.
        """
        h, z = self.rssm.observe_step(self._embed(observation), previous_action, is_init, h, z, deterministic=True)
        return self._act(h, z)

    def example_inputs(self) -> dict[str, Tensor]:
        """Return inputs by name, in the order of ``forward``."""
        size, interface = self.size, self.interface
        seen = (
            {"image_u8": torch.zeros(1, IMAGE_SIZE, IMAGE_SIZE, 3, dtype=torch.uint8)}
            if interface.pixels
            else {"vector": torch.zeros(1, interface.vector_dim)}
        )
        noise = {} if self.noise_shape is None else {"noise": torch.full((1, *self.noise_shape), 0.5)}
        return {
            **seen,
            "h": torch.zeros(1, size.belief),
            "z": torch.zeros(1, size.state),
            "previous_action": torch.zeros(1, interface.action_dim),
            "is_init": torch.ones(1, dtype=torch.bool),
            **noise,
        }

    def _embed(self, observation: Tensor) -> Tensor:
        return self.encoder({self.interface.observation_keys[0]: observation})

    def _act(self, h: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.actor(join_features(h, z)).mode(), h, z


class SampledActorStep(ActorStep):
    """One acting step of explicit state whose z is a sample of the posterior, by the Gumbel-max trick.

    The distribution is that of the training policy, which inverts the cumulative one instead. There rounding moves all
    later classes' edges; here it matters only between the two best classes, so that copies flip less often.

    Reference: Maddison et al., "A* Sampling", 2014.
    """

    latent = "sample"

    @property
    def noise_shape(self) -> tuple[int, int] | None:
        """Shape (L, K) of the noise of one step."""
        return self.size.latents, self.size.classes

    def forward(  # type: ignore[override]
        self, observation: Tensor, h: Tensor, z: Tensor, previous_action: Tensor, is_init: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Step; arguments as in `ActorStep.forward`, and ``noise``: uniform numbers in [0, 1), ``(1, L, K)``."""
        posterior = self.rssm.observe(
            self._embed(observation).unsqueeze(1),
            previous_action.unsqueeze(1),
            is_init.unsqueeze(1),
            (h, z),
            deterministic=True,
        )
        probabilities = mix_uniform(posterior.posterior_logits.squeeze(1), self.rssm.unimix)
        gumbel = -(-noise.log()).log()
        index = (probabilities.log() + gumbel).argmax(-1, keepdim=True)
        z = torch.zeros_like(probabilities).scatter(-1, index, 1.0).flatten(1)
        return self._act(posterior.belief.squeeze(1), z)


LATENTS: dict[str, type[ActorStep]] = {step.latent: step for step in (ActorStep, SampledActorStep)}
"""What z is in an exported step, by name."""


def make_step(agent: Agent, latent: str) -> ActorStep:
    """Make the step of a latent mode.

    Raises:
        ValueError: Unknown latent mode, or an agent that cannot be exported.
    """
    if latent not in LATENTS:
        raise ValueError(f"latent={latent}: there are {' and '.join(LATENTS)}.")
    return LATENTS[latent](agent)


class _LearnerState:
    """Takes what a checkpoint holds of a learner, whatever its losses were."""

    def __init__(self) -> None:
        self.value: Mapping[str, Any] = {}

    def state_dict(self) -> Mapping[str, Any]:
        return self.value

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.value = state


def load_agent(checkpoint: str | Path, interface: Interface) -> tuple[Agent, dict[str, Any]]:
    """Restore the agent of a checkpoint, without decoders, on the CPU.

    Args:
        checkpoint: Run directory, folder of checkpoints, or one checkpoint.
        interface: What the agent sees and does.

    Returns:
        The agent and the checkpoint's metadata, with ``env_steps``.

    Raises:
        FileNotFoundError: If there is no complete checkpoint.
        CheckpointError: If it has no learner.
        ValueError: If its networks do not fit the interface.
    """
    state = _LearnerState()
    metadata = load_components(checkpoint, {"learner": state})
    saved = state.value["size"].items()
    size: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in saved}
    agent = Agent(ModelSize(**size), interface, decode=False)
    try:
        missing = agent.load_state_dict(state.value["agent"], strict=False).missing_keys
    except RuntimeError as error:
        raise ValueError(f"The networks of {checkpoint} do not fit {interface}: {error}") from error
    if missing:
        raise ValueError(f"The networks of {checkpoint} do not fit {interface}: {', '.join(missing[:3])} are missing.")
    return agent.requires_grad_(False), metadata


def hash_weights(step: nn.Module) -> str:
    """Return the SHA-256 of all weights: name, type, shape and little-endian bytes of each, in order of names."""
    digest = hashlib.sha256()
    for name, value in sorted(step.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Flight:
    """A recorded flight of T steps.

    Attributes:
        observations: uint8 ``(T, 64, 64, 3)`` or float32 ``(T, V)``.
        is_init: Whether each step is its episode's first, bool ``(T,)``.
        actions: What the policy did, ``(T, A)``.
    """

    observations: np.ndarray
    is_init: np.ndarray
    actions: np.ndarray

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return int(self.is_init.sum())


@torch.no_grad()
def record_flight(env: DroneRacingEnv, agent: Agent, steps: int) -> Flight:
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
    flying = TransformedEnv(env, Compose(InitTracker(), policy.make_primer()))
    names = (agent.interface.observation_keys[0], "is_init", "action")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    tensordict = flying.reset()
    for _ in range(steps):
        flown, tensordict = flying.step_and_maybe_reset(policy(tensordict))
        for name in names:
            rows[name].append(flown[name][0].numpy().copy())
    observations, is_init, actions = (np.stack(rows[name]) for name in names)
    return Flight(observations, is_init[:, 0], actions)


def episode_steps(steps: int) -> int:
    """Return after how many steps to end an episode, so that a flight has several.

    Raises:
        ValueError: Fewer than ``MIN_STEPS`` steps.
    """
    _check_steps(steps)
    return math.ceil(steps / MIN_EPISODES)


def _check_steps(steps: int) -> None:
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


def check_parity(actors: Mapping[str, RecurrentActor], flight: Flight, seed: int = 0) -> dict[str, float]:
    """Fly actors through a recorded flight, each carrying its own state, and compare them with the first.

    Args:
        actors: By name; the first is the original.
        flight: What they see, and where episodes begin.
        seed: Of the noise that samples latents, the same for all.

    Returns:
        Largest deviation of an action by name, without the first actor's.

    Raises:
        ParityError: If an action deviates by more than ``ACTION_TOLERANCE`` or a latent has another class.
    """
    original, *others = actors
    shape = actors[original].noise_shape
    steps = len(flight.observations)
    noise = None if shape is None else np.random.default_rng(seed).random((steps, *shape), np.float32)
    flown = {name: _replay(actor, flight, noise) for name, actor in actors.items()}
    try:
        return {name: _compare(original, flown[original], name, flown[name]) for name in others}
    except ParityError as error:
        if noise is None:
            raise
        hint = "A sample may also fall where two classes are equal to within rounding: try another seed."
        raise ParityError(f"{error} {hint}") from None


def _replay(actor: RecurrentActor, flight: Flight, noise: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the actions (T, A) and the class of every latent (T, L)."""
    actions, classes = [], []
    for index, observation in enumerate(flight.observations):
        if flight.is_init[index]:
            actor.reset()
        actions.append(actor.step(observation, None if noise is None else noise[index]))
        classes.append(actor.state["z"].reshape(actor.contract["model"]["latents"], -1).argmax(-1))
    return np.stack(actions), np.stack(classes)


def _compare(
    original: str, expected: tuple[np.ndarray, np.ndarray], name: str, got: tuple[np.ndarray, np.ndarray]
) -> float:
    """Return the largest deviation, or raise at the first step of one that is too large or of another latent."""
    deviation = np.abs(expected[0] - got[0]).max(1)  # (T,)
    flipped = expected[1] != got[1]  # (T, L)
    bad = ~(deviation <= ACTION_TOLERANCE) | flipped.any(1)
    if not bad.any():
        return float(deviation.max())
    step = int(bad.argmax())
    latents = ", ".join(
        f"latent {latent} has class {got[1][step, latent]} instead of {expected[1][step, latent]}"
        for latent in np.flatnonzero(flipped[step])[:3]
    )
    raise ParityError(
        f"{name} does not fly as {original} does: at step {step} of {len(bad)} the action deviates by "
        f"{deviation[step]:.2e} (allowed: {ACTION_TOLERANCE:.0e}){', ' + latents if latents else ''}; "
        f"{int(bad.sum())} steps are affected, the largest deviation is {deviation.max():.2e}. Nothing was written."
    )


def make_contract(step: ActorStep, parameters: QuadrotorParameters, camera: Camera, **source: Any) -> dict[str, Any]:
    """Describe everything that a step takes and gives, for those who fly it without this project.

    Args:
        step: The step.
        parameters: Of the drone that the agent was trained with.
        camera: Through which it saw.
        source: Where it comes from, JSON values: checkpoint, env_steps, track, preset.

    Returns:
        What contract.json holds, but for ``files`` and ``verification``.
    """
    size = step.size
    outputs = dict(zip(OUTPUTS, step(*step.example_inputs().values()), strict=True))
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "project_version": version("dreamer_racing"),
        "source": source,
        "weights_sha256": hash_weights(step),
        "model": {
            **asdict(size),
            "parameters": sum(parameter.numel() for parameter in step.parameters()),
        },
        "latent": step.latent,
        "inputs": _describe(step.example_inputs()),
        "outputs": _describe(outputs),
        "feedback": {"h": "h_next", "z": "z_next", "previous_action": "action"},
        "reset": (
            "At the first step of an episode set is_init to true: h, z and previous_action are then ignored and "
            f"replaced inside the graph by {'the learned initial h and z' if size.learned_initial else 'zeros'} and a "
            "zero action. At every other step is_init is false and the three are the outputs of the step before, as "
            "'feedback' says."
        ),
        "preprocessing": (
            "None outside the graph: pixels go in as rendered, uint8 RGB, row 0 at the top (the graph computes "
            "x / 255 - 0.5)."
            if step.interface.pixels
            else "Scale the numbers as dreamer_racing.envs.privileged.RaceVector does; the graph computes their symlog."
        ),
        "camera": _describe_camera(camera) if step.interface.pixels else None,
        "control": {"rate_hz": 1.0 / parameters.control_dt, "period_s": parameters.control_dt},
        "frames": {
            "body": "FLU: x forward, y left, z up, right-handed",
            "body_rates": "right-handed about the body axes: +x rolls right, +y pitches nose down, +z yaws left",
            "collective_thrust": "along body +z, thrust divided by mass",
        },
        "action": _describe_action(parameters),
    }


_MEANINGS = {
    "image_u8": "what the nose camera sees now: (1, height, width, RGB)",
    "vector": "what the drone knows now, instead of an image",
    "h": "deterministic state (belief) after the step before",
    "z": "stochastic state after the step before: one-hots of (latents, classes), flattened",
    "previous_action": "the action of the step before",
    "is_init": "whether this is the first step of an episode",
    "noise": "uniform numbers in [0, 1), fresh at every step, one for each class of each latent: "
    "z is argmax(log p - log(-log(noise)))",
    "action": "mean of the policy, tanh of the network's output, in [-1, 1]: nothing is sampled",
    "h_next": "deterministic state, to be given back as h",
    "z_next": "stochastic state, to be given back as z",
}


def _describe(tensors: Mapping[str, Tensor]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "shape": list(value.shape),
            "type": str(value.dtype).removeprefix("torch."),
            "meaning": _MEANINGS[name],
        }
        for name, value in tensors.items()
    ]


def _describe_camera(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width,
        "height_px": camera.height,
        "vertical_field_of_view_deg": camera.field_of_view,
        "focal_length_px": camera.height / 2 / math.tan(math.radians(camera.field_of_view) / 2),
        "tilt_up_deg": camera.tilt,
        "position_body_m": list(camera.position),
        "model": "pinhole without distortion, looks along body +x tilted up, square pixels, centre at the image's",
    }


def _describe_action(parameters: QuadrotorParameters) -> dict[str, Any]:
    thrust = parameters.collective_thrust_scale
    return {
        "formula": "physical = offset + scale * action, action clipped to [-1, 1]",
        "channels": [
            {"name": "collective_thrust", "unit": "m/s^2", "offset": thrust, "scale": thrust},
            *(
                {"name": f"body_rate_{axis}", "unit": "rad/s", "offset": 0.0, "scale": scale}
                for axis, scale in zip("xyz", parameters.body_rate_max, strict=True)
            ),
        ],
        "hover": [parameters.hover_action, 0.0, 0.0, 0.0],
        "trained_mass_kg": parameters.mass,
        "trained_command_delay_s": parameters.command_delay,
    }


def check_output(output: str | Path) -> Path:
    """Refuse what could only fail after the work is done.

    Returns:
        The absolute path of the ``.onnx`` file to be; its folder exists.

    Raises:
        ValueError: Another suffix, or a folder that already holds the contract of another actor.
        PermissionError: The folder cannot be written.
        MissingPackagesError: Packages that the export needs are not installed.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingPackagesError(
            f"The export needs {', '.join(missing)}, not installed here: pip install 'dreamer_racing[export]' "
            "(in a checkout: pip install -e '.[export]')."
        )
    output = Path(output).expanduser().absolute()
    if output.suffix != ".onnx":
        raise ValueError(f"output={output}: the name must end in .onnx, for instance {output.with_suffix('.onnx')}.")
    try:
        ensure_writable(output.parent)
    except PermissionError as error:
        reason = error.__cause__ or error
        raise PermissionError(f"output={output}: cannot write to its folder ({reason}).") from error
    contract = output.parent / CONTRACT
    if contract.exists() and not output.exists():
        raise ValueError(
            f"output={output}: {contract} describes another actor. Every actor has a folder of its own: choose another "
            "folder, or remove that export."
        )
    return output


def export_actor(
    step: ActorStep, contract: Mapping[str, Any], flight: Flight, output: str | Path, seed: int = 0
) -> dict[str, float]:
    """Write a step as ``.onnx`` and ``.pt2`` with contract.json beside them, if both fly as the original does.

    Args:
        step: The step.
        contract: From `make_contract`.
        flight: To compare them over, at least ``MIN_STEPS`` steps.
        output: Path of the ``.onnx`` file; the ``.pt2`` has the same stem. Those of an earlier export are replaced.
        seed: Of the noise that samples latents in the comparison.

    Returns:
        Largest deviation of an action from the original's, of either.

    Raises:
        ParityError: If one does not fly alike; no file is left and those of an earlier export stay.
        ValueError: If the flight is too short, or the weights too many for one ONNX file; as `check_output`.
        PermissionError, MissingPackagesError: As `check_output`.
    """
    _check_steps(len(flight.observations))
    output = check_output(output)
    partial = output.parent / f".{output.stem}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        onnx, program = partial / output.name, partial / output.with_suffix(".pt2").name
        write_step(step, onnx, program)
        files = {
            kind: {"name": path.name, "sha256": hash_file(path)}
            for kind, path in (("onnx", onnx), ("torch_export", program))
        }
        full = {**contract, "files": files}
        _write_json(partial / CONTRACT, full)
        actors: dict[str, RecurrentActor] = {
            "torch": TorchActor(full, step),
            "onnxruntime": OnnxActor(onnx),
            "torch.export": TorchActor(full, torch.export.load(program).module()),
        }
        deviation = check_parity(actors, flight, seed)
        full["verification"] = {
            "steps": len(flight.observations),
            "episodes": flight.episodes,
            "action_deviation_max": deviation,
            "action_deviation_allowed": ACTION_TOLERANCE,
            "latent_flips": 0,
        }
        _write_json(partial / CONTRACT, full)
        for path in (program, onnx, partial / CONTRACT):
            os.replace(path, output.parent / path.name)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return deviation


def write_step(step: ActorStep, onnx: Path, program: Path) -> None:
    """Write a step as ONNX file, weights inside, and as ``torch.export`` program.

    Raises:
        ValueError: If the weights are too many for one ONNX file.
    """
    size = sum(parameter.nbytes for parameter in step.parameters())
    if size >= PROTOBUF_LIMIT:
        raise ValueError(f"The actor's weights are {size / 1e9:.1f} GB; an ONNX file holds less than 2 GB.")
    inputs = step.example_inputs()
    with torch.no_grad():
        exported = torch.export.export(step, tuple(inputs.values()))
    for node in exported.graph.nodes:
        # Paths of this machine's source files, which both formats would keep.
        node.meta.pop("stack_trace", None)
    torch.export.save(exported, program)
    torch.onnx.export(
        exported,
        f=onnx,
        dynamo=True,
        input_names=list(inputs),
        output_names=list(OUTPUTS),
        external_data=False,
        verbose=False,
    )


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
