"""Checkpoints put in their place, and out of it, so that one of its name is complete whenever a process is killed."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

import torch
from torchrl.checkpoint import StateDictCheckpointAdapter

from dreamer_racing.training.checksums import write_checksums
from dreamer_racing.training.directory import PREFIX, REPLACED, is_complete, stepped_aside

logger = logging.getLogger(__name__)


def publish(partial: Path, final: Path) -> None:
    """Makes a checkpoint of what was written beside its place."""
    _check_loadable(partial)
    write_checksums(partial)
    _sync_tree(partial)
    _put_in_place(partial, final)


def _check_loadable(path: Path) -> None:
    """Reads the state dicts back (mapped, not copied), to refuse values that only a resume would find unreadable."""
    for file in path.rglob(StateDictCheckpointAdapter.state_torch):
        torch.load(file, map_location="cpu", mmap=True, weights_only=True)


def _sync_tree(path: Path) -> None:
    for entry in (*path.rglob("*"), path):
        descriptor = os.open(entry, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _put_in_place(partial: Path, final: Path) -> None:
    """Renames into place. A folder cannot be renamed onto another, so an earlier one of that name steps aside."""
    aside = final.with_name(f".{final.name}{REPLACED}")
    if final.exists():
        os.replace(final, aside)
    os.replace(partial, final)
    shutil.rmtree(aside, ignore_errors=True)
    descriptor = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Removes a checkpoint: under another name first, so that a kill meanwhile leaves none of that name incomplete."""
    tombstone = path.with_name(f".{path.name}.removed")
    shutil.rmtree(tombstone, ignore_errors=True)
    os.replace(path, tombstone)
    shutil.rmtree(tombstone)


def remove_unfinished(directory: Path) -> None:
    """Removes what a killed process left; puts back a checkpoint that had stepped aside for one that never came."""
    for path in directory.glob(f".*{PREFIX}-*"):
        final = stepped_aside(path)
        if path.name.endswith(REPLACED) and not final.exists() and is_complete(path):
            os.replace(path, final)
        else:
            logger.info("Removing the unfinished %s.", path)
            shutil.rmtree(path, ignore_errors=True)
