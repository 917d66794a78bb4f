"""The list of tracks."""

from __future__ import annotations

import json
from pathlib import Path

from PIL import Image

from dreamer_racing.envs.tracks import BUILTIN_TRACKS
from tests.running_recipes import ROOT, recipe

TRIANGLE = """name: triangle
gates:
  - {position: [0.0, 0.0, 1.35], yaw_degrees: 0.0}
  - {position: [8.0, 0.0, 1.35], yaw_degrees: 120.0}
  - {position: [8.0, 6.0, 1.35], yaw_degrees: -120.0}
"""


def test_the_list_needs_no_torch_and_has_every_track(tmp_path: Path) -> None:
    before = (
        "import builtins; imports = builtins.__import__\n"
        "def without_torch(name, *rest, **named):\n"
        "    assert name.partition('.')[0] != 'torch'\n"
        "    return imports(name, *rest, **named)\n"
        "builtins.__import__ = without_torch"
    )
    done = recipe("tracks", cwd=tmp_path, before=before)
    head, *lines = done.stdout.splitlines()
    assert done.returncode == 0 and head.startswith("track"), done.stderr
    assert [line.split()[0] for line in lines] == list(BUILTIN_TRACKS)
    assert not list(tmp_path.iterdir())
    assert done.stdout in (ROOT / "docs" / "tracks.md").read_text(encoding="utf-8")


def test_a_track_of_ones_own_is_measured_and_drawn(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(TRIANGLE)
    done = recipe("tracks", "track=mine.yaml", "picture=mine.png", "--json", cwd=tmp_path)
    (found,) = json.loads(done.stdout)
    assert found["track"] == "triangle" and (found["gates"], found["decoys"], found["laps"]) == (3, 0, 3)
    assert found["lap_length"] == 8.0 + 6.0 + 10.0 and found["least_gate_distance"] == 6.0
    with Image.open(tmp_path / "mine.png") as image:
        assert image.width > 500


def test_what_cannot_be_flown_or_drawn_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("gates: 3\n")
    for overrides, said in ((["track=mine.yaml"], "mine.yaml: gates is 3"), (["picture=a.gif"], "picture=a.gif")):
        done = recipe("tracks", *overrides, cwd=tmp_path)
        assert done.returncode == 2 and said in done.stderr and "Traceback" not in done.stderr
