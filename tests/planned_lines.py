"""Racing lines that one process of a test session has planned, for all others: each takes seconds."""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import pickle
import shutil
import tempfile
from pathlib import Path

from dreamer_racing.envs import worlds
from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.race import pilot, racing_line
from dreamer_racing.envs.race.racing_line import LineLimits, RacingLine
from dreamer_racing.envs.tracks import Track

FOLDER = "DREAMER_RACING_TEST_LINES"  # variable that processes inherit from the first of a session
if FOLDER not in os.environ:
    os.environ[FOLDER] = tempfile.mkdtemp(prefix="lines_")
    atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)
_plan = racing_line.plan_racing_line.__wrapped__


@functools.cache
def plan_once(track: Track, parameters: QuadrotorParameters, limits: LineLimits) -> RacingLine:
    """Read a line that was planned already, or plan it and leave it to others."""
    name = hashlib.sha256(repr((track, parameters, limits)).encode()).hexdigest()
    file = Path(os.environ[FOLDER], name)
    if file.exists():
        return pickle.loads(file.read_bytes())
    line = _plan(track, parameters, limits)
    if file.parent.exists():
        partial = file.with_suffix(f".{os.getpid()}")
        partial.write_bytes(pickle.dumps(line))
        partial.replace(file)
    return line


plan_once.__wrapped__ = _plan  # type: ignore[attr-defined]
for module in (racing_line, pilot, worlds):
    module.plan_racing_line = plan_once  # type: ignore[assignment]
