"""Runtime of an exported actor on the vehicle's computer; needs only numpy, onnxruntime and the standard library.

The file is self-contained: import it as `dreamer_racing.export.onnx_actor`, or copy it to the flight computer as the
module `onnx_actor`. Run as a program, it measures the latency of one step:

    python onnx_actor.py actor.onnx --steps 1000

Shape legend: D belief, S state, A action, L latents, K classes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import math
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

logger = logging.getLogger(__name__)

CONTRACT = "contract.json"
FORMAT, FORMAT_VERSIONS = "dreamer_racing.actor", (1, 2)
"""Version 2 adds a camera slower than the control rate (``camera.rate_hz``: repeat the last image) and an IMU."""
RECURRENT = ("h", "z", "previous_action")
PARTS = {"advance": ("h_next",), "act": ("action", "z_next")}
"""Outputs of the two parts of a step. Inputs of ``advance`` are the recurrent ones and ``is_init``; inputs of ``act``
are the observation, ``h_next``, and the IMU and noise if the actor has them."""
WARM_UP_STEPS = 20

_TENSOR = {"name": str, "shape": [int], "type": str}
_LAYOUT = {
    "inputs": [_TENSOR],
    "outputs": [_TENSOR],
    "files": {"onnx": {"sha256": str}, **{f"{kind}?": {"name": str, "sha256": str} for kind in ("weights", *PARTS)}},
    "model": {},
    "weights_sha256": str,
    "action": {
        "channels": [{"name": str, "unit": str, "offset": float, "scale": float}],
        "trained_half_widths?": {"mass?": float, "thrust?": float, "sag_max?": float},
    },
    "control": {"rate_hz": float},
    "source": {"track?": str},
    "rate_loop?": {
        "kind": str,
        "p?": [float],
        "d?": [float],
        "motor_time_constant_s?": float,
        "trained_half_widths?": {"gains?": float, "motor_lag?": float},
    },
    "imu?": {"trained_errors": {"delay": int}},
    "camera?": {
        "width_px": int,
        "height_px": int,
        "vertical_field_of_view_deg": float,
        "tilt_up_deg": float,
        "position_body_m": [float],
        "rate_hz?": float,
    },
}
"""Required keys and types of a contract. A list gives the layout of each entry. ``?``: may be absent or null."""
_TYPES = ("uint8", "float32", "bool")
_MOST = 100_000_000  # maximum number of values of one input


class RecurrentActor:
    """Base class that carries h, z and the previous action from step to step; a subclass computes the step.

    Args:
        contract: The contract from `read_contract`.
        seed: Seed of the noise that samples latents, if the actor has any.

    Attributes:
        contract: The contract.
        state: Recurrent inputs of the next step: ``h`` (1, D), ``z`` (1, S) and ``previous_action`` (1, A), float32.
            Change them only before `prepare`.
        is_init: Whether the next step is an episode's first.
    """

    def __init__(self, contract: dict[str, Any], seed: int | None = None) -> None:
        self.contract = contract
        self._shapes = {entry["name"]: tuple(entry["shape"]) for entry in contract["inputs"]}
        observation = contract["inputs"][0]
        self._observed, self._dtype = observation["name"], np.dtype(observation["type"])
        self._random = np.random.default_rng(seed)
        self.reset()

    @property
    def needs_imu(self) -> bool:
        """Whether the actor takes IMU measurements."""
        return "imu" in self._shapes

    @property
    def noise_shape(self) -> tuple[int, ...] | None:
        """Shape (L, K) of the noise of one step; None if the actor takes none."""
        return self._shapes["noise"][1:] if "noise" in self._shapes else None

    def reset(self) -> None:
        """Begin an episode: the next step ignores the state before it."""
        self.state = {name: np.zeros(self._shapes[name], np.float32) for name in RECURRENT}
        self.is_init = True

    def prepare(self) -> None:
        """Compute the part of the next step that needs no observation, if the actor supports it.

        Call it after each step, once the action is sent. Actions do not change.
        """

    def step(
        self, observation: np.ndarray, noise: np.ndarray | None = None, imu: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the action for the current observation; call it once per control period.

        Args:
            observation: uint8 RGB image (height, width, 3), top row first, or float32 vector (V,), as the contract's
                first input specifies.
            noise: Only for ``latent=sample``: uniform numbers in [0, 1), float32 (L, K); drawn here if None.
            imu: Only if the actor has one (`needs_imu`): rates, rad/s, and specific force, m/s², in FLU, float32 (6,).

        Returns:
            Action, float32 (A,) in [−1, 1]; `setpoint` converts it to units.

        Raises:
            ValueError: Wrong shape or type, numbers that are not finite, or noise or IMU for an actor that takes none.
        """
        feed = {
            **self.state,
            self._observed: self._checked(self._observed, observation, self._dtype),
            "is_init": np.array([self.is_init]),
        }
        if self.needs_imu:
            feed["imu"] = self._checked("imu", imu, np.dtype(np.float32))
        elif imu is not None:
            raise ValueError("imu: by its contract, this actor takes none.")
        if self.noise_shape is not None:
            noise = self._random.random(self.noise_shape, np.float32) if noise is None else noise
            feed["noise"] = self._checked("noise", noise, np.dtype(np.float32))
        elif noise is not None:
            raise ValueError("noise: this actor was exported with latent=mode, which takes none.")
        action, *latent = self._run(feed)
        self.state = dict(zip(RECURRENT, (*latent, action), strict=True))
        self.is_init = False
        return action[0].copy()

    def setpoint(self, action: np.ndarray) -> np.ndarray:
        """Convert an action (A,) to collective thrust in m/s² and body rates x, y, z in rad/s (body frame FLU)."""
        channels = self.contract["action"]["channels"]
        offset, scale = (np.array([channel[name] for channel in channels]) for name in ("offset", "scale"))
        return offset + scale * np.clip(action, -1.0, 1.0)

    def _run(self, feed: dict[str, np.ndarray]) -> Sequence[np.ndarray]:
        """Compute action (1, A), next h (1, D) and next z (1, S) from the inputs by name."""
        raise NotImplementedError

    def _checked(self, name: str, value: Any, dtype: np.dtype) -> np.ndarray:
        """Check an input's type, shape and values; return it with a batch dimension of 1."""
        shape = self._shapes[name][1:]
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != shape:
            given = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise ValueError(f"{name}: got {given}, but this actor takes a numpy array {dtype} of shape {shape}.")
        if dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"{name}: contains numbers that are not finite.")
        return value[None]


class OnnxActor(RecurrentActor):
    """An exported actor in onnxruntime, on the CPU.

    If the contract names the two parts of a step, ``advance`` and ``act``, the actor runs them, so that `prepare` can
    run ``advance`` early; otherwise it runs the whole step.

    Args:
        path: The ``.onnx`` file, in one folder with its contract.json and its parts.
        seed: Seed of the noise that samples latents; only for ``latent=sample``.
        threads: Threads that one step may use; more than one rarely helps at batch size 1.
        whole: Run the whole step even if there are parts.

    Attributes:
        in_parts: Whether the actor runs the two parts, so that `prepare` has an effect.

    Raises:
        FileNotFoundError: The file, its contract or a part does not exist.
        ValueError: The contract is invalid, of another version, or does not describe this file.
        ImportError: onnxruntime is not installed.

    Example:
        >>> actor = OnnxActor("actor.onnx")  # doctest: +SKIP
        >>> action = actor.step(np.zeros((64, 64, 3), np.uint8))  # doctest: +SKIP
        >>> collective_thrust, *body_rates = actor.setpoint(action)  # doctest: +SKIP
        >>> actor.prepare()  # doctest: +SKIP
    """

    def __init__(self, path: str | Path, seed: int | None = None, threads: int = 1, whole: bool = False) -> None:
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"There is no file {path}: give the .onnx file that recipes/export.py wrote.")
        self._next_h: np.ndarray | None = None  # set by `prepare`
        self._first_h: np.ndarray | None = None  # h_next of an episode's first step, which is always the same
        super().__init__(read_contract(path.parent / CONTRACT), seed)
        self._check_files(path)
        parts = {part: self.contract["files"].get(part) for part in PARTS}
        self.in_parts = None not in parts.values() and not whole
        files = {part: path.parent / file["name"] for part, file in parts.items()} if self.in_parts else {"step": path}
        self._outputs = [entry["name"] for entry in self.contract["outputs"]]
        self._sessions = {part: _open_session(file, threads) for part, file in files.items()}
        self._check_sessions(files)
        if self.in_parts:
            self._first_h = self._advance()

    def reset(self) -> None:
        """Begin an episode: the next step ignores the state before it."""
        super().reset()
        self._next_h = None

    def prepare(self) -> None:
        """Advance the belief, which needs no observation; do nothing if the actor has no parts."""
        if self.in_parts and self._next_h is None and not self.is_init:
            self._next_h = self._advance()

    def _check_files(self, path: Path) -> None:
        """Check that all files exist and have the contract's hashes; ``weights`` is a file of external weights."""
        described = self.contract["files"]
        files = {"onnx": path}
        for kind in ("weights", *PARTS):
            if described.get(kind) is not None:
                files[kind] = path.parent / described[kind]["name"]
        for kind, file in files.items():
            if not file.is_file():
                raise FileNotFoundError(f"There is no {file}: it belongs beside {path.name}, from the same export.")
            if hash_file(file) != described[kind]["sha256"]:
                raise ValueError(
                    f"{path.parent / CONTRACT} does not describe {file}: the SHA-256 of the file differs from the one "
                    "written there. Copy both from the same export."
                )

    def _check_sessions(self, files: dict[str, Path]) -> None:
        """Check that the ONNX files have the inputs and outputs of the contract's step, or of its parts."""
        shapes = {entry["name"]: entry["shape"] for kind in ("inputs", "outputs") for entry in self.contract[kind]}
        before = [*RECURRENT, "is_init"]
        seen = [name for name in self._shapes if name not in before]
        names = {"step": [*shapes], "advance": [*before, *PARTS["advance"]], "act": [*seen, "h_next", *PARTS["act"]]}
        for part, session in self._sessions.items():
            there = {each.name: list(each.shape) for each in (*session.get_inputs(), *session.get_outputs())}
            promised = {name: shapes.get(name) for name in names[part]}
            if there != promised:
                raise ValueError(
                    f"{files[part]} has the inputs and outputs {there}, but its contract promises {promised}."
                )

    def _advance(self) -> np.ndarray:
        feed = {**self.state, "is_init": np.array([self.is_init])}
        belief: np.ndarray = self._sessions["advance"].run(PARTS["advance"], feed)[0]
        return belief

    def _run(self, feed: dict[str, np.ndarray]) -> Sequence[np.ndarray]:
        if not self.in_parts:
            outputs: Sequence[np.ndarray] = self._sessions["step"].run(self._outputs, feed)
            return outputs
        if self.is_init and self._first_h is not None:
            belief = self._first_h.copy()
        else:
            belief = self._advance() if self._next_h is None else self._next_h
        self._next_h = None
        seen = {name: value for name, value in feed.items() if name not in (*RECURRENT, "is_init")}
        action, state = self._sessions["act"].run(PARTS["act"], {**seen, "h_next": belief})
        return action, belief, state


def read_contract(path: str | Path) -> dict[str, Any]:
    """Read a contract.json, given its path, the ``.onnx`` file in the same folder, or the folder.

    Raises:
        FileNotFoundError: The contract does not exist.
        ValueError: The file is no contract of an exported actor, or of another version.
    """
    path = Path(path)
    if path.is_dir() or path.suffix == ".onnx":
        path = (path if path.is_dir() else path.parent) / CONTRACT
    elif path.suffix != ".json":
        raise ValueError(f"{path} is not an actor: give an .onnx file, or the folder of one.")
    if not path.is_file():
        raise FileNotFoundError(f"There is no {path}: it belongs beside the .onnx file, from the same export.")
    try:
        contract = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}.") from error
    found = (contract.get("format"), contract.get("format_version")) if isinstance(contract, dict) else (None, None)
    if found[0] != FORMAT or found[1] not in FORMAT_VERSIONS:
        known = " and ".join(map(str, FORMAT_VERSIONS))
        raise ValueError(
            f"{path}: format {found[0]!r}, version {found[1]!r}; this file reads {FORMAT!r}, versions {known}. "
            "Use the onnx_actor.py of the release that exported it, or export again."
        )
    if misfit := _layout_mismatch(contract, _LAYOUT, "") or _inconsistency(contract):
        raise ValueError(f"{path}: {misfit}. Copy it from the export again.")
    return contract


def _layout_mismatch(value: Any, layout: Any, name: str) -> str:
    """Return a message about the first mismatch between a value and its layout, or an empty string."""
    if isinstance(layout, dict):
        if not isinstance(value, dict):
            return f"{name} is {_short(value)}, not an object"
        needed = [key for key in layout if key[-1] != "?" or value.get(key[:-1]) is not None]
        wanted = {key.removesuffix("?"): layout[key] for key in needed}
        if absent := wanted.keys() - value.keys():
            return f"{name or 'it'} lacks {', '.join(sorted(absent))}"
        parts = [(value[key], inner, f"{name}.{key}".lstrip(".")) for key, inner in wanted.items()]
    elif isinstance(layout, list):
        if not isinstance(value, list) or not value:
            return f"{name} is {_short(value)}, not a list with entries"
        parts = [(entry, layout[0], f"{name}[{index}]") for index, entry in enumerate(value)]
    else:
        fits = isinstance(value, (int, float) if layout is float else layout) and not isinstance(value, bool)
        if not fits or (layout is float and not abs(value) < 1e9):
            kinds = {float: "a number", int: "a whole number", str: "a string"}
            return f"{name} is {_short(value)}, not {kinds[layout]}"
        return ""
    return next(filter(None, (_layout_mismatch(*part) for part in parts)), "")


def _inconsistency(contract: dict[str, Any]) -> str:
    """Return a message about the first inconsistency in a contract of correct layout, or an empty string."""
    names = [entry["name"] for entry in contract["inputs"]]
    if absent := [name for name in (*RECURRENT, "is_init") if name not in names]:
        return f"inputs lacks {', '.join(absent)}"
    if len(parts := contract["files"].keys() & PARTS.keys()) == 1:
        return f"files has only {next(iter(parts))} of {' and '.join(PARTS)}"
    if len(set(names)) < len(names):
        return "inputs has a name twice"
    for name, shape, kind in ((entry["name"], entry["shape"], entry["type"]) for entry in contract["inputs"]):
        if kind not in _TYPES:
            return f"the input {_short(name)} is of type {_short(kind)}, not {', '.join(_TYPES)}"
        if min(shape) < 1 or math.prod(shape) > _MOST:
            return f"the input {_short(name)} has the shape {_short(shape)}"
    actions = contract["inputs"][names.index("previous_action")]["shape"][-1]
    if (channels := len(contract["action"]["channels"])) != actions:
        return f"action.channels has {channels} entries, but the actor has {actions} actions"
    loop = contract.get("rate_loop") or {"kind": None}
    if loop["kind"] == "betaflight" and (
        lacking := [name for name in ("p", "d", "motor_time_constant_s") if loop.get(name) is None]
    ):
        return f"rate_loop lacks {', '.join(lacking)}"
    for name in ("p", "d"):
        if len(gains := loop.get(name) or (0.0, 0.0, 0.0)) != 3:
            return f"rate_loop.{name} has {len(gains)} numbers, not one for each of roll, pitch and yaw"
    rate = contract["control"]["rate_hz"]
    return "" if rate > 0 else f"control.rate_hz is {rate}, not above 0"


def _short(value: Any) -> str:
    """Return the `repr` of a value, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal, as sha256sum prints it."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Latency(NamedTuple):
    """Percentiles of step durations, ms."""

    p50: float
    p99: float
    max: float

    def __str__(self) -> str:
        return f"p50 {self.p50:.2f} ms, p99 {self.p99:.2f} ms, max {self.max:.2f} ms"


def measure_latency(
    step: Callable[[np.ndarray], object],
    observations: Sequence[np.ndarray] | np.ndarray,
    prepare: Callable[[], object] = lambda: None,
) -> Latency:
    """Time single steps, after ``WARM_UP_STEPS`` untimed ones.

    Args:
        step: Called with one observation.
        observations: One for each timed step.
        prepare: Called before each step; its time is not counted.
    """
    for index in range(WARM_UP_STEPS):
        prepare()
        step(observations[index % len(observations)])
    durations = []
    for observation in observations:
        prepare()
        start = time.perf_counter()
        step(observation)
        durations.append(1e3 * (time.perf_counter() - start))
    return Latency(*(float(value) for value in np.percentile(durations, (50, 99, 100))))


def _open_session(path: Path, threads: int) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("onnxruntime is not installed: pip install onnxruntime.") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def main() -> None:
    """Measure the latency of an exported actor on this computer, with noise as images."""
    parser = argparse.ArgumentParser(description="Measure the latency of one step of an exported actor.")
    parser.add_argument("path", help="the .onnx file")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.steps < 1:
        parser.error(f"--steps {arguments.steps}: must be at least 1.")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        actor = OnnxActor(arguments.path, threads=arguments.threads)
    except (OSError, ValueError, ImportError) as error:
        parser.error(str(error))
    entry = actor.contract["inputs"][0]
    seen = np.random.default_rng(0).integers(0, 256, (arguments.steps, *entry["shape"][1:])).astype(entry["type"])
    step = partial(actor.step, imu=np.zeros(6, np.float32)) if actor.needs_imu else actor.step
    logger.info("onnxruntime, %d steps, %d thread(s): %s", arguments.steps, arguments.threads,
                measure_latency(step, seen))  # fmt: skip
    if actor.in_parts:
        logger.info("of which from observation to action: %s", measure_latency(step, seen, actor.prepare))


if __name__ == "__main__":
    main()
