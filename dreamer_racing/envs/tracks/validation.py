"""Validation of tracks: checks of numbers and geometry, for files and for tracks built in Python.

Overlap. A gate's frame must not reach into another gate's opening: two gates are refused if the box of one opening
(opening × opening × depth) intersects the box of the other frame (outer × outer × depth). Frames may touch or overlap
other frames, because both are obstacles and every opening stays free: the two stacked gates of the published Split-S
track share 7 cm of frame.

Reach. The margin-reduced opening must lie inside the bounding box and above the ground, and so must the metre before
it, where training episodes may begin. A frame may stand on the ground or touch a wall.
"""

from __future__ import annotations

import math
from itertools import pairwise, permutations

from dreamer_racing.envs.tracks.track import (
    GROUND_HEIGHT,
    Gate,
    GateShape,
    Track,
    TrackError,
    Vector,
    refusal,
    require_gates,
    require_number,
    require_shape,
    require_vector,
)

ROUNDING = 1e-9
"""Tolerance (m) for rounding errors of points on a limit."""

START_CLEARANCE = 0.3
"""Minimum distance (m) of every start from the bounding box and the ground [choice]."""

GATE_CLEARANCE = 1.0
"""Minimum distance (m) of a start from a gate's plane: training noise moves a start by at most 0.71 m [choice]."""

MAX_COORDINATE = 1000.0
"""Largest coordinate (m), at which float32 still resolves 0.1 mm [choice]."""

FARTHEST_LEG = 540.0
"""Largest distance (m) from one gate to the next: a whole evaluation, 30 s, at 18 m/s [choice]."""

MIN_DIMENSION = 0.01
"""Minimum opening, depth and frame width of a gate (m) [choice]."""

MAX_GATES, MAX_LAPS = 200, 1000
"""Maximum number of gates and decoys together, of which all pairs are checked, and of laps [choice]."""


def validate_track(track: Track, source: str) -> None:
    """Check that a track can be flown; messages begin with its ``source``, usually a file.

    Raises:
        TrackError: the message has source, field, value and what is allowed.
    """
    _check_numbers(track, source)
    _check_kinds(track, source)
    _check_shape(track.shape, source)
    _check_bounds(track, source)
    for name, gate in _named_gates(track):
        if gate.kind == "race":
            _check_reach(track, name, gate, source)
        elif not _inside(gate.position, *flyable_box(track, clearance=0.0)):
            raise refusal(source, f"{name}.position", gate.position, f"inside the bounding box {_box(track)}")
    _check_overlaps(track, source)
    _check_start(track, source)
    _check_legs(track, source)


def flyable_box(track: Track, clearance: float) -> tuple[Vector, Vector]:
    """Return the corners of the bounding box above the ground, shrunk by ``clearance`` m on every side."""
    low, high = track.bounds_low, track.bounds_high
    floor = max(low[2], GROUND_HEIGHT)
    return (
        (low[0] + clearance, low[1] + clearance, floor + clearance),
        (high[0] - clearance, high[1] - clearance, high[2] - clearance),
    )


def _named_gates(track: Track) -> list[tuple[str, Gate]]:
    """Return every gate with its field name in a file."""
    race = [(f"gates[{index}]", gate) for index, gate in enumerate(track.gates)]
    return race + [(f"decoys[{index}]", gate) for index, gate in enumerate(track.decoys)]


def _check_numbers(track: Track, source: str) -> None:
    """Refuse invalid numbers in positions, directions, dimensions, colours and laps."""
    if not (isinstance(track.name, str) and track.name.strip()):
        raise refusal(source, "name", track.name, "a text that is not empty")
    for name in ("gates", "decoys"):
        require_gates(source, name, getattr(track, name))
    require_shape(source, track.shape)
    require_number(source, "start.yaw_degrees", track.start_yaw_degrees)
    vectors = {
        "start.position": track.start_position,
        "bounds.low": track.bounds_low,
        "bounds.high": track.bounds_high,
        **{f"{name}.position": gate.position for name, gate in _named_gates(track)},
    }
    for field, vector in vectors.items():
        require_vector(source, field, vector)
        if max(map(abs, vector)) > MAX_COORDINATE:
            raise refusal(source, field, vector, f"within {MAX_COORDINATE:.0f} m of the origin on every axis")
    for name, gate in _named_gates(track):
        if gate.color is not None and not _is_color(gate.color):
            raise refusal(source, f"{name}.color", gate.color, "three numbers [red, green, blue] from 0 to 1, or None")
    whole = isinstance(track.laps, int) and not isinstance(track.laps, bool)
    if not (whole and 1 <= track.laps <= MAX_LAPS):
        raise refusal(source, "laps", track.laps, f"a whole number of at least 1 and at most {MAX_LAPS:,}")


def _is_color(value: object) -> bool:
    """Return whether a value is an RGB colour."""
    return isinstance(value, tuple) and len(value) == 3 and all(isinstance(x, float) and 0 <= x <= 1 for x in value)


def _check_kinds(track: Track, source: str) -> None:
    """Refuse too few or too many gates, and gates listed under the wrong kind."""
    if len(track.gates) < 2:
        raise refusal(source, "gates", track.gates, "at least 2 race gates, so that there is a lap")
    if (count := len(track.gates) + len(track.decoys)) > MAX_GATES:
        raise TrackError(f"{source}: gates and decoys are {count:,} together, but must be {MAX_GATES} at most.")
    for name, gate in _named_gates(track):
        kind = "race" if name.startswith("gates") else "decoy"
        if gate.kind != kind:
            raise refusal(source, f"{name}.kind", gate.kind, f"{kind!r}: race gates belong in gates, decoys in decoys")


def _check_shape(shape: GateShape, source: str) -> None:
    """Refuse gates whose opening, frame, depth or margin is out of range."""
    if shape.opening < MIN_DIMENSION:
        raise refusal(source, "shape.opening", shape.opening, f"greater than 0 m, {MIN_DIMENSION} m at least")
    if shape.outer <= shape.opening + 2 * MIN_DIMENSION - ROUNDING:
        allowed = f"greater than shape.opening, which is {shape.opening} m, by {2 * MIN_DIMENSION} m at least"
        raise refusal(source, "shape.outer", shape.outer, allowed)
    if shape.outer > MAX_COORDINATE:
        raise refusal(source, "shape.outer", shape.outer, f"at most {MAX_COORDINATE:.0f} m")
    if shape.depth < MIN_DIMENSION:
        raise refusal(source, "shape.depth", shape.depth, f"greater than 0 m, {MIN_DIMENSION} m at least")
    if not 0 <= shape.margin < shape.opening / 2:
        allowed = f"from 0 to less than half of shape.opening, which is {shape.opening / 2} m"
        raise refusal(source, "shape.margin", shape.margin, allowed)


def _check_bounds(track: Track, source: str) -> None:
    """Refuse an empty bounding box."""
    for axis, letter in enumerate("xyz"):
        if track.bounds_low[axis] >= track.bounds_high[axis]:
            allowed = f"greater than bounds.low, which is {track.bounds_low[axis]} m on the {letter} axis"
            raise refusal(source, f"bounds.high[{axis}]", track.bounds_high[axis], allowed)


def _check_reach(track: Track, name: str, gate: Gate, source: str) -> None:
    """Refuse a race gate whose opening, or the metre before it, is outside the flyable space."""
    low, high = flyable_box(track, clearance=0.0)
    half = track.shape.pass_half_width
    for left in (-half, half):
        for up in (-half, half):
            corner = _offset(gate, 0.0, left, up)
            if not _inside(corner, low, high):
                allowed = (
                    f"such that the whole opening (less the margin: {half} m to each side) is inside the bounding box "
                    f"{_box(track)} and above {GROUND_HEIGHT} m: its corner {_rounded(corner)} is not"
                )
                raise refusal(source, f"{name}.position", gate.position, allowed)
    approach = _offset(gate, -GATE_CLEARANCE, 0.0, 0.0)
    if not _inside(approach, *flyable_box(track, START_CLEARANCE)):
        allowed = (
            f"such that the point {GATE_CLEARANCE} m before it, {_rounded(approach)}, is at least {START_CLEARANCE} m "
            f"inside the bounding box {_box(track)}, so that a drone can get to it"
        )
        raise refusal(source, f"{name}.position", gate.position, allowed)


def _check_overlaps(track: Track, source: str) -> None:
    """Refuse a gate whose opening is blocked by the frame of another gate."""
    shape = track.shape
    for (name, gate), (other_name, other) in permutations(_named_gates(track), 2):
        if boxes_intersect(gate, shape.opening, other, shape.outer, shape.depth):
            allowed = (
                f"farther from {other_name} at {other.position}: the frame of {other_name} ({shape.outer} m square, "
                f"{shape.depth} m deep) reaches into the opening of {name} ({shape.opening} m square)"
            )
            raise refusal(source, f"{name}.position", gate.position, allowed)


def _check_start(track: Track, source: str) -> None:
    """Refuse a start outside the box, behind the first gate's plane, or too close to a gate."""
    start = track.start_position
    if not _inside(start, *flyable_box(track, START_CLEARANCE)):
        allowed = f"at least {START_CLEARANCE} m inside the bounding box {_box(track)} and above {GROUND_HEIGHT} m"
        raise refusal(source, "start.position", start, allowed)
    forward, _, _ = _coordinates(track.gates[0], start)
    if forward > -GATE_CLEARANCE + ROUNDING:
        state = f"{-forward:.2f} m before" if forward <= 0 else f"{forward:.2f} m behind"
        allowed = f"at least {GATE_CLEARANCE} m before the plane of gates[0]: it is {state}"
        raise refusal(source, "start.position", start, allowed)
    reach = track.shape.outer / 2 + GATE_CLEARANCE
    for index, gate in enumerate(track.gates):
        forward, left, up = _coordinates(gate, start)
        if abs(forward) < GATE_CLEARANCE - ROUNDING and max(abs(left), abs(up)) < reach:
            allowed = f"at least {GATE_CLEARANCE} m from the plane or the frame of gates[{index}] at {gate.position}"
            raise refusal(source, "start.position", start, allowed)


def _check_legs(track: Track, source: str) -> None:
    """Refuse a race gate that is too far away to be reached in an evaluation."""
    places = [("start.position", track.start_position)]
    places += [(f"gates[{index}].position", gate.position) for index, gate in enumerate(track.gates)]
    if track.laps > 1:
        places.append(places[1])
    for (name, position), (next_name, next_position) in pairwise(places):
        if (leg := math.dist(position, next_position)) > FARTHEST_LEG:
            allowed = f"at most {FARTHEST_LEG:.0f} m from {name}, the range of one flight: it is {leg:.0f} m"
            raise refusal(source, next_name, next_position, allowed)


def boxes_intersect(gate: Gate, side: float, other: Gate, other_side: float, depth: float) -> bool:
    """Return whether two upright boxes (depth × side × side) share more than their surface.

    Upright boxes intersect if both their heights and their ground plans do. Two rectangles are disjoint exactly if
    their projections are disjoint on the axis of one of their sides (separating axis theorem).
    """
    gap = [b - a for a, b in zip(gate.position, other.position, strict=True)]
    if abs(gap[2]) >= (side + other_side) / 2:
        return False
    for axis in (gate.forward, gate.left, other.forward, other.left):
        reach = _half_projection(gate, side, depth, axis) + _half_projection(other, other_side, depth, axis)
        if abs(_dot(gap, axis)) >= reach:
            return False
    return True


def _half_projection(gate: Gate, side: float, depth: float, axis: Vector) -> float:
    """Return half the length of a gate box's projection on a horizontal axis, m."""
    return (depth * abs(_dot(gate.forward, axis)) + side * abs(_dot(gate.left, axis))) / 2


def _coordinates(gate: Gate, point: Vector) -> Vector:
    """Return a world point in a gate's own axes (forward, left, up), m."""
    difference = [a - b for a, b in zip(point, gate.position, strict=True)]
    return (_dot(difference, gate.forward), _dot(difference, gate.left), difference[2])


def _offset(gate: Gate, forward: float, left: float, up: float) -> Vector:
    """Return the world position of a point given in a gate's axes, m."""
    x, y, z = gate.position
    return (
        x + forward * gate.forward[0] + left * gate.left[0],
        y + forward * gate.forward[1] + left * gate.left[1],
        z + up,
    )


def _dot(a: Vector | list[float], b: Vector) -> float:
    """Return the dot product."""
    return sum(x * y for x, y in zip(a, b, strict=True))


def _inside(point: Vector, low: Vector, high: Vector) -> bool:
    """Return whether a point lies in a box, including its surface."""
    return all(a - ROUNDING <= x <= b + ROUNDING for a, x, b in zip(low, point, high, strict=True))


def _box(track: Track) -> str:
    """Format the bounding box for a message."""
    return f"from {_rounded(track.bounds_low)} to {_rounded(track.bounds_high)}"


def _rounded(vector: Vector) -> Vector:
    """Round to millimetres, for a message."""
    x, y, z = (round(number, 3) for number in vector)
    return (x, y, z)
