"""Race tracks: gates in flight order, decoys, start pose and bounding box, each track one YAML file."""

from dreamer_racing.envs.tracks.loading import (
    BUILTIN_TRACKS,
    PLAIN_TRACKS,
    decoys_for,
    describe_track,
    displace_gates,
    hash_track,
    load_track,
    read_track,
    with_decoys,
)
from dreamer_racing.envs.tracks.track import GROUND_HEIGHT, Gate, GateShape, Track, TrackError, make_track
from dreamer_racing.envs.tracks.validation import validate_track

__all__ = [
    "BUILTIN_TRACKS",
    "GROUND_HEIGHT",
    "PLAIN_TRACKS",
    "Gate",
    "GateShape",
    "Track",
    "TrackError",
    "decoys_for",
    "describe_track",
    "displace_gates",
    "hash_track",
    "load_track",
    "make_track",
    "read_track",
    "validate_track",
    "with_decoys",
]
