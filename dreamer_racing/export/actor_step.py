"""Export of the recurrent actor as one step with explicit state, published only if all copies match the original.

The step is ``(observation, h, z, previous_action, is_init[, imu][, noise]) -> (action, h_next, z_next)``, batch size 1.
Of its two `PARTS`, ``advance`` needs no observation, so that a vehicle can run it between control steps.

Shape legend: D belief, S state = L·K, L latents, K classes, A action, V vector entries.
"""

from __future__ import annotations

import copy
import importlib.util
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dreamer_racing.commands import install_extra
from dreamer_racing.envs.race.race import RACE_VECTOR_SIZE
from dreamer_racing.export.onnx_actor import CONTRACT, PARTS, RECURRENT, OnnxActor, RecurrentActor, hash_file
from dreamer_racing.export.parity import ACTION_TOLERANCE, RecordedFlight, TorchActor, check_parity, check_steps
from dreamer_racing.export.weights_file import write_weights
from dreamer_racing.modules import join_features
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import IMU, PIXELS, VECTOR
from dreamer_racing.modules.layers import use_few_kernels
from dreamer_racing.modules.rssm import mix_uniform
from dreamer_racing.settings import check_choice
from dreamer_racing.training.directory import ensure_writable

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
OUTPUTS = ("action", "h_next", "z_next")
WEIGHTS = "weights.safetensors"
PROTOBUF_LIMIT = 2_000_000_000  # bytes, maximum size of an ONNX file without external data


class MissingPackagesError(ImportError):
    """Packages that the export needs are not installed."""


class ActorStep(nn.Module):
    """One step with explicit state: z is the posterior's mode, the action the mean of the actor's clipped samples.

    Encoder, RSSM and actor are copied from an agent.

    Example:
        >>> from dreamer_racing.modules import Interface, get_size
        >>> step = ActorStep(Agent(get_size("debug"), Interface(), decode=False))
        >>> list(step.example_inputs())
        ['image_u8', 'h', 'z', 'previous_action', 'is_init']
        >>> [tuple(output.shape) for output in step(*step.example_inputs().values())]
        [(1, 4), (1, 32), (1, 16)]
    """

    latent = "mode"
    noise_shape: tuple[int, int] | None = None
    """Shape (L, K) of the input ``noise``; None without noise."""

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.interface, self.size = agent.interface, agent.world_model.size
        self.encoder = copy.deepcopy(agent.world_model.encoder)
        self.rssm = copy.deepcopy(agent.world_model.rssm)
        self.actor = copy.deepcopy(agent.actor)
        self.cpu()
        use_few_kernels(self, on=False)
        for parameter in self.parameters():
            parameter.data = parameter.data.contiguous()  # torch.export cannot save channels-last weights
        self.requires_grad_(False)

    def forward(
        self, observation: Tensor, h: Tensor, z: Tensor, previous_action: Tensor, is_init: Tensor, *more: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute one step.

        Args:
            observation: uint8 ``(1, height, width, 3)``, or float32 ``(1, V)``.
            h: Belief after the last step, ``(1, D)``; ignored if ``is_init``, as are ``z`` and ``previous_action``.
            z: State after the last step, ``(1, S)``.
            previous_action: ``(1, A)``.
            is_init: Whether this is the first step of an episode, bool ``(1,)``.
            more: Vector observed besides images, float32 ``(1, V)``, if any; then the noise, if any.

        Returns:
            Action ``(1, A)`` in [−1, 1], next belief ``(1, D)``, next state ``(1, S)``.
        """
        h = self.advance(h, z, previous_action, is_init)
        action, z = self.act(observation, h, *more)
        return action, h, z

    def advance(self, h: Tensor, z: Tensor, previous_action: Tensor, is_init: Tensor) -> Tensor:
        """Return the next belief ``(1, D)``; arguments as in `forward`."""
        return self.rssm.advance(previous_action, is_init, h, z)

    def act(self, observation: Tensor, h: Tensor, *more: Tensor) -> tuple[Tensor, Tensor]:
        """Return action ``(1, A)`` and next state ``(1, S)`` from the observation and the next belief ``(1, D)``."""
        z = self.rssm.posterior_state(h, self._embed(observation, *more), deterministic=True)
        return self.actor(join_features(h, z)).clipped_mean(), z

    def example_inputs(self) -> dict[str, Tensor]:
        """Return inputs by name, in the order of ``forward``."""
        size, interface = self.size, self.interface
        memory = {
            "h": torch.zeros(1, size.belief),
            "z": torch.zeros(1, size.state),
            "previous_action": torch.zeros(1, interface.action_dim),
            "is_init": torch.ones(1, dtype=torch.bool),
        }
        numbers = {interface.vector_key: torch.zeros(1, interface.vector_dim)} if interface.vector_dim else {}
        noise = {} if self.noise_shape is None else {"noise": torch.full((1, *self.noise_shape), 0.5)}
        if not interface.pixels:
            return numbers | memory | noise
        return {"image_u8": torch.zeros(1, *interface.image_shape, dtype=torch.uint8)} | memory | numbers | noise

    def _embed(self, *seen: Tensor) -> Tensor:
        return self.encoder(dict(zip(self.interface.observation_keys, seen, strict=True)))


class SampledActorStep(ActorStep):
    """One step with explicit state whose z is a sample of the posterior, by the Gumbel-max trick.

    The distribution is that of the training policy, which samples by inverting the cumulative distribution: there,
    rounding shifts the edges of all later classes; here, only a tie of the two best classes can flip in a copy.

    Reference: Maddison et al., "A* Sampling", 2014.
    """

    latent = "sample"

    def __init__(self, agent: Agent) -> None:
        super().__init__(agent)
        self.noise_shape = self.size.latents, self.size.classes

    def act(self, observation: Tensor, h: Tensor, *more: Tensor) -> tuple[Tensor, Tensor]:
        """Return action and next state as `ActorStep.act`; the last argument is the noise ``(1, L, K)`` in [0, 1)."""
        *imu, noise = more
        probabilities = mix_uniform(self.rssm.posterior_logits(h, self._embed(observation, *imu)), self.rssm.unimix)
        gumbel = -(-noise.log()).log()
        index = (probabilities.log() + gumbel).argmax(-1, keepdim=True)
        z = torch.zeros_like(probabilities).scatter(-1, index, 1.0).flatten(1)
        return self.actor(join_features(h, z)).clipped_mean(), z


class StepPart(nn.Module):
    """One of the `PARTS` of a step, as a module of its own for export."""

    def __init__(self, step: ActorStep, name: str) -> None:
        super().__init__()
        self.step, self.name = step, name

    def forward(self, *inputs: Tensor) -> Any:
        """Compute the part; inputs in the order of `example_inputs`."""
        return getattr(self.step, self.name)(*inputs)

    def example_inputs(self) -> dict[str, Tensor]:
        """Return inputs by name, in the order of ``forward``."""
        given, before = self.step.example_inputs(), (*RECURRENT, "is_init")
        if self.name == "advance":
            return {name: given[name] for name in before}
        seen, *more = (name for name in given if name not in before)
        return {seen: given[seen], "h_next": torch.zeros_like(given["h"]), **{name: given[name] for name in more}}


LATENTS: dict[str, type[ActorStep]] = {step.latent: step for step in (ActorStep, SampledActorStep)}
"""Classes of exported steps by latent mode."""


def make_step(agent: Agent, latent: str) -> ActorStep:
    """Make the step of an agent with a latent mode, one of `LATENTS`; raise ValueError if it cannot be exported."""
    check_choice("latent", latent, LATENTS)
    if latent == "sample" and not agent.world_model.rssm.sampled:
        raise ValueError(
            "latent=sample: this agent uses the probabilities of its categorical latents and never samples them "
            "(model.sampled=false): export it with latent=mode."
        )
    seen = agent.interface.observation_keys
    if seen not in ([PIXELS], [VECTOR], [PIXELS, IMU]):
        raise ValueError(f"This agent observes {' and '.join(seen)}; besides images, only an IMU can be exported.")
    if seen == [VECTOR] and agent.interface.vector_dim != RACE_VECTOR_SIZE:
        raise ValueError(
            f"This agent observes a custom vector of {agent.interface.vector_dim} numbers; only the race's "
            f"{RACE_VECTOR_SIZE} numbers can be exported."
        )
    return LATENTS[latent](agent)


def check_output(output: str | Path) -> Path:
    """Check the installed packages and the path of the ``.onnx`` file; return the path, absolute, with its folder made.

    Raises:
        ValueError: The suffix is wrong, or the folder already holds the contract of another actor.
        PermissionError: The folder is not writable.
        MissingPackagesError: Packages that the export needs are not installed.
    """
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingPackagesError(
            f"The export needs {', '.join(missing)}, not installed here: {install_extra('export')}."
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
    if contract.exists() and _described(contract).get("onnx") != output.name:
        raise ValueError(
            f"output={output}: {contract} describes another actor. Every actor needs its own folder: choose another "
            "folder, or remove that export."
        )
    return output


def _described(contract: Path) -> dict[str, str]:
    """Return the file names in a contract by kind; empty if it does not exist or cannot be read."""
    try:
        files = json.loads(contract.read_text(encoding="utf-8"))["files"]
        return {kind: Path(file["name"]).name for kind, file in files.items()}  # only files beside the contract
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def export_actor(
    step: ActorStep,
    contract: Mapping[str, Any],
    flight: RecordedFlight,
    output: str | Path,
    seed: int = 0,
    shared_weights: bool = False,
    parts: bool = False,
) -> dict[str, float]:
    """Write a step as ``.onnx`` and ``.pt2`` with a contract.json, if all copies match the original.

    Args:
        step: The step.
        contract: Contract from `contract.make_contract`.
        flight: Flight for the comparison, at least ``MIN_STEPS`` steps.
        output: Path of the ``.onnx`` file; the other files are named after its stem. Files of an earlier export, which
            its contract names, are replaced.
        seed: Seed of the noise that samples latents in the comparison.
        shared_weights: Write the weights to one separate file for ONNX and torch, instead of into each ONNX file; the
            ``.pt2``, which would hold them again, is compared but not kept.
        parts: Also write the two `PARTS` of the step as ONNX files.

    Returns:
        Largest deviation of an action from the original's, by copy.

    Raises:
        ParityError: If a copy deviates too much; no new file is left and an earlier export is kept.
        ValueError: If the flight is too short, or the weights too large for one ONNX file; see also `check_output`.
        PermissionError, MissingPackagesError: See `check_output`.
    """
    check_steps(len(flight.observations))
    output = check_output(output)
    earlier = set(_described(output.parent / CONTRACT).values())  # only these may be removed
    partial = output.parent / f".{output.stem}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    try:
        onnx, program = partial / output.name, partial / output.with_suffix(".pt2").name
        graphs = {"onnx": onnx, **{name: partial / f"{output.stem}_{name}.onnx" for name in PARTS if parts}}
        write_step(step, onnx, program)
        for name in PARTS if parts else ():
            write_onnx(StepPart(step, name), PARTS[name], graphs[name])
        written = {**graphs, "torch_export": program}
        if shared_weights:
            written = {**graphs, "weights": partial / WEIGHTS}
            share_weights(step, list(graphs.values()), written["weights"])
        files = {kind: {"name": path.name, "sha256": hash_file(path)} for kind, path in written.items()}
        full = {**contract, "files": files}
        _write_json(partial / CONTRACT, full)
        actors: dict[str, RecurrentActor] = {
            "torch": TorchActor(full, step),
            "onnxruntime": OnnxActor(onnx, whole=True),
            "torch.export": TorchActor(full, torch.export.load(program).module()),
        }
        if parts:
            actors["onnxruntime in parts"] = OnnxActor(onnx)
        deviation = check_parity(actors, flight, seed)
        full["verification"] = {
            "steps": len(flight.observations),
            "episodes": flight.episodes,
            "action_deviation_max": deviation,
            "action_deviation_allowed": ACTION_TOLERANCE,
            "latent_flips": 0,
        }
        _write_json(partial / CONTRACT, full)
        for path in (*written.values(), partial / CONTRACT):
            os.replace(path, output.parent / path.name)
        for name in earlier - {path.name for path in written.values()}:
            (output.parent / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return deviation


def write_step(step: ActorStep, onnx: Path, program: Path) -> None:
    """Write a step as ONNX file with weights and as ``torch.export`` program; raise ValueError if it is too large."""
    size = sum(parameter.nbytes for parameter in step.parameters())
    if size >= PROTOBUF_LIMIT:
        raise ValueError(f"The actor's weights are {size / 1e9:.1f} GB; an ONNX file holds less than 2 GB.")
    torch.export.save(write_onnx(step, OUTPUTS, onnx), program)


def write_onnx(step: ActorStep | StepPart, outputs: Sequence[str], path: Path) -> torch.export.ExportedProgram:
    """Write a step or a part of it as ONNX file with its weights; return the ``torch.export`` program."""
    inputs = step.example_inputs()
    with torch.no_grad():
        exported = torch.export.export(step, tuple(inputs.values()))
    for node in exported.graph.nodes:
        # Otherwise both formats would keep paths of this machine's source files.
        node.meta.pop("stack_trace", None)
    names: dict[str, Any] = {"input_names": list(inputs), "output_names": list(outputs)}
    torch.onnx.export(exported, f=path, dynamo=True, external_data=False, verbose=False, **names)
    return exported


def share_weights(step: ActorStep, files: Sequence[Path], weights: Path) -> None:
    """Write the weights of a step to a file, and replace those inside its ONNX files by references to it.

    Weights that the exporter has transformed, or merged with an equal one, stay inside the ONNX file.
    """
    import onnx as onnx_format

    extents = write_weights(weights, step.state_dict())
    content = weights.read_bytes()
    for file in files:
        model = onnx_format.load(file)
        for tensor in model.graph.initializer:
            extent = extents.get(tensor.name.removeprefix("step."))
            if extent and tensor.raw_data == content[extent.offset : extent.offset + extent.length]:
                onnx_format.external_data_helper.set_external_data(tensor, weights.name, *extent)
                tensor.ClearField("raw_data")
        file.write_bytes(model.SerializeToString())


def _write_json(path: Path, value: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
