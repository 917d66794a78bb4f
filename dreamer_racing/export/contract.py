"""The contract of an exported actor: everything needed to run it, as JSON values."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from torch import Tensor, nn

from dreamer_racing.envs.drone.parameters import GRAVITY, QuadrotorParameters
from dreamer_racing.envs.imu import ImuErrors
from dreamer_racing.envs.race.race import RACE_VECTOR_ENTRIES
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.export.actor_step import OUTPUTS, ActorStep
from dreamer_racing.export.onnx_actor import FORMAT


def make_contract(
    step: ActorStep, parameters: QuadrotorParameters, camera: Camera, imu: ImuErrors | None = None, **source: Any
) -> dict[str, Any]:
    """Return contract.json without ``files`` and ``verification``: a step's inputs and outputs, for users elsewhere.

    Args:
        step: The step.
        parameters: Parameters of the drone that the agent was trained with.
        camera: Camera that the agent was trained with.
        imu: Errors of the IMU that the agent was trained with; None without one.
        source: Origin of the agent, JSON values: checkpoint, env_steps, preset, track and its `hash_track` as
            ``track_sha256``, which flight requires; and for a track from a file its `describe_track` as
            ``track_description``.
    """
    size = step.size
    outputs = dict(zip(OUTPUTS, step(*step.example_inputs().values()), strict=True))
    return {
        "format": FORMAT,
        "format_version": 2 if step.interface.pixels and (camera.rate is not None or imu is not None) else 1,
        "project_version": version("dreamer_racing"),
        "source": source,
        "weights_sha256": hash_weights(step),
        "model": {**asdict(size), "parameters": sum(parameter.numel() for parameter in step.parameters())},
        "latent": step.latent,
        "inputs": _describe(step.example_inputs(), size.sampled),
        "outputs": _describe(outputs, size.sampled),
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
            else "Divide the numbers as 'vector' says; the graph computes their symlog."
        ),
        "camera": describe_camera(camera) if step.interface.pixels else None,
        "vector": None if step.interface.pixels else _describe_vector(),
        **({} if imu is None else {"imu": _describe_imu(imu)}),
        "control": {"rate_hz": 1.0 / parameters.control_dt, "period_s": parameters.control_dt},
        "frames": {
            "body": "FLU: x forward, y left, z up, right-handed",
            "body_rates": "right-handed about the body axes: +x rolls right, +y pitches nose down, +z yaws left",
            "collective_thrust": "along body +z, thrust divided by mass",
        },
        "action": _describe_action(parameters),
        "rate_loop": describe_rate_loop(parameters),
    }


_MEANINGS = {
    "image_u8": "what the nose camera sees now: (1, height, width, RGB)",
    "vector": "what the drone knows now, instead of an image",
    "imu": "what the flight controller's gyro and accelerometer tell now, as 'imu' says",
    "h": "deterministic state (belief) after the step before",
    "z": "stochastic state after the step before, of (latents, classes), flattened: ",
    "previous_action": "the action of the step before",
    "is_init": "whether this is the first step of an episode",
    "noise": "uniform numbers in [0, 1), fresh at every step, one for each class of each latent: "
    "z is argmax(log p - log(-log(noise)))",
    "action": "mean of the policy's samples, each clipped to [-1, 1]: nothing is sampled",
    "h_next": "deterministic state, to be given back as h",
    "z_next": "stochastic state, to be given back as z",
}


def _describe(tensors: Mapping[str, Tensor], sampled: bool) -> list[dict[str, Any]]:
    states = "one-hots" if sampled else "probabilities"
    return [
        {
            "name": name,
            "shape": list(value.shape),
            "type": str(value.dtype).removeprefix("torch."),
            "meaning": _MEANINGS[name] + (states if name == "z" else ""),
        }
        for name, value in tensors.items()
    ]


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return the contract's description of a camera."""
    return {
        "width_px": camera.width,
        "height_px": camera.height,
        "vertical_field_of_view_deg": camera.field_of_view,
        "focal_length_px": camera.height / 2 / math.tan(math.radians(camera.field_of_view) / 2),
        "tilt_up_deg": camera.tilt,
        "position_body_m": list(camera.position),
        "model": "pinhole without distortion, looks along body +x tilted up, square pixels, centre at the image's",
        **({} if camera.rate is None else {"rate_hz": camera.rate}),
    }


def _describe_vector() -> dict[str, Any]:
    return {
        "formula": "entry = physical / divisor, all vectors in the body frame",
        "channels": [
            {"name": f"{meaning}, {axis}", "unit": unit, "divisor": divisor}
            for meaning, unit, divisor in RACE_VECTOR_ENTRIES
            for axis in "xyz"
        ],
    }


def _describe_imu(errors: ImuErrors) -> dict[str, Any]:
    units = {"body_rate": "rad/s", "specific_force": "m/s^2"}
    return {
        "channels": [{"name": f"{name}_{axis}", "unit": unit} for name, unit in units.items() for axis in "xyz"],
        "at_rest": [0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY],
        "trained_errors": asdict(errors),
    }


def _describe_action(parameters: QuadrotorParameters) -> dict[str, Any]:
    thrust, widths = parameters.collective_thrust_scale, parameters.randomisation
    half_widths = {} if widths is None else asdict(widths)
    delays = [half_widths.pop(name, None) for name in ("delay_min", "delay_max")]
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
        "trained_command_delay_s": parameters.command_delay if widths is None else delays,
        **({} if widths is None else {"trained_half_widths": half_widths}),
    }


def describe_rate_loop(parameters: QuadrotorParameters) -> dict[str, Any]:
    """Return the contract's description of the flight controller that an actor was trained with."""
    firmware, widths = parameters.betaflight, parameters.randomisation
    if firmware is None:
        return {"kind": "proportional", "gain_per_s": parameters.rate_gain}
    gains = {name: list(getattr(firmware, name)) for name in ("p", "i", "d")}
    return {
        "kind": "betaflight",
        **gains,
        "motor_time_constant_s": parameters.motor_time_constant,
        "trained_half_widths": {
            "gains": widths.gains if widths else 0.0,
            "motor_lag": widths.motor_lag if widths else 0.0,
        },
    }


def hash_weights(step: nn.Module) -> str:
    """Return the SHA-256 of a step's weights."""
    return hash_tensors(step.state_dict())


def hash_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of tensors over the name, type, shape and little-endian bytes of each, sorted by name."""
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
