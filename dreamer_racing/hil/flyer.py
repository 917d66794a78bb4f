"""Who flies: an exported actor that sees images, or whoever else turns a pose into a setpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.export.onnx_actor import OnnxActor
from dreamer_racing.hil.camera import camera_of
from dreamer_racing.hil.vehicle import Pose, Setpoint


class Flyer(Protocol):
    """Chooses a setpoint at each tick.

    Attributes:
        rate: Hz, of ticks.
        camera: Through which it sees; None: it needs no image.
    """

    rate: float
    camera: Camera | None

    def reset(self) -> None:
        """Begin a flight: forget everything before it."""
        ...

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        """Choose from where the vehicle is, what it sees if the flyer has a camera, and which gate comes next."""
        ...


class ActorFlyer:
    """An exported actor: it sees the image and nothing else.

    Args:
        path: The ``.onnx`` file, or the folder of an agent that ships.

    Attributes:
        contract: Of the actor.

    Raises:
        FileNotFoundError: There is none.
        ValueError: Its contract is broken, or it sees numbers.
        ImportError: onnxruntime is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._actor = OnnxActor(path / "actor.onnx" if path.is_dir() else path, seed=0)  # replays draw the same noise
        self.contract: dict[str, Any] = self._actor.contract
        self.camera: Camera | None = camera_of(self.contract)
        self.rate = float(self.contract["control"]["rate_hz"])

    def reset(self) -> None:
        """Begin a flight."""
        self._actor.reset()

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        """Choose by the image."""
        assert image is not None, "there is a camera, so there is an image"
        thrust, *rates = self._actor.setpoint(self._actor.step(image))
        return Setpoint(float(thrust), np.array(rates))


def check_contract(contract: dict[str, Any], track: str, rate: float | None = None) -> None:
    """Refuse an actor that was trained for something else than what it is to fly.

    Args:
        contract: Of the actor.
        track: Name of the track.
        rate: Hz, of the loop; None for the actor's own.

    Raises:
        ValueError: The message names the fields that differ, with both values.
    """
    trained = contract.get("source", {}).get("track")
    own_rate = contract["control"]["rate_hz"]
    differing = []
    if trained is not None and trained != track:
        differing.append(f"source.track is {trained!r}, and track={track}")
    if rate is not None and abs(rate - own_rate) > 1e-6:
        differing.append(f"control.rate_hz is {own_rate:g}, and rate={rate:g}")
    image = contract["inputs"][0]
    if (camera := contract.get("camera")) is not None:
        described = [1, camera["height_px"], camera["width_px"], 3]
        if image["shape"] != described:
            differing.append(f"camera says images of {described}, and the input {image['name']} is {image['shape']}")
    if differing:
        raise ValueError(f"The actor's contract does not fit: {'; '.join(differing)}.")
