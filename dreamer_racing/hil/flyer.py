"""Flyers: an exported actor that sees images, or anything else that turns a pose into a setpoint."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dreamer_racing.envs.drone.parameters import QuadrotorParameters, load_preset
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track, hash_track, load_track, read_track
from dreamer_racing.export.onnx_actor import OnnxActor
from dreamer_racing.hil.camera import camera_of
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Pose, Setpoint

CHANNELS = ("collective_thrust", "body_rate_x", "body_rate_y", "body_rate_z")
"""An actor's actions, in the order of a `Setpoint`."""
TOLERANCE = 0.1
"""Share by which gains and motors may differ from those of training, beyond its randomisation [choice]."""


class Flyer(Protocol):
    """Chooses a setpoint at each tick."""

    rate: float  # Hz, of ticks
    camera: Camera | None  # that it sees through; None: it needs no image

    def reset(self) -> None:
        """Begin a flight with empty memory."""

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        """Choose a setpoint by the pose, the image (None without a camera) and the index of the next gate."""

    def prepare(self) -> None:
        """Do the part of the next tick that can be done ahead; called after a command was sent."""


class ActorFlyer:
    """An exported actor, whose only inputs are the image and, if it was trained with them, IMU samples.

    Args:
        path: The ``.onnx`` file, or the folder of an included agent.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: Its contract is invalid, or it was not trained on images.
        ImportError: onnxruntime is not installed.
    """

    def __init__(self, path: Path) -> None:
        self._actor = OnnxActor(path / "actor.onnx" if path.is_dir() else path, seed=0)  # replays draw the same noise
        self.contract: dict[str, Any] = self._actor.contract
        self.camera: Camera | None = camera_of(self.contract)
        self.rate = float(self.contract["control"]["rate_hz"])
        self.needs_imu = self._actor.needs_imu

    def reset(self) -> None:
        """Begin a flight."""
        self._actor.reset()

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int, imu: np.ndarray | None = None) -> Setpoint:
        """Return the actor's setpoint for the image and, if it uses the IMU, a sample (6,)."""
        assert image is not None, "there is a camera, so there is an image"
        sample = None if imu is None else imu.astype(np.float32)
        thrust, *rates = self._actor.setpoint(self._actor.step(image, imu=sample))
        return Setpoint(float(thrust), np.array(rates))

    def prepare(self) -> None:
        """Advance the actor's memory by the action that it chose."""
        self._actor.prepare()


def trained_track(contract: dict[str, Any]) -> Track:
    """Return the track that an actor was trained on, by its name or, if it was a file, its description in the contract.

    Raises:
        ValueError: The contract names no track, there is none of its name here, or the description is invalid.
    """
    source = contract["source"]
    if source.get("track") is None:
        raise ValueError("The actor's contract names no track (source.track): give track=.")
    if (described := source.get("track_description")) is None:
        return load_track(source["track"])
    return read_track(described, "the contract's source.track_description")


def check_contract(contract: dict[str, Any], track: Track, rate: float | None = None) -> None:
    """Refuse an actor that was trained for another track, rate (Hz; None: its own) or image size.

    The track's geometry must be that of the contract, its name may differ.

    Raises:
        ValueError: The message names the fields that differ, with both values.
    """
    differing = []
    source, own_rate = contract["source"], contract["control"]["rate_hz"]
    if (channels := [channel["name"] for channel in contract["action"]["channels"]]) != list(CHANNELS):
        differing.append(f"action.channels are {', '.join(channels)}, not {', '.join(CHANNELS)}, in this order")
    geometry, found = source.get("track_sha256"), hash_track(track)
    if geometry is None:
        differing.append(
            f"it lacks source.track_sha256, so whether it was trained on track={track.name} is unknown: export it "
            "again with recipes/export.py, or give make_contract track_sha256=hash_track(track)"
        )
    elif geometry != found:
        differing.append(
            f"source.track is {source.get('track')!r}, whose gates, start and bounds have the hash "
            f"{geometry[:12]} (source.track_sha256), but those of track={track.name} have {found[:12]}"
        )
    if rate is not None and abs(rate - own_rate) > 1e-6:
        differing.append(f"control.rate_hz is {own_rate:g}, but rate={rate:g}")
    image = contract["inputs"][0]
    if (camera := contract.get("camera")) is not None:
        described = [1, camera["height_px"], camera["width_px"], 3]
        if image["shape"] != described:
            differing.append(f"camera gives images of {described}, but the input {image['name']} is {image['shape']}")
    if differing:
        raise ValueError(f"The actor's contract does not fit: {'; '.join(differing)}.")


def check_rate_loop(contract: dict[str, Any], vehicle: str, force: bool) -> str | None:
    """Refuse an actor of another rate loop than that of a vehicle, a preset or a file, unless ``force``.

    Returns:
        What differs, if forced, or was not compared, in words; None if the rate loops match.

    Raises:
        ValueError: They differ and ``force`` is false (the message names both), or there is no such vehicle.
    """
    trained, there = _trained_loop(contract), load_preset(vehicle)
    if trained is None:
        return f"the contract does not describe a rate loop: it was not compared with vehicle={vehicle}"
    if (misfit := _rate_loop_mismatch(trained, there)) is None:
        return None
    words = f"The actor was trained with {misfit[0]}, but vehicle={vehicle} has {misfit[1]}"
    return _refuse_loop(words, f"env=betaflight env.preset={vehicle}", force)


def check_flown_by_betaflight(contract: dict[str, Any], link: str, force: bool) -> str | None:
    """Refuse an actor that was not trained with Betaflight's rate loop, for a link to a Betaflight, unless ``force``.

    Returns and raises as `check_rate_loop`; a contract that lacks the rate loop is not compared.
    """
    trained = _trained_loop(contract)
    if trained is None or trained["kind"] == "betaflight":
        return None
    words = f"The actor was trained with {_name_loop(trained['kind'])}, but link={link} commands a Betaflight"
    return _refuse_loop(words, "env=betaflight", force)


def _trained_loop(contract: dict[str, Any]) -> dict[str, Any] | None:
    """Return the rate loop of training from a contract; if an older one lacks it, that of its preset."""
    preset = contract.get("source", {}).get("preset")
    old = {"kind": "proportional"} if preset in ("easy", "faithful") else None
    return contract.get("rate_loop", old)


def _refuse_loop(words: str, remedy: str, force: bool) -> str:
    if force:
        return f"{words}; it flies anyway (force=true)"
    raise ValueError(
        f"{words}: the vehicle would not respond as in training. Train with {remedy}, or add force=true to fly anyway."
    )


def _name_loop(kind: str) -> str:
    return {"proportional": "a proportional rate loop", "betaflight": "a Betaflight's rate loop"}.get(kind, kind)


def _rate_loop_mismatch(trained: dict[str, Any], there: QuadrotorParameters) -> tuple[str, str] | None:
    """Return the first mismatch in words, of the contract's and the vehicle's rate loop; None if within tolerances."""
    kind = "proportional" if there.betaflight is None else "betaflight"
    if trained["kind"] != kind:
        return _name_loop(trained["kind"]), _name_loop(kind)
    if there.betaflight is None:
        return None
    widths = trained.get("trained_half_widths", {})
    rows = [
        (f"{name} of {axis}", trained[name][index], getattr(there.betaflight, name)[index], widths.get("gains", 0.0))
        for name in ("p", "d")
        for index, axis in enumerate(("roll", "pitch", "yaw"))
    ]
    lag = trained["motor_time_constant_s"]
    rows.append(("a motor lag of", lag, there.motor_time_constant, widths.get("motor_lag", 0.0)))
    for name, known, other, width in rows:
        if abs(other - known) > (width + TOLERANCE) * known + 1e-9:
            unit = " s" if name == "a motor lag of" else ""
            return f"{name} {known:g}{unit} (± {width:.0%})", f"{name} {other:g}{unit}"
    return None


def thrust_note(contract: dict[str, Any], most: float) -> list[str]:
    """Return a note if a vehicle's largest collective thrust, m/s², is less than an actor may ask for.

    What training's randomisation took off, of the same drone, is not said.
    """
    channels = {channel["name"]: channel for channel in contract["action"]["channels"]}
    if (channel := channels.get("collective_thrust")) is None:
        return []
    asked = channel["offset"] + abs(channel["scale"])
    widths = contract["action"].get("trained_half_widths", {})
    weaker, sagging, heavier = (widths.get(name, 0.0) for name in ("thrust", "sag_max", "mass"))
    if most >= asked * (1.0 - weaker) * (1.0 - sagging) / (1.0 + heavier):
        return []
    there = f"the vehicle gives at most {most:.4g}: more is cut off"
    return [f"thrust: the actor may ask for {asked:.4g} m/s², and {there}"]


def check_ranges(contract: dict[str, Any], limits: SafetyLimits, user_limits: Collection[str] = ()) -> list[str]:
    """Refuse an actor whose action range exceeds the safety limits, which would clip its actions.

    Returns:
        What limits that the user has set clip, and which swings within a control step the limits on changes clip, in
        words.

    Raises:
        ValueError: A limit not set by the user clips; the message names it, both values, and what to set.
    """
    asked = {
        channel["name"]: abs(channel["offset"]) + abs(channel["scale"]) for channel in contract["action"]["channels"]
    }
    rates = [asked.get(f"body_rate_{axis}", 0.0) for axis in "xyz"]
    thrust = asked.get("collective_thrust", 0.0)
    compared = [
        ("rate_max", [round(rate, 6) for rate in rates], list(limits.rate_max), "rad/s about x, y, z"),
        ("thrust_max", [round(thrust, 6)], [limits.thrust_max], "m/s²"),
    ]
    clipped = []
    for name, wanted, most, unit in compared:
        if all(want <= limit + 1e-6 for want, limit in zip(wanted, most, strict=True)):
            continue
        words = f"limits.{name}={_format(most)} clips the actor, which asks for up to {_format(wanted)} {unit}"
        if name not in user_limits:
            raise ValueError(f"{words}. Set limits.{name}={_format(wanted)}, or a smaller one if clipping is intended.")
        clipped.append(words)
    return clipped + _clipped_swings(contract, limits)


def _clipped_swings(contract: dict[str, Any], limits: SafetyLimits) -> list[str]:
    """Return notes on swings over an actor's whole range that the limits clip: within a control step, or downwards."""
    channels = {channel["name"]: channel for channel in contract["action"]["channels"]}
    rate = contract.get("control", {}).get("rate_hz", 0.0)  # the pilot's contract has none: it does not swing
    notes = []
    for name, axes, unit in (
        ("rate_slew", [f"body_rate_{axis}" for axis in "xyz"], "rad/s"),
        ("thrust_slew", ["collective_thrust"], "m/s²"),
    ):
        swing = max((2.0 * abs(channels[axis]["scale"]) for axis in axes if axis in channels), default=0.0)
        if (most := getattr(limits, name)) * (1.0 + 1e-5) < swing * rate:
            notes.append(
                f"limits.{name}={most:g} allows changes of {most / rate:.3g} {unit} a control step at {rate:g} Hz, and "
                f"the actor may ask for {swing:.3g}: limits.{name}={swing * rate:g} clips nothing"
            )
    thrust = channels.get("collective_thrust")
    if thrust is not None and (least := thrust["offset"] - abs(thrust["scale"])) < limits.thrust_min - 1e-6:
        notes.append(f"limits.thrust_min={limits.thrust_min:g} clips the actor, which asks for as little as {least:g}")
    return notes


def _format(numbers: list[float]) -> str:
    return f"{numbers[0]:g}" if len(numbers) == 1 else f"[{','.join(f'{number:g}' for number in numbers)}]"
