"""A run directory: one process at a time in it, what lies where, and what of it is complete."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import socket
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError

from dreamer_racing import parallel
from dreamer_racing.commands import from_here

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"
PREFIX = "checkpoint"
REPLACED = ".replaced"
"""End of the hidden name under which a checkpoint waits until another of its name is there."""
PROCESS, PROCESSES = "process-", "processes"
"""Folders of what processes beside the first have of their own, and the metadata that says how many there were."""
EVALUATION = "evaluation.json"
"""Numbers of an evaluation, in whichever folder it is written to."""
BEGUN = ".begun"
"""File by which a process claims a folder for what it is about to measure."""


@dataclass(frozen=True)
class RunDirectory:
    """The folder of a run, or of its best checkpoint, which is laid out alike.

    Args:
        path: the folder.

    Example:
        >>> RunDirectory(Path("runs/example")).metrics
        PosixPath('runs/example/metrics.csv')
    """

    path: Path

    @classmethod
    def of(cls, checkpoint: Path) -> RunDirectory:
        """Return that of the run which left a checkpoint."""
        return cls(checkpoint.parents[1])

    @property
    def checkpoints(self) -> Path:
        """Folder of checkpoints, everything that a run goes on from."""
        return self.path / CHECKPOINTS

    @property
    def best(self) -> RunDirectory:
        """Networks as they were at the best evaluation, with the configuration."""
        return RunDirectory(self.path / "best")

    @property
    def run(self) -> RunDirectory:
        """That of the run, where this is its best checkpoint's; else this one."""
        around = RunDirectory(self.path.parent)
        is_run = around.config.exists() or around.starts.exists()
        return around if self == around.best and is_run else self

    @property
    def config(self) -> Path:
        """The resolved configuration of the latest start."""
        return self.path / "config.yaml"

    @property
    def overrides(self) -> Path:
        """What it was composed from, a YAML list."""
        return self.path / "overrides.yaml"

    @property
    def starts(self) -> Path:
        """Every start of the run, a line of JSON each: see ``note_start``."""
        return self.path / "starts.jsonl"

    @property
    def metrics(self) -> Path:
        """Table over env_steps."""
        return self.path / "metrics.csv"

    @property
    def wandb_run(self) -> Path:
        """The id that the run has at W&B."""
        return self.path / "wandb" / "run.json"

    @property
    def evaluations(self) -> Path:
        """Folder of what evaluations during training measured."""
        return self.path / "evaluations"

    @property
    def plots(self) -> Path:
        """Folder of pictures."""
        return self.path / "plots"

    @property
    def videos(self) -> Path:
        """Folder of films."""
        return self.path / "videos"

    @property
    def evaluation(self) -> Path:
        """Folder of an evaluation after training."""
        return self.path / "evaluation"

    @property
    def evaluation_file(self) -> Path:
        """Numbers of that evaluation."""
        return self.evaluation / EVALUATION

    @property
    def replay(self) -> Path:
        """Folder of this process's replay while the run goes on, with ``replay.storage=memmap``."""
        return self.path / "replay" / f"{PROCESS}{parallel.rank()}"

    @property
    def nonfinite_batch(self) -> Path:
        """The batch whose loss was not finite."""
        return self.path / "nonfinite_batch.pt"

    @property
    def finished(self) -> Path:
        """What says that all that the run was asked for is done, evaluation and metrics included."""
        return self.path / "finished.json"

    def claim(self) -> RunLock:
        """Make the folder if needed, and hold it for this process alone.

        Raises:
            PermissionError: nothing can be written there.
            ValueError: a live run holds it.
        """
        made = not self.path.exists()
        return RunLock(ensure_writable(self.path), made)

    def mark_finished(self, env_steps: int) -> None:
        """Note that all is done."""
        replace_text(self.finished, json.dumps({"env_steps": env_steps}) + "\n")

    def finished_env_steps(self) -> int:
        """Return the env_steps that the run was finished at; 0 if it was not, or if nobody can tell."""
        try:
            return int(json.loads(self.finished.read_text(encoding="utf-8"))["env_steps"])
        except FileNotFoundError:
            return 0
        except (ValueError, TypeError, KeyError):
            logger.warning("%s is damaged: the run is taken for one that goes on.", self.finished)
            return 0

    def latest_evaluation(self) -> str | None:
        """Return what files of the deterministic policy's latest evaluation are called, its env_steps; None without."""
        names = (path.stem for path in self.evaluations.glob("*.json"))
        return max((name for name in names if name.isdecimal()), key=int, default=None)

    def set_aside_after(self, env_steps: int) -> None:
        """Move what evaluations left after where the run goes on to ``evaluations.replaced``, and so on.

        They are of flights that are to be flown again, perhaps otherwise.
        """
        moved: set[int] = set()
        for folder in (self.evaluations, self.plots, self.videos):
            for file in folder.glob("*"):
                number = file.stem.partition("_")[0]
                if number.isdecimal() and int(number) > env_steps:
                    aside = folder.with_name(folder.name + REPLACED)
                    aside.mkdir(exist_ok=True)
                    file.replace(aside / file.name)
                    moved.add(int(number))
        if moved:
            logger.warning(
                "evaluations at %s env_steps are from after where the run goes on: their files are in *%s of %s",
                ", ".join(f"{number:,}" for number in sorted(moved)),
                REPLACED,
                self.path,
            )

    def note_start(self, env_steps: int, overrides: Sequence[str], commit: str | None) -> None:
        """Note that the run was begun, or continued at so many env_steps, with which overrides at which commit."""
        line = {"env_steps": env_steps, "overrides": list(overrides), "commit": commit}
        with self.starts.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"date": f"{datetime.now(UTC):%Y-%m-%d %H:%M}", **line}) + "\n")

    def read_starts(self) -> list[dict[str, Any]]:
        """Return every start that was noted; none of runs of older versions."""
        try:
            lines = self.starts.read_text(encoding="utf-8").splitlines(keepends=True)
        except FileNotFoundError:
            return []
        starts = []
        for line in lines:
            try:
                starts.append(json.loads(line))
            except ValueError:
                if line.endswith("\n"):  # a kill may cut the last one short
                    logger.warning("A line of %s is damaged, and left out.", self.starts)
        return starts


def complete_checkpoints(path: str | Path) -> list[Path]:
    """Finds the complete checkpoints, newest first. Folders that a killed process left incomplete are passed over.

    One that had stepped aside for another of its name, which never came, is among them.

    Args:
        path: run directory, folder of checkpoints, or one checkpoint.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(path).absolute()
    if is_complete(path):
        return [path]
    for directory in (path / CHECKPOINTS, path):
        aside = [path for path in directory.glob(f".{PREFIX}-*{REPLACED}") if not stepped_aside(path).exists()]
        candidates = sorted([*directory.glob(f"{PREFIX}-*"), *aside], key=env_steps_of, reverse=True)
        found = [candidate for candidate in candidates if is_complete(candidate)]
        for candidate in candidates:
            if candidate not in found:
                newer = found and env_steps_of(candidate) > env_steps_of(found[0])
                lost = f"; what came after {found[0].name} is lost" if newer else ""
                logger.warning("Passing over %s: it is not a complete checkpoint%s.", candidate, lost)
        if found:
            return found
    run = RunDirectory(path.parent)
    if path == run.best.path and (run.config.exists() or run.starts.exists()):
        raise FileNotFoundError(
            f"No complete checkpoint at {path}: the run's first evaluation makes it, and there was none yet. Wait for "
            f"it (evaluation.first=, evaluation.every=), or give {run.path} for its newest checkpoint."
        )
    state = "exists, but holds none" if path.exists() else "does not exist"
    raise FileNotFoundError(
        f"No complete checkpoint at {path}: the path {state}. Give a run directory (with a subfolder "
        f"'{CHECKPOINTS}'), a folder of '{PREFIX}-<env_steps>' folders, or one of these."
    )


def stepped_aside(path: Path) -> Path:
    """Return the name that a checkpoint had before it stepped aside."""
    return path.with_name(path.name.removeprefix(".").removesuffix(REPLACED))


def env_steps_of(checkpoint: Path) -> int:
    """Return the env_steps that a checkpoint's name tells; -1 of a name that tells none."""
    number = stepped_aside(checkpoint).name.rpartition("-")[2]
    return int(number) if number.isdecimal() else -1


def latest_checkpoint(path: str | Path) -> Path:
    """Finds the newest complete checkpoint, as ``complete_checkpoints`` does."""
    return complete_checkpoints(path)[0]


def replace_text(path: Path, text: str) -> None:
    """Write a file so that, whatever happens meanwhile, it is as it was or as it is to be."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def ensure_writable(directory: str | Path, setting_name: str = "run_dir") -> Path:
    """Creates a folder if needed and writes a file to it, to fail before a run and not at its first checkpoint.

    Args:
        directory: the folder.
        setting_name: by which a person chooses another.

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
            f"Cannot write to the folder {directory} ({error.strerror or error}): choose another with "
            f"{setting_name}=PATH, or give this user write permission and free space."
        ) from error
    return directory


def is_complete(path: Path) -> bool:
    """Whether the manifest, which is written last, is there with every file it lists (a copy may have lost some)."""
    if not path.is_dir():
        return False
    try:
        parts = Checkpoint.manifest(path)["components"].values()
    except (CheckpointError, OSError, TypeError, ValueError, AttributeError):  # the last for JSON that is no object
        return False
    return all((path / part["path"] / name).is_file() for part in parts for name in part["files"])


def fresh_directory(path: str | Path, result: str) -> Path:
    """Return a folder to write to: the one asked for, or if it holds anything already, the first free `<name>_2`, ...

    So nothing is mixed with what an earlier evaluation left, or one that was killed, or another that goes on.

    Args:
        path: the folder asked for.
        result: name of the file that is written last.
    """
    asked = Path(path).expanduser().absolute()
    for number in count(1):
        directory = asked if number == 1 else asked.with_name(f"{asked.name}_{number}")
        if not (directory.is_dir() and any(directory.iterdir())):
            ensure_writable(directory)
            with suppress(FileExistsError):  # another process has just claimed it
                (directory / BEGUN).touch(exist_ok=False)
                break
    if directory != asked:
        held = f"an earlier {result}" if (asked / result).exists() else f"files, but no {result}"
        logger.info("%s holds %s, which is kept: writing to %s", from_here(asked), held, from_here(directory))
    return directory


class RunLock:
    """Holds a run directory until `release`, or until the process ends in whatever way.

    Across machines it holds where the file system's locks do (NFS 4, Lustre with flock); where there are no locks it
    warns, and holds nothing.

    Args:
        directory: of the run, which exists.
        made: whether it was made for this lock.

    Attributes:
        directory: as given.

    Raises:
        ValueError: a live process holds it; the message names that one.

    Example:
        >>> lock = RunLock("runs/example")  # doctest: +SKIP
    """

    def __init__(self, directory: str | Path, made: bool = False) -> None:
        self.directory = Path(directory)
        self._made = made
        self._file = (self.directory / ".lock").open("a+", encoding="utf-8")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.seek(0)
            holder = self._file.read().strip() or "another process"
            self._file.close()
            raise ValueError(
                f"run_dir={directory} is in use by a live run ({holder}): wait for its end, stop it, or choose another "
                "run_dir."
            ) from error
        except OSError as error:
            logger.warning("%s cannot be locked (%s): see to it yourself that no other run uses it.", directory, error)
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}")
        self._file.flush()

    def release(self) -> None:
        """Let the next one in."""
        self._file.close()

    def abandon(self) -> None:
        """Let the next one in; a folder that was made for this lock, and holds nothing else, goes."""
        path = Path(self._file.name)
        with suppress(OSError):  # it stays, then
            if self._made and list(self.directory.iterdir()) == [path]:
                path.unlink()
                self.directory.rmdir()
        self.release()
