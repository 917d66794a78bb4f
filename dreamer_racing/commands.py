"""Commands in messages: as they work from where the person stands, with the Python that is running."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""Of the clone, where this is one."""
MADE_BY_DEV = "dreamer_racing.place"
"""What `./dev` leaves in an environment that it made."""


def from_here(path: str | Path) -> str:
    """Return a path as one would type it: relative where it lies below the working directory."""
    path, here = Path(path).absolute(), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def dev() -> str:
    """Return `./dev`, from here, and a space, if the Python that is running is its environment's; else nothing."""
    if not ((ROOT / "dev").is_file() and (Path(sys.prefix) / MADE_BY_DEV).is_file()):
        return ""
    near = from_here(ROOT / "dev")
    return f"{near if os.sep in near else f'./{near}'} "


def python() -> str:
    """Return what starts the Python that is running: `python`, where a shell would find this one by that name."""
    if start := dev():
        return f"{start}python"
    found = shutil.which("python")
    return "python" if found and Path(found).parent == Path(sys.executable).parent else sys.executable


def install_extra(extra: str) -> str:
    """Return the command that installs an extra of this project: of the clone, or of the package from an index."""
    cloned = (ROOT / "pyproject.toml").is_file()
    place = from_here(ROOT) if cloned else "dreamer_racing"
    return f"{dev()}pip install {'-e ' if cloned else ''}'{place}[{extra}]'"
