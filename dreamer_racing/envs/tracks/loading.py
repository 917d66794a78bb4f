"""Reading and writing of tracks as YAML; errors name the file, the field, its value and what is allowed."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Collection, Hashable
from pathlib import Path
from typing import Any, Literal

import yaml

from dreamer_racing.envs.tracks.track import Gate, GateShape, Track, TrackError, Vector, make_track, refusal
from dreamer_racing.envs.tracks.validation import validate_track
from dreamer_racing.settings import quoted, shortened, suggestion

BUILTIN_TRACKS: tuple[str, ...] = ("circle", "kidney", "figure8", "split_s", "figure8_decoys")
"""Track names that ``load_track`` accepts."""

MAX_BYTES = 100_000
"""Maximum size of a track file; the maximum number of gates takes a tenth of it [choice]."""

_FOLDER = Path(__file__).parent


def load_track(name_or_path: str | Path | Track) -> Track:
    """Return a checked track.

    Args:
        name_or_path: a name from ``BUILTIN_TRACKS``, the path of a ``.yaml`` file, or a ``Track``, which is checked and
            returned.

    Raises:
        TrackError: the track is unknown, cannot be read, or cannot be flown.

    Example:
        >>> load_track("kidney").num_gates
        6
    """
    if isinstance(name_or_path, Track):
        validate_track(name_or_path, source=f"Track({name_or_path.name!r})")
        return name_or_path
    if isinstance(name_or_path, str) and name_or_path in BUILTIN_TRACKS:
        return _load_builtin(name_or_path)
    return _load_file(_find(name_or_path))


def _load_file(path: Path) -> Track:
    return read_track(_parse(path), str(path), name=path.stem)


@functools.cache
def _load_builtin(name: str) -> Track:
    return _load_file(_find(name))


def read_track(content: Any, source: str, name: str = "track") -> Track:
    """Return the checked track described by a file's content or a result of `describe_track`.

    Args:
        content: Python objects as parsed from YAML or JSON.
        source: their origin, for messages.
        name: name of the track if the content has none.

    Raises:
        TrackError: a field is wrong, or the track cannot be flown.
    """
    track = _TrackReader(source, name).read(content)
    validate_track(track, source=source)
    return track


def describe_track(track: Track) -> dict[str, Any]:
    """Return the complete content of this track's file, without defaults, from which `read_track` restores it.

    Example:
        >>> track = load_track("kidney")
        >>> read_track(describe_track(track), "a copy") == track
        True
    """
    return {
        "name": track.name,
        "laps": track.laps,
        "shape": dataclasses.asdict(track.shape),
        "start": {"position": list(track.start_position), "yaw_degrees": track.start_yaw_degrees},
        "bounds": {"low": list(track.bounds_low), "high": list(track.bounds_high)},
        "gates": [_describe_gate(gate) for gate in track.gates],
        "decoys": [_describe_gate(gate) for gate in track.decoys],
    }


def hash_track(track: Track) -> str:
    """Return the SHA-256 hash of a track's geometry and gate colours, without its name and laps.

    It is computed from `describe_track` as JSON with sorted keys, so it does not depend on the track's file or name.

    Example:
        >>> hash_track(load_track("kidney")) == hash_track(dataclasses.replace(load_track("kidney"), name="mine"))
        True
    """
    geometry = {key: value for key, value in describe_track(track).items() if key not in ("name", "laps")}
    return hashlib.sha256(json.dumps(geometry, sort_keys=True).encode()).hexdigest()


def _describe_gate(gate: Gate) -> dict[str, Any]:
    color = {} if gate.color is None else {"color": list(gate.color)}
    return {"position": list(gate.position), "yaw_degrees": gate.yaw_degrees, **color}


def _find(name_or_path: str | Path) -> Path:
    """Return the file path of a built-in name or a path."""
    if isinstance(name_or_path, str):
        if name_or_path in BUILTIN_TRACKS:
            return _FOLDER / f"{name_or_path}.yaml"
        if not name_or_path.endswith((".yaml", ".yml")):
            raise TrackError(
                f"unknown track {quoted(name_or_path)}{suggestion(name_or_path, BUILTIN_TRACKS)}: the known tracks "
                f"are {', '.join(BUILTIN_TRACKS)}, and the path of a .yaml file works too."
            )
    if not isinstance(name_or_path, str | Path):
        raise TrackError(f"a track is a name, the path of a .yaml file or a Track, not {quoted(name_or_path)}.")
    path = Path(name_or_path).expanduser()
    try:
        state = "" if path.is_file() else "is not a file" if path.exists() else "does not exist"
    except OSError as error:
        state = f"cannot be accessed ({error.strerror})"
    if state:
        raise TrackError(
            f"the track file {quoted(str(path))} {state} (working folder: {Path.cwd()}). Give the path of a .yaml file "
            f"or one of the known tracks: {', '.join(BUILTIN_TRACKS)}."
        )
    return path


class _PlainLoader(yaml.SafeLoader):
    """YAML's safe loader that refuses duplicate keys, of which YAML silently keeps the last, and aliases.

    With aliases, a small file can expand to more data than fits in memory.
    """

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not allowed", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value!r} is given twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def _parse(path: Path) -> Any:
    """Return a file's content as Python objects."""
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise TrackError(f"{path}: the track file has {size:,} bytes, but must have no more than {MAX_BYTES:,}.")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TrackError(f"{path}: the track file cannot be read: {error}.") from error
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "somewhere"
        raise TrackError(f"{path}: not valid YAML at {where}: {error.problem}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise TrackError(f"{path}: not valid YAML: {error}.") from error


class _TrackReader:
    """Converts a file's content to a ``Track``; errors name the invalid field."""

    def __init__(self, source: str, name: str):
        self._source, self._name = source, name

    def read(self, content: Any) -> Track:
        """Check the type of every field and fill in the defaults."""
        if content is None:
            raise TrackError(f"{self._source}: the track file is empty; it must have gates, see docs/tracks.md.")
        content = self._mapping(
            content,
            "the file",
            required={"gates"},
            optional={"name", "laps", "decoys", "shape", "start", "bounds"},
        )
        gates = self._gates(content["gates"], "gates", "race")
        if len(gates) < 2:
            raise self._error("gates", content["gates"], "a list of at least 2 race gates, so that there is a lap")
        start_position, start_yaw_degrees = self._start(content.get("start", {}))
        bounds_low, bounds_high = self._bounds(content["bounds"]) if "bounds" in content else (None, None)
        return make_track(
            self._text(content.get("name", self._name), "name"),
            gates,
            decoys=self._gates(content.get("decoys", []), "decoys", "decoy"),
            shape=self._shape(content.get("shape", {})),
            start_position=start_position,
            start_yaw_degrees=start_yaw_degrees,
            bounds_low=bounds_low,
            bounds_high=bounds_high,
            laps=self._count(content.get("laps", 3), "laps"),
        )

    def _gates(self, value: Any, where: str, kind: Literal["race", "decoy"]) -> list[Gate]:
        """Read a list of gates of one kind."""
        if not isinstance(value, list):
            raise self._error(where, value, "a list of gates, each with a position and yaw_degrees")
        return [self._gate(item, f"{where}[{index}]", kind) for index, item in enumerate(value)]

    def _gate(self, value: Any, where: str, kind: Literal["race", "decoy"]) -> Gate:
        """Read one gate."""
        fields = self._mapping(value, where, required={"position", "yaw_degrees"}, optional={"kind", "color"})
        if fields.get("kind", kind) != kind:
            raise self._error(
                f"{where}.kind",
                fields["kind"],
                f"{kind!r} here or left out: kinds are 'race' (listed under gates, in the order of flight) and 'decoy' "
                "(listed under decoys, drawn only)",
            )
        return Gate(
            position=self._vector(fields["position"], f"{where}.position"),
            yaw_degrees=self._number(fields["yaw_degrees"], f"{where}.yaw_degrees"),
            kind=kind,
            color=self._color(fields["color"], f"{where}.color") if "color" in fields else None,
        )

    def _start(self, value: Any) -> tuple[Vector | None, float | None]:
        """Read the start pose; a missing field is None."""
        fields = self._mapping(value, "start", required=set(), optional={"position", "yaw_degrees"})
        position = self._vector(fields["position"], "start.position") if "position" in fields else None
        yaw_degrees = self._number(fields["yaw_degrees"], "start.yaw_degrees") if "yaw_degrees" in fields else None
        return position, yaw_degrees

    def _bounds(self, value: Any) -> tuple[Vector, Vector]:
        """Read the corners of the bounding box."""
        fields = self._mapping(value, "bounds", required={"low", "high"})
        return self._vector(fields["low"], "bounds.low"), self._vector(fields["high"], "bounds.high")

    def _shape(self, value: Any) -> GateShape:
        """Read the dimensions of the gates."""
        fields = self._mapping(value, "shape", required=set(), optional={"opening", "outer", "depth", "margin"})
        return GateShape(**{name: self._number(number, f"shape.{name}") for name, number in fields.items()})

    def _mapping(
        self, value: Any, where: str, *, required: Collection[str], optional: Collection[str] = ()
    ) -> dict[str, Any]:
        """Read a mapping with all required and no unknown keys."""
        allowed = sorted({*required, *optional})
        if not isinstance(value, dict):
            raise self._error(where, value, f"a mapping with the fields {', '.join(allowed)}")
        prefix = "" if where == "the file" else f"{where}."
        for key in value:
            if key not in allowed:
                raise TrackError(
                    f"{self._source}: {prefix}{shortened(str(key))} is an unknown field (its value is "
                    f"{quoted(value[key])}){suggestion(key, allowed)}; the allowed fields of {where} are "
                    f"{', '.join(allowed)}."
                )
        for key in sorted(required):
            if key not in value:
                there = shortened(", ".join(map(str, value))) or "no field"
                raise TrackError(
                    f"{self._source}: {prefix}{key} is missing; {where} has {there} "
                    f"and needs {', '.join(sorted(required))}."
                )
        return value

    def _vector(self, value: Any, where: str) -> Vector:
        """Read three numbers x, y, z in m."""
        if not isinstance(value, list) or len(value) != 3:
            raise self._error(where, value, "a list of three numbers [x, y, z] in m")
        x, y, z = (self._number(number, f"{where}[{axis}]") for axis, number in enumerate(value))
        return (x, y, z)

    def _color(self, value: Any, where: str) -> Vector:
        """Read red, green and blue."""
        if not isinstance(value, list) or len(value) != 3:
            raise self._error(where, value, "a list of three numbers [red, green, blue] from 0 to 1")
        red, green, blue = (self._number(number, f"{where}[{axis}]") for axis, number in enumerate(value))
        if not all(0 <= part <= 1 for part in (red, green, blue)):
            raise self._error(where, value, "three numbers [red, green, blue] from 0 to 1")
        return (red, green, blue)

    def _number(self, value: Any, where: str) -> float:
        """Read a finite number; booleans are refused."""
        try:
            if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
                return float(value)
        except OverflowError:
            pass  # an integer too large for a float is refused like any other bad value
        raise self._error(where, value, "a finite number")

    def _count(self, value: Any, where: str) -> int:
        """Read a whole number of at least 1."""
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise self._error(where, value, "a whole number of at least 1")
        return value

    def _text(self, value: Any, where: str) -> str:
        """Read a non-empty string."""
        if not isinstance(value, str) or not value.strip():
            raise self._error(where, value, "a text that is not empty")
        return value

    def _error(self, where: str, value: Any, allowed: str) -> TrackError:
        """Return the error of an invalid field."""
        return refusal(self._source, where, value, allowed)
