"""Race tracks: gates in flight order, decoys, start pose and bounding box, each track one YAML file."""

from dreamer_racing.envs.tracks.loading import BUILTIN_TRACKS, load_track
from dreamer_racing.envs.tracks.track import GROUND_HEIGHT, Gate, GateShape, Track, TrackError, make_track
from dreamer_racing.envs.tracks.validation import validate_track

__all__ = [
    "BUILTIN_TRACKS",
    "GROUND_HEIGHT",
    "Gate",
    "GateShape",
    "Track",
    "TrackError",
    "load_track",
    "make_track",
    "validate_track",
]
