"""Shell commands for messages, valid in the current working directory and for the running Python."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
"""Root of the clone, if the package runs from one."""
MADE_BY_DEV = "dreamer_racing.place"
"""Name of the marker file that `./dev` writes into an environment that it made."""


def from_here(path: str | Path) -> str:
    """Return a path as one would type it: relative if it lies below the working directory, else absolute."""
    path, here = Path(path).absolute(), Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def dev() -> str:
    """Return the path of `./dev` and a space if the running Python is in an environment made by it, else nothing."""
    if not ((ROOT / "dev").is_file() and (Path(sys.prefix) / MADE_BY_DEV).is_file()):
        return ""
    near = from_here(ROOT / "dev")
    return f"{near if os.sep in near else f'./{near}'} "


def python() -> str:
    """Return the command of the running Python: `python` if the shell finds this one under that name, else its path."""
    if start := dev():
        return f"{start}python"
    found = shutil.which("python")
    return "python" if found and Path(found).parent == Path(sys.executable).parent else sys.executable


def install_extra(extra: str) -> str:
    """Return the pip command that installs an extra of this project, from the clone or from the package index."""
    cloned = (ROOT / "pyproject.toml").is_file()
    place = from_here(ROOT) if cloned else "dreamer_racing"
    return f"{dev()}pip install {'-e ' if cloned else ''}'{place}[{extra}]'"


def import_extra(module: str, extra: str, needed: str) -> Any:
    """Import a module that an extra installs; raise ``ImportError`` with the command if it is not installed.

    ``needed`` says in the message what needs which package.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{needed}: {install_extra(extra)}.") from error
