"""Atomic publishing and removal of checkpoints: a folder with a checkpoint's name is complete even after a kill.

A CRC-32 of every file is stored in the checkpoint, to detect damage.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import torch
from torchrl.checkpoint import Checkpoint, StateDictCheckpointAdapter

from dreamer_racing.training.directory import PREFIX, PROCESS, PROCESSES, REPLACED, is_complete, original_path

logger = logging.getLogger(__name__)

CHECKSUMS = "checksums.json"
"""File with the CRC-32 of all other files of a checkpoint, by path; it detects damage, not manipulation."""


def publish(partial: Path, final: Path) -> None:
    """Turn a folder with a checkpoint's files, written under another name, into the final checkpoint."""
    for file in partial.rglob(StateDictCheckpointAdapter.state_torch):  # so unreadable values are found now
        torch.load(file, map_location="cpu", mmap=True, weights_only=True)
    write_checksums(partial)
    _sync_tree(partial)
    aside = final.with_name(f".{final.name}{REPLACED}")
    if final.exists():  # a folder cannot be replaced by a rename
        os.replace(final, aside)
    os.replace(partial, final)
    shutil.rmtree(aside, ignore_errors=True)
    _sync(final.parent)


def _sync_tree(path: Path) -> None:
    for entry in (*path.rglob("*"), path):
        _sync(entry)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a checkpoint; it is renamed first, so that a kill meanwhile leaves no incomplete one of that name."""
    tombstone = path.with_name(f".{path.name}.removed")
    shutil.rmtree(tombstone, ignore_errors=True)
    os.replace(path, tombstone)
    shutil.rmtree(tombstone)


def remove_unfinished(directory: Path) -> None:
    """Remove unfinished checkpoints of a killed process; restore one that was renamed for a missing replacement."""
    for path in directory.glob(f".*{PREFIX}-*"):
        final = original_path(path)
        if path.name.endswith(REPLACED) and not final.exists() and is_complete(path):
            os.replace(path, final)
        else:
            logger.info("Removing the unfinished %s.", path)
            shutil.rmtree(path, ignore_errors=True)


def write_checksums(path: Path) -> None:
    """Write the checksums of all other files of a checkpoint, including the manifest."""
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.name != CHECKSUMS)
    sums = {file.relative_to(path).as_posix(): _checksum(file) for file in files}
    (path / CHECKSUMS).write_text(json.dumps(sums, indent=1), encoding="utf-8")


def damage_of(path: Path, parts: Collection[str] | None) -> str | None:
    """Return a description of the first damaged file of some parts; None if all are as they were saved."""
    try:
        sums = json.loads((path / CHECKSUMS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return f"{CHECKSUMS} is missing"
    except (ValueError, OSError):
        sums = None
    if not isinstance(sums, dict):
        return f"{CHECKSUMS} cannot be read"
    for name in _files_of(path, parts):
        if name not in sums:
            return f"{CHECKSUMS} lacks {name}"
        if _checksum(path / name) != sums[name]:
            return f"{name} does not match its checksum"
    return None


def _files_of(path: Path, parts: Collection[str] | None) -> Iterator[str]:
    """Yield the files of some parts, of every process; a manifest comes first, to be checked before it is read."""
    yield "manifest.json"
    manifest = Checkpoint.manifest(path)
    for part, record in manifest["components"].items():
        if parts is None or part in parts:
            yield from (f"{record['path']}/{file}" for file in record["files"])
    for rank in range(1, (manifest.get("metadata") or {}).get(PROCESSES, 1)):
        folder = f"{PROCESS}{rank}"
        yield from (f"{folder}/{name}" for name in _files_of(path / folder, parts))


def _checksum(file: Path) -> int | None:
    """Return the checksum of a file's content; None if it cannot be read."""
    checksum = 0
    try:
        with file.open("rb") as content:
            while part := content.read(1 << 20):
                checksum = zlib.crc32(part, checksum)
    except OSError:
        return None
    return checksum
