"""Run directory: its layout, its lock, and the search for complete checkpoints."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import shutil
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError

from dreamer_racing import parallel
from dreamer_racing.caches import why_not_writable
from dreamer_racing.commands import from_here
from dreamer_racing.envs.drone.parameters import SUFFIXES

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"
PREFIX = "checkpoint"
REPLACED = ".replaced"
"""Suffix of files and folders that were moved aside, such as a checkpoint that is being replaced."""
PROCESS, PROCESSES = "process-", "processes"
"""Prefix of the folders of ranks above 0, and the metadata key of the number of processes."""
EVALUATION = "evaluation.json"
"""File name of an evaluation's numbers."""
BEGUN = ".begun"
"""File by which a process claims a folder for its results."""


class _Below:
    """Attribute of a `RunDirectory`: a path below its own."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, directory: RunDirectory, owner: type[RunDirectory]) -> Path:
        return directory.path / self._name


@dataclass(frozen=True)
class RunDirectory:
    """Layout of the folder of a run, or of its best checkpoint, which is the same.

    Example:
        >>> RunDirectory(Path("runs/example")).metrics
        PosixPath('runs/example/metrics.csv')
    """

    path: Path

    checkpoints = _Below(CHECKPOINTS)  # folder of checkpoints, from which the run can be resumed
    config = _Below("config.yaml")  # resolved configuration of the latest start
    drone = _Below("drone.yaml")  # content of env.preset= at the latest start, if it was a file
    overrides = _Below("overrides.yaml")  # list of the overrides that it was composed from
    starts = _Below("starts.jsonl")  # a line of JSON for every start of the run; see `note_start`
    metrics = _Below("metrics.csv")  # table of metrics over env_steps
    evaluations = _Below("evaluations")  # folder of the results of evaluations during training
    plots = _Below("plots")  # folder
    videos = _Below("videos")  # folder
    evaluation = _Below("evaluation")  # folder of an evaluation after training
    evaluation_file = _Below(f"evaluation/{EVALUATION}")  # its numbers
    wandb_run = _Below("wandb/run.json")  # the run's ID at W&B
    nonfinite_batch = _Below("nonfinite_batch.pt")  # batch whose loss was not finite
    finished = _Below("finished.json")  # marks the run as finished, including its last evaluation and metrics

    @classmethod
    def of(cls, checkpoint: Path) -> RunDirectory:
        """Return the directory of the run that a checkpoint belongs to."""
        return cls(checkpoint.parents[1])

    @property
    def best(self) -> RunDirectory:
        """Directory of the best checkpoint: networks at the best evaluation, with the configuration."""
        return RunDirectory(self.path / "best")

    @property
    def run(self) -> RunDirectory:
        """Directory of the run, if this one is that of its best checkpoint; else this one."""
        around = RunDirectory(self.path.parent)
        is_run = around.config.exists() or around.starts.exists()
        return around if self == around.best and is_run else self

    @property
    def replay(self) -> Path:
        """Folder of this process's replay buffer during the run, with ``replay.storage=memmap``."""
        return self.path / "replay" / f"{PROCESS}{parallel.rank()}"

    def claim(self) -> RunLock:
        """Create the folder if needed, lock it, and delete replays of a killed run that had more processes.

        See `ensure_writable` and `RunLock`.
        """
        made = not self.path.exists()
        lock = RunLock(ensure_writable(self.path), made)
        for folder in self.replay.parent.glob(f"{PROCESS}*"):
            if int(folder.name.removeprefix(PROCESS)) >= parallel.num_processes():
                shutil.rmtree(folder, ignore_errors=True)
        return lock

    def mark_finished(self, env_steps: int) -> None:
        """Mark the run as finished."""
        replace_text(self.finished, json.dumps({"env_steps": env_steps}) + "\n")

    def finished_env_steps(self) -> int:
        """Return the env_steps at which the run finished; 0 if it has not, or if the mark is damaged."""
        try:
            return int(json.loads(self.finished.read_text(encoding="utf-8"))["env_steps"])
        except FileNotFoundError:
            return 0
        except (ValueError, TypeError, KeyError):
            logger.warning("%s is damaged: the run is treated as unfinished.", self.finished)
            return 0

    def latest_evaluation(self) -> str | None:
        """Return the file stem of the deterministic policy's latest evaluation, its env_steps; None without any."""
        names = (path.stem for path in self.evaluations.glob("*.json"))
        return max((name for name in names if name.isdecimal()), key=int, default=None)

    def set_aside_after(self, env_steps: int) -> None:
        """Move files of evaluations after ``env_steps`` to ``evaluations.replaced``, ``plots.replaced`` and so on.

        They belong to a part of the run that is now repeated, perhaps with other results.
        """
        moved: set[int] = set()
        for file in (file for folder in (self.evaluations, self.plots, self.videos) for file in folder.glob("*")):
            number = file.stem.partition("_")[0]
            if number.isdecimal() and int(number) > env_steps:
                aside = file.parent.with_name(file.parent.name + REPLACED)
                aside.mkdir(exist_ok=True)
                file.replace(aside / file.name)
                moved.add(int(number))
        if moved:
            numbers = ", ".join(f"{number:,}" for number in sorted(moved))
            later = "evaluations at %s env_steps are later than the resumed checkpoint: their files are in *%s of %s"
            logger.warning(later, numbers, REPLACED, self.path)

    def note_start(self, env_steps: int, overrides: Sequence[str], commit: str | None) -> None:
        """Append a start or resume of the run at ``env_steps``, with its overrides and commit, to `starts`."""
        line = {"env_steps": env_steps, "overrides": list(overrides), "commit": commit}
        torn = self.starts.exists() and self.starts.read_bytes()[-1:] not in (b"", b"\n")  # by a kill, or a full disk
        with self.starts.open("a", encoding="utf-8") as file:
            file.write("\n" * torn + json.dumps({"date": f"{datetime.now(UTC):%Y-%m-%d %H:%M}", **line}) + "\n")

    def keep_drone(self, preset: str) -> None:
        """Keep the content of a drone file, with which the run's evaluations fly, whatever becomes of the file."""
        if preset.endswith(SUFFIXES) and Path(preset).absolute() != self.drone.absolute():
            replace_text(self.drone, Path(preset).read_text(encoding="utf-8"))

    def kept_preset(self, preset: str) -> str:
        """Return the preset of a saved configuration, of which a drone file is the kept one.

        Raises:
            ValueError: The drone file is not there.
        """
        if not preset.endswith(SUFFIXES):
            return preset
        if not self.drone.exists():
            raise ValueError(f"There is no {self.drone}: copy {preset} there, with which it was trained.")
        return str(self.drone)

    def read_starts(self) -> list[dict[str, Any]]:
        """Return all recorded starts."""
        lines = self.starts.read_text(encoding="utf-8").splitlines(keepends=True) if self.starts.exists() else []
        starts = []
        for line in lines:
            try:
                starts.append(json.loads(line))
            except ValueError:
                if line.endswith("\n"):  # a kill may truncate the last line
                    logger.warning("A line of %s is damaged, and is ignored.", self.starts)
        return starts


def complete_checkpoints(path: str | Path) -> list[Path]:
    """Return the complete checkpoints of a run directory or a folder of checkpoints, newest first, or the one named.

    A checkpoint that was renamed for a replacement that was never completed is included.

    Raises:
        FileNotFoundError: If there is none.
    """
    path = Path(path).absolute()
    if is_complete(path):
        return [path]
    for directory in (path / CHECKPOINTS, path):
        aside = [path for path in directory.glob(f".{PREFIX}-*{REPLACED}") if not original_path(path).exists()]
        candidates = sorted([*directory.glob(f"{PREFIX}-*"), *aside], key=env_steps_of, reverse=True)
        found = [candidate for candidate in candidates if is_complete(candidate)]
        for candidate in candidates:
            if candidate not in found:
                newer = found and env_steps_of(candidate) > env_steps_of(found[0])
                lost = f"; training after {found[0].name} is lost" if newer else ""
                logger.warning("Skipping %s: it is not a complete checkpoint%s.", candidate, lost)
        if found:
            return found
    if (run := RunDirectory(path).run).path != path:
        raise FileNotFoundError(
            f"No complete checkpoint at {path}: the run's first evaluation writes it, and there was none yet. Wait for "
            f"it (evaluation.first=, evaluation.every=), or give {run.path} for its newest checkpoint."
        )
    state = "exists, but holds none" if path.exists() else "does not exist"
    raise FileNotFoundError(
        f"No complete checkpoint at {path}: the path {state}. Give a run directory (with a subfolder "
        f"'{CHECKPOINTS}'), a folder of '{PREFIX}-<env_steps>' folders, or one of these."
    )


def original_path(path: Path) -> Path:
    """Return the path that a checkpoint had before it was renamed for its replacement."""
    return path.with_name(path.name.removeprefix(".").removesuffix(REPLACED))


def env_steps_of(checkpoint: Path) -> int:
    """Return the env_steps in a checkpoint's name; -1 if there are none."""
    number = original_path(checkpoint).name.rpartition("-")[2]
    return int(number) if number.isdecimal() else -1


def latest_checkpoint(path: str | Path) -> Path:
    """Return the newest complete checkpoint; see `complete_checkpoints`."""
    return complete_checkpoints(path)[0]


def replace_text(path: Path, text: str) -> None:
    """Replace a file's text atomically."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def ensure_writable(directory: str | Path, setting_name: str = "run_dir") -> Path:
    """Create a folder if needed, test that it is writable, and return its absolute path.

    Raises:
        PermissionError: It is not; the message advises to choose another by ``setting_name``.
    """
    directory = Path(directory).expanduser().absolute()
    if reason := why_not_writable(directory):
        raise PermissionError(
            f"Cannot write to the folder {directory} ({reason}): choose another with {setting_name}=PATH, or give this "
            "user write permission and free space."
        )
    return directory


def is_complete(path: Path) -> bool:
    """Return whether the manifest, which is written last, exists with every file it lists (a copy may lack some)."""
    if not path.is_dir():
        return False
    try:
        parts = Checkpoint.manifest(path)["components"].values()
    except (CheckpointError, OSError, TypeError, ValueError, AttributeError):  # the last if JSON is no object
        return False
    return all((path / part["path"] / name).is_file() for part in parts for name in part["files"])


def fresh_directory(path: str | Path, result: str) -> Path:
    """Return an empty folder to write to: the given one, or if it is not empty, the first free `<name>_2`, ...

    So results, of which the file ``result`` comes last, are not mixed with those of an earlier, killed or concurrent
    evaluation.
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
    """Lock of an existing run directory, which may have been ``made`` for it, until `release` or the process's end.

    It works across machines if the file system's locks do (NFS 4, Lustre with flock); without any locks it only logs a
    warning.

    Raises:
        ValueError: A live process holds the lock; the message names it.
    """

    def __init__(self, directory: str | Path, made: bool = False) -> None:
        self._directory, self._made = Path(directory), made
        self._file = (self._directory / ".lock").open("a+", encoding="utf-8")
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
            logger.warning("%s cannot be locked (%s): make sure that no other run uses it.", directory, error)
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}")
        self._file.flush()

    def release(self) -> None:
        """Release the lock."""
        self._file.close()

    def abandon(self) -> None:
        """Release the lock, and remove the folder if it was created for this lock and holds nothing else."""
        path = Path(self._file.name)
        with suppress(OSError):  # the folder stays then
            if self._made and list(self._directory.iterdir()) == [path]:
                path.unlink()
                self._directory.rmdir()
        self.release()
