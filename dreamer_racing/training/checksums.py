"""Whether the files of a checkpoint are as they were saved: their CRC-32, noted beside them."""

from __future__ import annotations

import json
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

from torchrl.checkpoint import Checkpoint

from dreamer_racing.training.directory import PROCESS, PROCESSES

CHECKSUMS = "checksums.json"
"""The file with the CRC-32 of all others of a checkpoint, by path: against damage, not against intent."""


def write_checksums(path: Path) -> None:
    """Notes the checksum of every other file of a checkpoint, the manifest's too."""
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.name != CHECKSUMS)
    sums = {file.relative_to(path).as_posix(): _checksum(file) for file in files}
    (path / CHECKSUMS).write_text(json.dumps(sums, indent=1), encoding="utf-8")


def damage_of(path: Path, parts: Collection[str] | None) -> str | None:
    """Says which file of some parts is not as it was saved; None if all are."""
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
            return f"{name} is not what was saved"
    return None


def _files_of(path: Path, parts: Collection[str] | None) -> Iterator[str]:
    """Names the files of some parts, of every process; a manifest comes first, to be compared before it is read."""
    yield "manifest.json"
    manifest = Checkpoint.manifest(path)
    for part, record in manifest["components"].items():
        if parts is None or part in parts:
            yield from (f"{record['path']}/{file}" for file in record["files"])
    for rank in range(1, (manifest.get("metadata") or {}).get(PROCESSES, 1)):
        folder = f"{PROCESS}{rank}"
        yield from (f"{folder}/{name}" for name in _files_of(path / folder, parts))


def _checksum(file: Path) -> int | None:
    """Returns that of a file's content; None of one that cannot be read."""
    checksum = 0
    try:
        with file.open("rb") as content:
            while part := content.read(1 << 20):
                checksum = zlib.crc32(part, checksum)
    except OSError:
        return None
    return checksum
