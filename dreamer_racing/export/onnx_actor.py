"""Flies an exported actor on the vehicle's computer: numpy, onnxruntime and the standard library, nothing else.

The file stands alone: beside an installed `dreamer_racing` it is `dreamer_racing.export.onnx_actor`, and copied to
the flight computer it is a module `onnx_actor` of its own. Run as a program it measures one step there:

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
"""A contract is of version 2 where the image is to be held between frames (``camera.rate_hz``), or there is an IMU."""
RECURRENT = ("h", "z", "previous_action")
PARTS = {"advance": ("h_next",), "act": ("action", "z_next")}
"""Outputs of the two parts of a step. The first takes all that is recurrent and ``is_init``, the second the
observation, ``h_next`` and what there is of IMU and noise."""
WARM_UP_STEPS = 20

_TENSOR = {"name": str, "shape": [int], "type": str}
_LAYOUT = {
    "inputs": [_TENSOR],
    "outputs": [_TENSOR],
    "files": {
        "onnx": {"sha256": str},
        **{f"{kind}?": {"name": str, "sha256": str} for kind in ("weights", "advance", "act")},
    },
    "model": {},
    "weights_sha256": str,
    "action": {"channels": [{"name": str, "unit": str, "offset": float, "scale": float}]},
    "control": {"rate_hz": float},
    "source": {},
    "camera?": {
        "width_px": int,
        "height_px": int,
        "vertical_field_of_view_deg": float,
        "tilt_up_deg": float,
        "position_body_m": [float],
        "rate_hz?": float,
    },
}
"""What is read of a contract: keys and types of values; of a list, what each entry is. ``?``: may be absent or null."""
_TYPES = ("uint8", "float32", "bool")
_MOST = 100_000_000  # values of one input


class RecurrentActor:
    """Carries h, z and the previous action from step to step; what computes a step is the subclass's.

    Args:
        contract: As `read_contract` returns it.
        seed: Of the noise that samples latents, where the actor has any.

    Attributes:
        contract: As given.
        state: What goes into the next step: ``h`` (1, D), ``z`` (1, S) and ``previous_action`` (1, A), float32. To be
            set by hand before `prepare`, if at all.
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
    def feels(self) -> bool:
        """Whether a step takes what an IMU tells."""
        return "imu" in self._shapes

    @property
    def noise_shape(self) -> tuple[int, ...] | None:
        """Shape (L, K) of the noise of one step; None if the actor takes none."""
        return self._shapes["noise"][1:] if "noise" in self._shapes else None

    def reset(self) -> None:
        """Begin an episode: the next step forgets everything before it."""
        self.state = {name: np.zeros(self._shapes[name], np.float32) for name in RECURRENT}
        self.is_init = True

    def prepare(self) -> None:
        """Do ahead of time what of the next step needs no observation, if this actor can; actions stay the same.

        Worth it after a step, when its action is on its way.
        """

    def step(
        self, observation: np.ndarray, noise: np.ndarray | None = None, imu: np.ndarray | None = None
    ) -> np.ndarray:
        """Take in what is seen now and return what to do; call it once per control period.

        Args:
            observation: uint8 RGB image (height, width, 3), top row first, or the float32 vector (V,) of an actor that
                sees numbers; the contract's first input says which.
            noise: Only for ``latent=sample``: uniform numbers in [0, 1), float32 (L, K); drawn here if None.
            imu: Only for actors with one (`feels`): body rates, rad/s, and specific force, m/s², FLU, float32 (6,).

        Returns:
            float32 (A,) in [−1, 1]; `setpoint` gives it units.

        Raises:
            ValueError: Wrong shape or type, numbers that are not finite, or noise or IMU for an actor that takes none.
        """
        feed = {
            **self.state,
            self._observed: self._checked(self._observed, observation, self._dtype),
            "is_init": np.array([self.is_init]),
        }
        if self.feels:
            feed["imu"] = self._checked("imu", imu, np.dtype(np.float32))
        elif imu is not None:
            raise ValueError("imu: this actor has none, by its contract.")
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
        """Give an action (A,) its units: collective thrust in m/s², body rates x, y, z in rad/s (body frame FLU)."""
        channels = self.contract["action"]["channels"]
        offset, scale = (np.array([channel[name] for channel in channels]) for name in ("offset", "scale"))
        return offset + scale * np.clip(action, -1.0, 1.0)

    def _run(self, feed: dict[str, np.ndarray]) -> Sequence[np.ndarray]:
        """Compute action (1, A), next h (1, D) and next z (1, S) from the inputs by name."""
        raise NotImplementedError

    def _checked(self, name: str, value: Any, dtype: np.dtype) -> np.ndarray:
        """Return an input with a leading 1, or refuse it."""
        shape = self._shapes[name][1:]
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != shape:
            given = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
            raise ValueError(f"{name}: got {given}, but this actor takes a numpy array {dtype} of shape {shape}.")
        if dtype.kind == "f" and not np.isfinite(value).all():
            raise ValueError(f"{name}: contains numbers that are not finite.")
        return value[None]


class OnnxActor(RecurrentActor):
    """An exported actor in onnxruntime, on the CPU.

    Where its contract names the two parts of a step, ``advance`` and ``act``, these are run, so that `prepare` can do
    the first one ahead of time; else the whole.

    Args:
        path: The ``.onnx`` file; its contract.json and its parts lie beside it.
        seed: Of the noise that samples latents; only ``latent=sample`` has any.
        threads: Threads that one step may use; more than one rarely helps at batch size 1.
        whole: Run the whole step even where there are parts.

    Attributes:
        in_parts: Whether `prepare` takes something off the next step.

    Raises:
        FileNotFoundError: There is no such file, or no contract beside it.
        ValueError: The contract is broken, of another version, or does not describe this file.
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
        self._next_h: np.ndarray | None = None  # if it has been prepared
        self._first_h: np.ndarray | None = None  # of an episode, which is always the same
        super().__init__(read_contract(path.parent / CONTRACT), seed)
        self._check_files(path)
        described = self.contract["files"]
        files = {part: described.get(part) for part in PARTS}
        self.in_parts = None not in files.values() and not whole
        if self.in_parts:
            self._sessions = {part: _open_session(path.parent / file["name"], threads) for part, file in files.items()}
            self._check_parts(path)
            self._first_h = self._advance()
            self.reset()
        else:
            self._sessions = {"step": _open_session(path, threads)}
            self._check_session(path)
        self._outputs = [entry["name"] for entry in self.contract["outputs"]]

    def reset(self) -> None:
        """Begin an episode: the next step forgets everything before it."""
        super().reset()
        self._next_h = None

    def prepare(self) -> None:
        """Advance the belief, which needs no observation; where the actor is one piece, do nothing."""
        if self.in_parts and self._next_h is None and not self.is_init:
            self._next_h = self._advance()

    def _check_files(self, path: Path) -> None:
        """Refuse a contract that belongs to other files; there are `weights` where the ONNX files hold none."""
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

    def _check_session(self, path: Path) -> None:
        """Refuse a contract that promises what the file does not have."""
        session = self._sessions["step"]
        for kind, arguments in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            there = [(argument.name, list(argument.shape)) for argument in arguments]
            promised = [(entry["name"], entry["shape"]) for entry in self.contract[kind]]
            if there != promised:
                raise ValueError(f"{path} has the {kind} {there}, but its contract promises {promised}.")

    def _check_parts(self, path: Path) -> None:
        """Refuse parts that do not make the step that the contract promises."""
        shapes = {entry["name"]: entry["shape"] for kind in ("inputs", "outputs") for entry in self.contract[kind]}
        before = [*RECURRENT, "is_init"]
        inputs = {"advance": before, "act": ["h_next", *(name for name in self._shapes if name not in before)]}
        for part, session in self._sessions.items():
            there = {each.name: list(each.shape) for each in (*session.get_inputs(), *session.get_outputs())}
            promised = {name: shapes.get(name) for name in (*inputs[part], *PARTS[part])}
            if there != promised:
                file = path.parent / self.contract["files"][part]["name"]
                raise ValueError(f"{file} has the inputs and outputs {there}, but its contract promises {promised}.")

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
    """Read a contract.json, given it or its actor: the ``.onnx`` file beside it, or the folder of both.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is no contract of an exported actor, or of another version.
    """
    path = Path(path)
    if path.is_dir() or path.suffix == ".onnx":
        path = (path if path.is_dir() else path.parent) / CONTRACT
    elif path.suffix != ".json":
        raise ValueError(f"{path} is no actor: give an .onnx file, or the folder of one.")
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
    if misfit := _unlike(contract, _LAYOUT, "") or _unfit(contract):
        raise ValueError(f"{path}: {misfit}. Copy it from the export again.")
    return contract


def _unlike(value: Any, layout: Any, name: str) -> str:
    """Say where a value is not laid out as it should be; nothing if it is."""
    if isinstance(layout, dict):
        if not isinstance(value, dict):
            return f"{name} is {_short(value)}, not an object"
        wanted = {
            key.removesuffix("?"): inner
            for key, inner in layout.items()
            if key[-1] != "?" or value.get(key[:-1]) is not None
        }
        if absent := wanted.keys() - value.keys():
            return f"{name or 'it'} lacks {', '.join(sorted(absent))}"
        parts = [(value[key], inner, f"{name}.{key}".lstrip(".")) for key, inner in wanted.items()]
    elif isinstance(layout, list):
        if not isinstance(value, list) or not value:
            return f"{name} is {_short(value)}, not a list of something"
        parts = [(entry, layout[0], f"{name}[{index}]") for index, entry in enumerate(value)]
    else:
        fits = isinstance(value, (int, float) if layout is float else layout) and not isinstance(value, bool)
        if not fits or (layout is float and not abs(value) < 1e9):
            kinds = {float: "a number", int: "a whole number", str: "a text"}
            return f"{name} is {_short(value)}, not {kinds[layout]}"
        return ""
    return next(filter(None, (_unlike(*part) for part in parts)), "")


def _unfit(contract: dict[str, Any]) -> str:
    """Say what of a well laid out contract no actor has; nothing if all can be."""
    names = [entry["name"] for entry in contract["inputs"]]
    if absent := [name for name in (*RECURRENT, "is_init") if name not in names]:
        return f"inputs lacks {', '.join(absent)}"
    if len(parts := contract["files"].keys() & PARTS.keys()) == 1:
        return f"files has {next(iter(parts))} alone of {' and '.join(PARTS)}"
    if len(set(names)) < len(names):
        return "inputs has a name twice"
    for name, shape, kind in ((entry["name"], entry["shape"], entry["type"]) for entry in contract["inputs"]):
        if kind not in _TYPES:
            return f"the input {_short(name)} is of type {_short(kind)}, not {', '.join(_TYPES)}"
        if min(shape) < 1 or math.prod(shape) > _MOST:
            return f"the input {_short(name)} has the shape {_short(shape)}"
    actions = contract["inputs"][names.index("previous_action")]["shape"][-1]
    if (channels := len(contract["action"]["channels"])) != actions:
        return f"action.channels has {channels} entries, of an actor with {actions} actions"
    rate = contract["control"]["rate_hz"]
    return "" if rate > 0 else f"control.rate_hz is {rate}, not above 0"


def _short(value: Any) -> str:
    """A value as Python writes it, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def hash_file(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal, as sha256sum prints it."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Latency(NamedTuple):
    """Durations of single steps, ms."""

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
    """Time single steps, after some that are not counted.

    Args:
        step: Called with one observation.
        observations: One for each timed step.
        prepare: Called before each of them; what it takes is not counted.
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
    """Measure the latency of an exported actor on this computer, with noise for images."""
    parser = argparse.ArgumentParser(description="Measure the latency of one step of an exported actor.")
    parser.add_argument("path", help="the .onnx file")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        actor = OnnxActor(arguments.path, threads=arguments.threads)
    except (OSError, ValueError, ImportError) as error:
        parser.error(str(error))
    entry = actor.contract["inputs"][0]
    seen = np.random.default_rng(0).integers(0, 256, (arguments.steps, *entry["shape"][1:])).astype(entry["type"])
    step = partial(actor.step, imu=np.zeros(6, np.float32)) if actor.feels else actor.step
    logger.info("onnxruntime, %d steps, %d thread(s): %s", arguments.steps, arguments.threads,
                measure_latency(step, seen))  # fmt: skip
    if actor.in_parts:
        logger.info("of it from seeing to acting: %s", measure_latency(step, seen, actor.prepare))


if __name__ == "__main__":
    main()
