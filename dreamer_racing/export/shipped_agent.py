"""Loading of agents for flight, from a run's checkpoint or from an agent folder.

An agent folder holds `FILES` (docs/agents.md), and no critic, heads, decoders, optimiser or replay buffer.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.protocol import MODES
from dreamer_racing.export.actor_step import WEIGHTS
from dreamer_racing.export.agents import agent_path, agents_that_ship
from dreamer_racing.export.contract import describe_camera, hash_tensors
from dreamer_racing.export.onnx_actor import CONTRACT, PARTS, read_contract
from dreamer_racing.export.weights_file import read_weights
from dreamer_racing.learners.saved import check_size
from dreamer_racing.modules import DreamerPolicy, Interface, ModelSize
from dreamer_racing.modules.agent import Agent
from dreamer_racing.settings import check_choice
from dreamer_racing.training.checkpoint import load_state, newest_sound
from dreamer_racing.training.directory import RunDirectory

AGENT, CONFIG, ACTOR = "agent.json", "config.yaml", "actor.onnx"
FILES = (ACTOR, WEIGHTS, CONTRACT, CONFIG, AGENT)
BY_ITEM = ("episodes", "crashes_by_gate")  # entries of an evaluation that agent.json leaves out
AVERAGED, TRAINED = "averaged", "trained"
CHOICES = ("auto", AVERAGED, TRAINED)
"""Choices of a checkpoint's weights: ``auto`` takes the averaged ones if the checkpoint has them."""

_SETTINGS = {
    "camera.width_px": "env.image_size",
    "camera.height_px": "env.image_size",
    "camera.tilt_up_deg": "env.camera_tilt",
    "camera.rate_hz": "env.camera_rate",
}
"""Names of settings by the contract's names."""


def choose_weights(wanted: str, kept: str | tuple[str, ...], source: str | Path) -> str:
    """Resolve one of ``CHOICES`` to ``averaged`` or ``trained``, of the weights kept in a checkpoint or agent folder.

    Raises:
        ValueError: If the choice is unknown, or the source does not hold these weights.

    Example:
        >>> choose_weights("auto", ("averaged", "trained"), "runs/mine")
        'averaged'
    """
    kept = (kept,) if isinstance(kept, str) else kept
    check_choice("weights", wanted, CHOICES)
    if wanted == "auto":
        return AVERAGED if AVERAGED in kept else TRAINED
    if wanted not in kept:
        raise ValueError(f"weights={wanted}: {source} holds the {' and the '.join(kept)} weights only.")
    return wanted


def kept_weights(state: dict[str, Any]) -> tuple[str, ...]:
    """Return which weights a learner's state holds."""
    return (AVERAGED, TRAINED) if AVERAGED in state else (TRAINED,)


def load_agent(checkpoint: str | Path, interface: Interface, weights: str = "auto") -> tuple[Agent, dict[str, Any]]:
    """Restore the agent of a checkpoint, without decoders, on the CPU.

    Args:
        checkpoint: Run directory, folder of checkpoints, or one checkpoint.
        interface: Observations and actions of the agent.
        weights: One of ``CHOICES``.

    Returns:
        The agent and the checkpoint's metadata with ``env_steps``, and the chosen weights' name as ``weights``.

    Raises:
        FileNotFoundError: If there is no complete checkpoint.
        CheckpointError: If the checkpoint has no learner.
        ValueError: If the networks do not fit the interface, or the checkpoint does not hold the chosen weights.
    """
    state, metadata = load_state(checkpoint, "learner")
    chosen = choose_weights(weights, kept_weights(state), checkpoint)
    agent = Agent(_size(state["size"]), interface, decode=False)
    try:
        missing = agent.load_state_dict(state[AVERAGED if chosen == AVERAGED else "agent"], strict=False).missing_keys
    except RuntimeError as error:
        raise ValueError(f"The networks of {checkpoint} do not fit {interface}: {error}") from error
    if missing:
        raise ValueError(f"The networks of {checkpoint} do not fit {interface}: {', '.join(missing[:3])} are missing.")
    return agent.requires_grad_(False), {**metadata, "weights": chosen}


@dataclass
class ShippedAgent:
    """An agent loaded from an agent folder."""

    folder: Path
    agent: Agent
    """Encoder, RSSM and actor, without critic and heads."""
    about: dict[str, Any]
    """Content of agent.json."""
    device: torch.device

    @classmethod
    def load(cls, folder: str | Path, env: DroneRacingEnv, device: torch.device | str = "cpu") -> ShippedAgent:
        """Restore an agent for an environment with the camera and the control rate of its training.

        Raises:
            FileNotFoundError: If the folder lacks a file.
            ValueError: If the environment differs from that of training, or the weights differ from contract.json.
        """
        folder, device = Path(folder), torch.device(device)
        about, contract = read_about(folder), read_contract(folder / CONTRACT)
        _require_files(folder, *(file["name"] for part in PARTS if (file := contract["files"].get(part))))
        check_env(folder, contract, env)
        agent = Agent(_size(contract["model"]), Interface.of(env), decode=False)
        agent.register_module("critic", None)
        agent.world_model.register_module("reward_head", None)
        agent.world_model.register_module("continue_head", None)
        load_networks(folder, agent)
        # Hash the file, not the network: newer networks may have entries that the file lacks.
        if hash_tensors(read_weights(folder / WEIGHTS)) != contract["weights_sha256"]:
            raise ValueError(
                f"{folder / WEIGHTS} holds other weights than {folder / CONTRACT} describes: copy it again."
            )
        return cls(folder, agent.requires_grad_(False).to(device), about, device)

    def evaluation_policy(self) -> DreamerPolicy:
        """Return the policy, which shares the agent's parameters."""
        return DreamerPolicy(self.agent.world_model, self.agent.actor)

    def value_function(self) -> None:
        """Return None, because an agent folder has no critic."""


def load_trained(folder: Path, env: DroneRacingEnv, *agents: Agent, actor: bool = True) -> None:
    """Load the weights of an agent folder into agents that go on training in an environment, as `load_networks`.

    Raises:
        ValueError: The agents have another size, or the environment differs from that of training.
    """
    contract = read_contract(folder / CONTRACT)
    for agent in agents:
        check_size(contract["model"], agent.size)
    check_env(folder, contract, env)
    for agent in agents:
        load_networks(folder, agent, actor)


def load_networks(folder: Path, agent: Agent, actor: bool = True) -> None:
    """Load the weights of an agent folder into encoder, RSSM and, if wanted, actor.

    Raises:
        ValueError: If names or shapes differ.
    """
    weights = read_weights(folder / WEIGHTS)
    parts = {"encoder.": agent.world_model.encoder, "rssm.": agent.world_model.rssm}
    parts |= {"actor.": agent.actor} if actor else {}
    try:
        for prefix, part in parts.items():
            own = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
            part.load_state_dict(own)
    except RuntimeError as error:
        raise ValueError(f"{folder / WEIGHTS} does not fit {folder / CONTRACT}: {error}") from error


def is_agent(folder: str | Path) -> bool:
    """Return whether a folder is an agent folder."""
    return (Path(folder) / AGENT).is_file()


def find_trained(name: str) -> Path:
    """Return the folder of the agent, or the newest checkpoint, that `checkpoint=` or `agent=` names.

    The name is that of an included agent, or the path of an agent's folder, a run directory, or a checkpoint.

    Raises:
        FileNotFoundError: there is neither; the message names the included agents.
    """
    path = agent_path(name)
    if is_agent(path):
        return path.absolute()
    try:
        return newest_sound(name, ("learner", "counters"))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error} {agents_that_ship()}") from error


def config_folder(checkpoint: Path) -> Path:
    """Return the folder that holds the configuration of a checkpoint or an agent."""
    return checkpoint if is_agent(checkpoint) else RunDirectory.of(checkpoint).path


def results_of(checkpoint: Path) -> Path:
    """Return the folder for results of a checkpoint or an agent."""
    return Path("runs") / f"agent_{checkpoint.name}" if is_agent(checkpoint) else RunDirectory.of(checkpoint).path


def read_about(folder: str | Path) -> dict[str, Any]:
    """Read the agent.json of a folder.

    Raises:
        FileNotFoundError: If the folder lacks a file.
        ValueError: If agent.json is not valid JSON.
    """
    folder = Path(folder)
    _require_files(folder, *FILES)
    try:
        return json.loads((folder / AGENT).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{folder / AGENT} is not valid JSON: {error}.") from error


def _require_files(folder: Path, *names: str) -> None:
    if missing := [name for name in names if not (folder / name).is_file()]:
        raise FileNotFoundError(f"The agent {folder} lacks {', '.join(missing)}: copy the whole folder again.")


def check_env(folder: str | Path, contract: dict[str, Any], env: DroneRacingEnv) -> None:
    """Check that an environment has the observations and the control rate of an agent's training.

    Raises:
        ValueError: The message names the setting, the agent's value and the environment's.
    """
    camera = contract.get("camera")
    pairs: dict[str, tuple[Any, Any]] = {
        "env.control_rate": (contract["control"]["rate_hz"], 1.0 / env.worlds.parameters.control_dt),
        "env.from_pixels": (camera is not None, env.from_pixels),
        "env.imu": ("exact" if "imu" in contract else "none", "exact" if env.worlds.imu is not None else "none"),
        "env.vector": ("none", "none" if env.worlds.custom_vector is None else "a custom one"),
    }
    if camera is not None and env.from_pixels:
        here = describe_camera(env.worlds.camera)
        pairs |= {f"camera.{name}": (camera.get(name), here.get(name)) for name in {**camera, "rate_hz": None}}
    for name, (trained, given) in pairs.items():
        numbers = isinstance(trained, float) and isinstance(given, int | float)
        if not (math.isclose(trained, given, rel_tol=1e-6, abs_tol=1e-9) if numbers else trained == given):
            setting = _SETTINGS.get(name, name)
            raise ValueError(
                f"{setting}={given}: the agent {folder} was trained with {setting}={trained}, and flies "
                "with nothing else."
            )


def newest_evaluation(folder: Path, weights_sha256: str, track_sha256: str) -> Path:
    """Return a run's latest evaluation of these weights on this track; without one, a file that is refused when read.

    Each evaluation has a folder of its own.
    """
    first = RunDirectory(folder).evaluation_file
    there = first.parent.parent.glob(f"{first.parent.name}*/{first.name}")
    texts = {path: path.read_text(encoding="utf-8") for path in there}
    of_these = [path for path, text in texts.items() if f'"weights_sha256": "{weights_sha256}"' in text]
    fitting = [path for path in of_these if f'"track_sha256": "{track_sha256}"' in texts[path]]
    return max(fitting or of_these, key=lambda path: path.stat().st_mtime, default=first)


def read_evaluation(
    path: Path, checkpoint: Path, weights_sha256: str, track: str, track_sha256: str, preset: str, how: str
) -> dict[str, Any]:
    """Return the statistics of an evaluation of these weights in the race that they were trained for, for agent.json.

    Messages end with ``how``, a sentence that says how to make the evaluation.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is of other weights, another track or other physics (`name_of_preset`), or no evaluation.
    """
    if not path.is_file():
        raise FileNotFoundError(f"There is no evaluation {path}: an agent ships with its results. {how}")
    try:
        written = json.loads(path.read_text(encoding="utf-8"))
        made = written["provenance"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not an evaluation by recipes/evaluate.py ({error!r}). {how}") from error
    if made.get("weights_sha256") != weights_sha256:
        raise ValueError(f"{path} is an evaluation of other weights than those of {checkpoint}. {how}")
    if made.get("track_sha256") is None:
        raise ValueError(f"{path} does not say which track it was flown on. {how}")
    if made["track_sha256"] != track_sha256:
        there = "another track, or with other decoys" if made["track"] == track else made["track"]
        raise ValueError(f"{path} was flown on {there}, and the agent was trained on {track}. {how}")
    if (there := made["preset"]) != preset:
        raise ValueError(f"{path} was flown with preset={there}, and the agent was trained with {preset}. {how}")
    names = ("episodes", "seed", "start_noise", "preset", "decoys", "date", "commit")
    statistics = {mode: {name: value for name, value in written[mode].items() if name not in BY_ITEM} for mode in MODES}
    return {**{name: made[name] for name in names}, **statistics}


def _size(saved: dict[str, Any]) -> ModelSize:
    """Build a model size from its saved form, with lists as tuples; other entries are ignored."""
    known = {field.name: saved[field.name] for field in fields(ModelSize) if field.name in saved}
    size: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in known.items()}
    return ModelSize(**size)
