"""`Track`: gates, their shape, the start pose and the bounding box.

Shape legend: G race gates. SI units, world z up. A gate's own axes are forward (direction of flight), left and up;
gates stand upright, so one yaw angle turns the world's x axis into a gate's forward axis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from dreamer_racing.settings import is_number, quoted

if TYPE_CHECKING:
    import torch

Vector = tuple[float, float, float]

GROUND_HEIGHT = 0.05
"""Height (m) of a drone's centre below which it has hit the ground: half of its 0.1 m height [choice]."""

START_DISTANCE = 2.5
"""Distance (m) of the default start pose before the first gate [choice]."""

BOUNDS_CLEARANCE = 3.0
"""Distance (m) of the default bounding box from the race gates' frames [choice]."""

DEFAULT_CEILING = 6.0
"""Height (m) of the default bounding box [choice]."""


class TrackError(ValueError):
    """Error of a track that cannot be read or flown; the message says what is wrong, where, and what would be right."""


def refusal(source: str, field: str, value: object, allowed: str) -> TrackError:
    """Return the error of an invalid field."""
    return TrackError(f"{source}: {field} is {quoted(value)}, but must be {allowed}.")


def _normalise(part: Any, numbers: Sequence[str], vectors: Sequence[str]) -> None:
    """Convert a frozen object's fields to floats and tuples of floats; others are left for validation to refuse."""
    for name in numbers:
        object.__setattr__(part, name, _as_float(getattr(part, name)))
    for name in vectors:
        value = _as_tuple(getattr(part, name))
        object.__setattr__(part, name, tuple(map(_as_float, value)) if isinstance(value, tuple) else value)


def _as_float(value: Any) -> Any:
    value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy and torch
    try:
        return float(value) if is_number(value) else value
    except OverflowError:
        return value


def _as_tuple(value: Any) -> Any:
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


@dataclasses.dataclass(frozen=True)
class Gate:
    """One square gate, standing upright.

    Numbers of any type become floats, and sequences or arrays become tuples of floats.
    """

    position: Vector  # centre of the opening in the world, m
    yaw_degrees: float  # direction of flight through the gate, degrees from the world's x axis towards y
    # ``"race"`` gates are flown in order; ``"decoy"`` gates are only rendered (no reward, crash or order)
    kind: Literal["race", "decoy"] = "race"
    color: Vector | None = None  # RGB in [0, 1], or None for the scene's own colour

    def __post_init__(self) -> None:
        _normalise(self, ("yaw_degrees",), ("position", "color"))

    @property
    def forward(self) -> Vector:
        """Unit vector of the direction of flight in the world."""
        yaw = math.radians(self.yaw_degrees)
        return (math.cos(yaw), math.sin(yaw), 0.0)

    @property
    def left(self) -> Vector:
        """Unit vector to the left of the direction of flight in the world."""
        yaw = math.radians(self.yaw_degrees)
        return (-math.sin(yaw), math.cos(yaw), 0.0)


@dataclasses.dataclass(frozen=True)
class GateShape:
    """Dimensions shared by all gates of a track, m."""

    opening: float = 1.5  # side of the square opening. Reference: uzh-rpg/agile_flight.
    outer: float = 2.05  # side of the square frame's outside. Reference: uzh-rpg/agile_flight.
    depth: float = 0.1  # thickness of the frame along the direction of flight. Reference: uzh-rpg/agile_flight.
    margin: float = 0.1  # on both axes, a drone's centre must pass this much inside the opening's edges [choice]

    def __post_init__(self) -> None:
        _normalise(self, [field.name for field in dataclasses.fields(self)], ())

    @property
    def pass_half_width(self) -> float:
        """Half side of the margin-reduced opening, through which a drone's centre must pass, m."""
        return self.opening / 2 - self.margin


@dataclasses.dataclass(frozen=True)
class Track:
    """A race track. Read one with ``load_track`` or build one with ``make_track``."""

    name: str
    """Short name, for logs and plots."""
    gates: tuple[Gate, ...]
    """Race gates in the order of flight."""
    decoys: tuple[Gate, ...]
    """Gates that are only rendered."""
    shape: GateShape
    """Dimensions of every gate."""
    start_position: Vector
    """Position of the start pose, m."""
    start_yaw_degrees: float
    """Heading of the start pose, degrees from world x, positive to the left."""
    bounds_low: Vector
    """Lower corner of the box that a drone must not leave, m."""
    bounds_high: Vector
    """Upper corner of the same box, m."""
    laps: int = 3
    """Number of laps of an evaluation episode."""

    def __post_init__(self) -> None:
        _normalise(self, ("start_yaw_degrees",), ("start_position", "bounds_low", "bounds_high"))
        for name in ("gates", "decoys"):
            object.__setattr__(self, name, _as_tuple(getattr(self, name)))
        if hasattr(self.laps, "tolist"):
            object.__setattr__(self, "laps", self.laps.tolist())

    @property
    def num_gates(self) -> int:
        """Number of race gates, which is the number of passes in a lap."""
        return len(self.gates)

    @property
    def gate_distances(self) -> tuple[float, ...]:
        """Straight distances between the centres of successive gates, ending with last to first, m."""
        following = (*self.gates[1:], self.gates[0])
        return tuple(
            math.dist(gate.position, next_.position) for gate, next_ in zip(self.gates, following, strict=True)
        )

    def gate_positions(self, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> torch.Tensor:
        """Return the centres of the race gates, (G, 3), m."""
        return _tensor([gate.position for gate in self.gates], device, dtype)

    def gate_yaws(self, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> torch.Tensor:
        """Return the directions of flight through the race gates, (G,), rad."""
        return _tensor([math.radians(gate.yaw_degrees) for gate in self.gates], device, dtype)

    def gate_normals(self, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> torch.Tensor:
        """Return the unit directions of flight through the race gates, (G, 3)."""
        return _tensor([gate.forward for gate in self.gates], device, dtype)


def _tensor(values: Any, device: torch.device | str, dtype: torch.dtype | None) -> torch.Tensor:
    """Return numbers as a tensor, float32 by default; torch is imported here, as reading tracks does not need it."""
    import torch

    return torch.tensor(values, device=device, dtype=dtype or torch.float32)


def make_track(
    name: str,
    gates: Sequence[Gate],
    *,
    decoys: Sequence[Gate] = (),
    shape: GateShape | None = None,
    start_position: Vector | None = None,
    start_yaw_degrees: float | None = None,
    bounds_low: Vector | None = None,
    bounds_high: Vector | None = None,
    laps: int = 3,
    source: str | None = None,
) -> Track:
    """Build a `Track` with defaults for what is not given. ``load_track`` checks the result.

    Args:
        name: short name, for logs and plots.
        gates: race gates in the order of flight, at least one.
        decoys: gates that are only rendered.
        shape: dimensions of every gate; None for the defaults of ``GateShape``.
        start_position: m; None for 2.5 m before the first gate, at its height.
        start_yaw_degrees: None to face the centre of the first gate.
        bounds_low: m; None for 3 m outside the race gates' frames, from the floor.
        bounds_high: m; None for 3 m outside the race gates' frames, 6 m high.
        laps: number of laps of an evaluation episode.
        source: origin of the numbers, for messages; the track's name if None.

    Raises:
        TrackError: a gate, a dimension or the start from which defaults are computed is not finite.

    Example:
        >>> make_track("line", [Gate((0, 0, 1.35), 0), Gate((5, 0, 1.35), 0)]).start_position
        (-2.5, 0.0, 1.35)
    """
    source, shape = source or f"Track({name!r})", shape or GateShape()
    require_gates(source, "gates", gates)
    require_shape(source, shape)
    if start_position is not None:
        require_vector(source, "start.position", start_position := _as_tuple(start_position))
    else:
        (x, y, z), (along_x, along_y, _) = gates[0].position, gates[0].forward
        start_position = (x - START_DISTANCE * along_x, y - START_DISTANCE * along_y, z)
    if start_yaw_degrees is None:
        (x, y, _), (to_x, to_y, _) = start_position, gates[0].position
        start_yaw_degrees = math.degrees(math.atan2(to_y - y, to_x - x))
    default_low, default_high = _default_bounds(gates, shape)
    return Track(
        name=name,
        gates=tuple(gates),
        decoys=tuple(decoys),
        shape=shape,
        start_position=start_position,
        start_yaw_degrees=start_yaw_degrees,
        bounds_low=default_low if bounds_low is None else bounds_low,
        bounds_high=default_high if bounds_high is None else bounds_high,
        laps=laps,
    )


def require_gates(source: str, field: str, gates: Sequence[Gate]) -> None:
    """Refuse items that are not gates, and gates without a finite position or yaw."""
    if not isinstance(gates, Sequence):
        raise refusal(source, field, gates, "a sequence of gates")
    for index, gate in enumerate(gates):
        if not isinstance(gate, Gate):
            raise refusal(source, f"{field}[{index}]", gate, "a Gate")
        require_vector(source, f"{field}[{index}].position", gate.position)
        require_number(source, f"{field}[{index}].yaw_degrees", gate.yaw_degrees)


def require_shape(source: str, shape: GateShape) -> None:
    """Refuse dimensions that are not finite numbers."""
    if not isinstance(shape, GateShape):
        raise refusal(source, "shape", shape, "a GateShape")
    for field in dataclasses.fields(shape):
        require_number(source, f"shape.{field.name}", getattr(shape, field.name))


def require_vector(source: str, field: str, value: object) -> None:
    """Refuse a value that is not three finite numbers."""
    if not (isinstance(value, tuple) and len(value) == 3 and all(map(_is_finite, value))):
        raise refusal(source, field, value, "three finite numbers (x, y, z) in m")


def require_number(source: str, field: str, value: object) -> None:
    """Refuse a value that is not a finite number."""
    if not _is_finite(value):
        raise refusal(source, field, value, "a finite number")


def _is_finite(value: object) -> bool:
    value = _as_float(value)
    return isinstance(value, float) and math.isfinite(value)


def _default_bounds(gates: Sequence[Gate], shape: GateShape) -> tuple[Vector, Vector]:
    """Return the corners of the box that clears every race gate's frame by 3 m on each side, 0–6 m high.

    Decoys are ignored, so that the flyable space of a track is the same with and without them.
    """
    low, high = [math.inf, math.inf], [-math.inf, -math.inf]
    for gate in gates:
        for axis in range(2):
            reach = (shape.outer * abs(gate.left[axis]) + shape.depth * abs(gate.forward[axis])) / 2
            low[axis] = min(low[axis], gate.position[axis] - reach - BOUNDS_CLEARANCE)
            high[axis] = max(high[axis], gate.position[axis] + reach + BOUNDS_CLEARANCE)
    return (low[0], low[1], 0.0), (high[0], high[1], DEFAULT_CEILING)
