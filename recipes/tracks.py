"""List race tracks, also your own: gates, laps, length, the least distance between gates; and draw them.

    python recipes/tracks.py
    python recipes/tracks.py picture=tracks.png
    python recipes/tracks.py track=my_track.yaml picture=my_track.png
    python recipes/tracks.py --json

Lengths are of straight lines from gate to gate and back to the first. A track
file that cannot be flown is refused with the field, its value and what would be right.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from composing.entry import plain_errors, recipe

from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Track, load_track

PICTURES = (".png", ".pdf", ".svg")


@dataclass
class TracksConfig:
    """Configuration of `recipes/tracks.py`."""

    track: str | None = None  # built-in track, or path to a YAML file; null: all built-in ones
    picture: str | None = None  # file to draw them into, as maps from above and from the side: .png, .pdf or .svg
    json: bool = False  # print JSON on stdout, for programs; --json does the same

    def check(self) -> None:
        """Refuse a picture of an unknown kind."""
        if self.picture is not None and Path(self.picture).suffix not in PICTURES:
            raise ValueError(f"picture={self.picture}: the name of the file must end in {', '.join(PICTURES)}.")


@recipe("tracks", TracksConfig, logs=False)
def main(config: TracksConfig) -> None:
    """List, and draw."""
    with plain_errors():
        tracks = [load_track(name) for name in ([config.track] if config.track else BUILTIN_TRACKS)]
    found = [measures(track) for track in tracks]
    print(json.dumps(found, indent=1) if config.json else "\n".join(table(found)))
    if config.picture is not None:
        from dreamer_racing.figures.flights import plot_tracks  # importing it takes far longer than the list

        with plain_errors():
            plot_tracks(tracks, config.picture)
        if not config.json:
            print(f"picture: {config.picture}")


def measures(track: Track) -> dict[str, Any]:
    """Return the listed properties of a track; lengths in m, between centres of gates."""
    return {
        "track": track.name,
        "gates": track.num_gates,
        "decoys": len(track.decoys),
        "laps": track.laps,
        "lap_length": round(sum(track.gate_distances), 2),
        "least_gate_distance": round(min(track.gate_distances), 2),
        "box": [round(high - low, 2) for low, high in zip(track.bounds_low, track.bounds_high, strict=True)],
    }


def table(found: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table."""
    width = max(len("track"), *(len(row["track"]) for row in found))
    yield f"{'track':<{width}}  gates  decoys  laps  lap (m)  least gap (m)  box (m)"
    for row in found:
        box = " × ".join(f"{side:.1f}" for side in row["box"])
        yield (
            f"{row['track']:<{width}}  {row['gates']:5}  {row['decoys']:6}  {row['laps']:4}  {row['lap_length']:7.1f}"
            f"  {row['least_gate_distance']:13.2f}  {box}"
        )


if __name__ == "__main__":
    main()
