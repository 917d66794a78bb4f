"""Variants of tracks: with decoys, and with displaced gates."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from dreamer_racing.envs.tracks.loading import BUILTIN_TRACKS, load_track
from dreamer_racing.envs.tracks.track import Gate, Track, TrackError
from dreamer_racing.envs.tracks.validation import validate_track

if TYPE_CHECKING:
    import torch

DECOYS = "paper"
"""Name of the set of decoys."""

DECORATED = {"figure8": "figure8_decoys"}
"""The plain tracks that have these decoys, and for each the built-in track with them."""

PLAIN_TRACKS: tuple[str, ...] = tuple(name for name in BUILTIN_TRACKS if name not in DECORATED.values())
"""Built-in tracks, without those that only add decoys to another one, which are the same race."""

ATTEMPTS = 1000  # displacements drawn, at most, to find one that can be flown [choice]


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
