"""A run directory: what lies where in it, and what of it is complete."""

from __future__ import annotations

import json
import logging
import os
import tempfile
from pathlib import Path

from torchrl.checkpoint import Checkpoint

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"
PREFIX = "checkpoint"
FINISHED = "finished.json"


def latest_checkpoint(path: str | Path) -> Path:
    """Finds the newest complete checkpoint. Folders that a killed process left incomplete are passed over.

    Args:
        path: run directory, folder of checkpoints, or one checkpoint.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(path).absolute()
    if is_complete(path):
        return path
    for directory in (path / CHECKPOINTS, path):
        for candidate in sorted(directory.glob(f"{PREFIX}-*"), reverse=True):
            if is_complete(candidate):
                return candidate
            logger.warning("Passing over %s: it is not a complete checkpoint.", candidate)
    found = "exists, but holds none" if path.exists() else "does not exist"
    raise FileNotFoundError(
        f"No complete checkpoint at {path}: the path {found}. Give a run directory (with a subfolder "
        f"'{CHECKPOINTS}'), a folder of '{PREFIX}-<env_steps>' folders, or one of these."
    )


def mark_finished(run_dir: str | Path, env_steps: int) -> None:
    """Note in a run directory that all that the run was asked for is done, evaluation and metrics included."""
    partial = Path(run_dir) / f".{FINISHED}.partial"
    partial.write_text(json.dumps({"env_steps": env_steps}) + "\n", encoding="utf-8")
    os.replace(partial, Path(run_dir) / FINISHED)


def finished_env_steps(run_dir: str | Path) -> int:
    """Return the env_steps that a run was finished at; 0 if it was not."""
    try:
        return int(json.loads((Path(run_dir) / FINISHED).read_text(encoding="utf-8"))["env_steps"])
    except FileNotFoundError:
        return 0


def ensure_writable(directory: str | Path) -> Path:
    """Creates a folder if needed and writes a file to it, to fail before a run and not at its first checkpoint.

    Returns:
        The absolute path of the folder.

    Raises:
        PermissionError: if nothing can be written there.
    """
    directory = Path(directory).expanduser().absolute()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory) as file:
            file.write(b"writable")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise PermissionError(
            f"Cannot write to the folder {directory} ({error.strerror or error}). The run keeps its checkpoints and "
            "metrics there: choose another with run_dir=PATH, or give this user write permission and free space."
        ) from error
    return directory


def is_complete(path: Path) -> bool:
    """Whether the manifest, which is written last, is there with every file it lists (a copy may have lost some)."""
    if not path.is_dir() or not Checkpoint.is_checkpoint(path):
        return False
    parts = Checkpoint.manifest(path)["components"].values()
    return all((path / part["path"] / name).is_file() for part in parts for name in part["files"])
