"""Tracks by name or from YAML files, and their variants: with decoys, and with displaced gates.

Errors name the file, the field, its value and what is allowed.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from dreamer_racing.envs.tracks.track import Gate, GateShape, Track, TrackError, make_track, refusal
from dreamer_racing.envs.tracks.validation import validate_track
from dreamer_racing.settings import quoted, shortened, suggestion

if TYPE_CHECKING:
    import torch

BUILTIN_TRACKS: tuple[str, ...] = ("circle", "kidney", "figure8", "split_s", "figure8_decoys")
"""Track names that ``load_track`` accepts."""

DECOYS = "paper"
"""Name of the set of decoys."""

DECORATED = {"figure8": "figure8_decoys"}
"""The plain tracks that have these decoys, and for each the built-in track with them."""

PLAIN_TRACKS: tuple[str, ...] = tuple(name for name in BUILTIN_TRACKS if name not in DECORATED.values())
"""Built-in tracks, without those that only add decoys to another one, which are the same race."""

ATTEMPTS = 1000
"""Maximum number of displacements drawn to find one that can be flown [choice]."""

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
    path = _find(name_or_path)
    return _load_builtin(path) if path.parent == _FOLDER else _load_file(path)


def _load_file(path: Path) -> Track:
    return read_track(_parse(path), str(path), name=path.stem)


_load_builtin = functools.cache(_load_file)


def read_track(content: Any, source: str, name: str = "track") -> Track:
    """Return the checked track described by a file's content or a result of `describe_track`.

    Args:
        content: Python objects as parsed from YAML or JSON.
        source: their origin, for messages.
        name: name of the track if the content has none.

    Raises:
        TrackError: a field is wrong, or the track cannot be flown.
    """
    if content is None:
        raise TrackError(f"{source}: the track file is empty; it must have gates, see docs/tracks.md.")
    optional = ("name", "laps", "decoys", "shape", "start", "bounds")
    fields = _mapping(content, source, "the file", ("gates",), optional)
    gates = _gates(fields["gates"], source, "gates", "race")
    if len(gates) < 2:
        raise refusal(source, "gates", fields["gates"], "a list of at least 2 race gates, so that there is a lap")
    shape = [field.name for field in dataclasses.fields(GateShape)]
    start = _mapping(fields.get("start", {}), source, "start", (), ("position", "yaw_degrees"))
    bounds = _mapping(fields["bounds"], source, "bounds", ("low", "high")) if "bounds" in fields else {}
    track = make_track(
        fields.get("name", name),
        gates,
        decoys=_gates(fields.get("decoys", []), source, "decoys", "decoy"),
        shape=GateShape(**_mapping(fields.get("shape", {}), source, "shape", (), shape)),
        start_position=start.get("position"),
        start_yaw_degrees=start.get("yaw_degrees"),
        bounds_low=bounds.get("low"),
        bounds_high=bounds.get("high"),
        laps=fields.get("laps", 3),
        source=source,
    )
    validate_track(track, source=source)
    return track


def _gates(value: Any, source: str, where: str, kind: str) -> list[Gate]:
    """Read a list of gates, whose numbers are checked later."""
    if not isinstance(value, list):
        raise refusal(source, where, value, "a list of gates, each with a position and yaw_degrees")
    required, optional = ("position", "yaw_degrees"), ("kind", "color")
    items = [_mapping(item, source, f"{where}[{index}]", required, optional) for index, item in enumerate(value)]
    return [Gate(**{"kind": kind, **item}) for item in items]


def _mapping(
    value: Any, source: str, where: str, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the fields that are not null of a mapping with all required and no unknown keys."""
    allowed = sorted((*required, *optional))
    if not isinstance(value, dict):
        raise refusal(source, where, value, f"a mapping with the fields {', '.join(allowed)}")
    prefix = "" if where == "the file" else f"{where}."
    for key in value:
        if key not in allowed:
            raise TrackError(
                f"{source}: {prefix}{shortened(str(key))} is an unknown field (its value is {quoted(value[key])})"
                f"{suggestion(key, allowed)}; the allowed fields of {where} are {', '.join(allowed)}."
            )
    fields = {key: item for key, item in value.items() if item is not None}
    for key in required:
        if key not in fields:
            raise TrackError(
                f"{source}: {prefix}{key} is missing; {where} has {', '.join(fields) or 'no field'} and needs "
                f"{', '.join(required)}."
            )
    return fields


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


def with_decoys(track: str | Path | Track, decoys: str | None) -> Track:
    """Return a track with a set of decoys (gates that are only rendered), unchanged, or without decoys.

    Args:
        track: an argument of `load_track`; a track that already has these decoys is returned unchanged.
        decoys: name of the set; None to leave the track unchanged, ``"none"`` to remove its decoys.

    Raises:
        TrackError: unknown track or set, or a track without this set.

    Example:
        >>> len(with_decoys("figure8", "paper").decoys)
        2
    """
    loaded = load_track(track)
    if decoys is None:
        return loaded
    if decoys not in (DECOYS, "none"):
        raise TrackError(f"decoys={decoys}: must be {DECOYS} or none.")
    for plain, decorated in _pairs():
        if loaded in (plain, decorated):
            return plain if decoys == "none" else decorated
    if decoys == "none":
        return dataclasses.replace(loaded, decoys=())
    raise TrackError(
        f"decoys={decoys} is for track={', '.join(DECORATED)}; track {loaded.name!r} has no place for them. A track "
        "file may list decoys of its own."
    )


def decoys_for(track: Track) -> str | None:
    """Return the name of the set of decoys that a track has or can have; None if there is none."""
    return DECOYS if any(track in pair for pair in _pairs()) else None


def _pairs() -> list[tuple[Track, Track]]:
    """Return the tracks of `DECORATED`, without decoys and with them."""
    return [(load_track(plain), load_track(decorated)) for plain, decorated in DECORATED.items()]


def displace_gates(track: Track, shift: float, turn_degrees: float, seed: int) -> Track:
    """Shift and rotate every race gate at random; start, bounding box and decoys are unchanged.

    If the resulting track cannot be flown, all gates are drawn again.

    Args:
        track: the track.
        shift: radius of the ball from which each gate's displacement is drawn uniformly, m.
        turn_degrees: half-width of the uniform rotation of each gate about the vertical, degrees.
        seed: seed of the draw; the same seed gives the same track.

    Raises:
        TrackError: no displacement was found that can be flown.

    Example:
        >>> displaced = displace_gates(load_track("circle"), shift=0.3, turn_degrees=10.0, seed=0)
        >>> displaced.start_position == load_track("circle").start_position
        True
    """
    import torch  # only loaded to displace gates

    generator = torch.Generator().manual_seed(seed)
    for _ in range(ATTEMPTS):
        displaced = dataclasses.replace(
            track,
            name=f"{track.name}_displaced",
            gates=tuple(_displace(gate, shift, turn_degrees, generator) for gate in track.gates),
        )
        try:
            validate_track(displaced, source=displaced.name)
        except TrackError:
            continue
        return displaced
    raise TrackError(
        f"track {track.name!r}: none of {ATTEMPTS} displacements by up to {shift} m and {turn_degrees}° can be flown. "
        "Use smaller ones, or place the gates farther from each other and from the bounding box."
    )


def _displace(gate: Gate, shift: float, turn_degrees: float, generator: torch.Generator) -> Gate:
    """Draw the displacement of one gate."""
    import torch

    direction = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    radius, turn = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    x, y, z = (
        old + shift * radius ** (1 / 3) * new for old, new in zip(gate.position, direction.tolist(), strict=True)
    )
    yaw_degrees = gate.yaw_degrees + turn_degrees * (2.0 * turn - 1.0)
    return dataclasses.replace(gate, position=(x, y, z), yaw_degrees=yaw_degrees)
