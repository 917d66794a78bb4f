"""Folders in which libraries keep what they compile: those of the home, or temporary ones where it takes no files.

A container started with another user's number, a Slurm node and a service often have no home that can be written to.
"""

from __future__ import annotations

import atexit
import importlib.metadata
import logging
import os
import shutil
import sys
import tempfile
from functools import cache
from pathlib import Path

logger = logging.getLogger(__name__)


class CacheError(OSError):
    """There is no folder for what warp compiles; the message says what to set."""


@cache
def ensure_caches() -> str:
    """Let warp and Matplotlib use a private temporary folder where their own cannot be written to, and say so, once.

    To be called before either is imported. The folder is removed when this process ends; those that it starts use it.

    Returns:
        Why the own folder is not used; nothing where it is.

    Raises:
        CacheError: no temporary folder can be made either.
    """
    folder = warp_cache()
    reason = why_not_writable(folder)
    if not reason:
        return ""
    reason = f"{folder} takes no files ({reason})"
    try:
        temporary = Path(tempfile.mkdtemp(prefix="dreamer_racing_"))
    except OSError as error:
        raise CacheError(
            f"There is nowhere to put what warp compiles: {reason}, and no temporary folder can be made "
            f"({error}). WARP_CACHE_PATH=FOLDER names one that can be written to."
        ) from error
    atexit.register(_remove, temporary, os.getpid())
    os.environ["WARP_CACHE_PATH"] = str(temporary / "warp")
    os.environ.setdefault("MPLCONFIGDIR", str(temporary / "matplotlib"))
    logger.warning(
        "%s: what is compiled lies in a temporary folder, and every program compiles it anew, some ten seconds. "
        "WARP_CACHE_PATH=FOLDER names one that lasts.",
        reason,
    )
    return reason


def warp_cache() -> Path:
    """Return the folder in which warp would keep what it compiles."""
    version = importlib.metadata.version("warp-lang")
    if named := os.environ.get("WARP_CACHE_PATH"):
        return Path(named).absolute() / version
    if sys.platform == "win32":
        home = os.environ.get("LOCALAPPDATA", "~")
    else:
        home = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(home)) / "warp" / version


def why_not_writable(folder: Path) -> str:
    """Try to write to a folder, which is made if it is missing; return why that cannot be, nothing if it can."""
    if str(folder).startswith("~"):
        return "this user has no home"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"writable")
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _remove(folder: Path, process: int) -> None:
    """Remove a folder at the end of the process that made it, not of one that was forked from it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
