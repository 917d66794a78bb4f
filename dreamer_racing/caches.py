"""Cache folders of Warp and Matplotlib: their own, or a temporary one where their own is not writable.

A container that runs under another user ID, a Slurm node and a service often have no writable home directory.
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
    """Raised if no folder can hold Warp's compiled kernels; the message says what to set."""


@cache
def ensure_caches() -> str:
    """Let Warp and Matplotlib use a temporary folder if Warp's own cache is not writable; log one warning.

    Call it before importing either. The folder is removed when this process ends; its child processes use it, too.
    Why Warp's own folder is not used is returned; an empty string if it is used.

    Raises:
        CacheError: No temporary folder can be made either.
    """
    folder = warp_cache()
    reason = why_not_writable(folder)
    if not reason:
        return ""
    reason = f"cannot write to {folder} ({reason})"
    try:
        temporary = Path(tempfile.mkdtemp(prefix="dreamer_racing_"))
    except OSError as error:
        raise CacheError(
            f"There is no folder for Warp's compiled kernels: {reason}, and no temporary folder can be made ({error}). "
            "Set WARP_CACHE_PATH=FOLDER to a writable one."
        ) from error
    atexit.register(_remove, temporary, os.getpid())
    os.environ["WARP_CACHE_PATH"] = str(temporary / "warp")
    os.environ.setdefault("MPLCONFIGDIR", str(temporary / "matplotlib"))
    logger.warning(
        "%s: compiled kernels are in a temporary folder, so every program compiles them again (about ten seconds). Set "
        "WARP_CACHE_PATH=FOLDER to keep them.",
        reason,
    )
    return reason


def warp_cache() -> Path:
    """Return the folder in which Warp caches its compiled kernels."""
    version = importlib.metadata.version("warp-lang")
    if named := os.environ.get("WARP_CACHE_PATH"):
        return Path(named).absolute() / version
    if sys.platform == "win32":
        home = os.environ.get("LOCALAPPDATA", "~")
    else:
        home = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(home)) / "warp" / version


def why_not_writable(folder: Path) -> str:
    """Return why a folder is not writable, or an empty string if it is; a missing folder is created."""
    if str(folder).startswith("~"):
        return "this user has no home directory"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"writable")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _remove(folder: Path, process: int) -> None:
    """Remove a folder if this is the process that made it, not one forked from it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
