"""Checkpoints of a run: crash-safe saving, finding the latest, restoring; and a graceful end on a signal.

A checkpoint is a folder ``<run_dir>/checkpoints/checkpoint-<env_steps>`` in the format of `torchrl.checkpoint`. It is
written beside its final place and renamed into it, so that a folder of that name is always complete; what a killed
process leaves behind has a name with a leading dot, is never read, and is removed by the next run.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Collection, Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    GlobalRNGState,
    StateDictCheckpointAdapter,
)

logger = logging.getLogger(__name__)

CHECKPOINTS = "checkpoints"
_PREFIX = "checkpoint"
FINISHED = "finished.json"


class RandomState(GlobalRNGState):
    """State of the Python, NumPy and torch generators; that of devices absent here is skipped with a warning."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        state = dict(state_dict)
        saved, present = len(state.get("torch_cuda", ())), torch.cuda.device_count()
        if saved and saved != present:
            logger.warning(
                "The checkpoint holds the random state of %d CUDA devices and this machine has %d: it is not restored, "
                "so the run continues with other random numbers.",
                saved,
                present,
            )
            del state["torch_cuda"]
        super().load_state_dict(state)


class CollectorState:
    """What a TorchRL collector carries from rollout to rollout: observations, and the policy's memory.

    Args:
        collector: A ``Collector``, whose environment is saved apart.
    """

    def __init__(self, collector: Any) -> None:
        self._collector = collector

    def state_dict(self) -> dict[str, Any]:
        """Return the step that the next rollout starts from."""
        # Trajectory numbers are counted anew in every process, and nothing reads them.
        return self._collector._carrier.exclude("collector").clone().to_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Start the next rollout from there.

        Raises:
            ValueError: if it is of another number of environments.
        """
        saved, present = len(state_dict["is_init"]), self._collector._carrier.batch_size[0]
        if saved != present:
            raise ValueError(
                f"The checkpoint is of {saved} environments, this run has {present}: set env.num_envs={saved}."
            )
        self._collector._carrier.update(TensorDict(state_dict, self._collector._carrier.batch_size))


class RunCheckpoints:
    """Saves and restores the named parts of a run.

    A part has ``dump(path)``/``load(path)`` (a replay), or ``state_dict()``/``load_state_dict(state)`` of tensors and
    plain Python values (learner, optimiser, curriculum), or is a dictionary of JSON values, restored in place
    (counters). The random state of Python, NumPy and torch is always saved with them, as the part ``random_state``.

    One process at a time may write below a run directory.

    Args:
        run_dir: folder of the run; checkpoints go to its subfolder ``checkpoints``.
        components: the parts by name.
        keep_last: checkpoints kept.

    Example:
        >>> counters = {"env_steps": 0}
        >>> checkpoints = RunCheckpoints("runs/example", {"counters": counters})  # doctest: +SKIP
        >>> checkpoints.save(env_steps=1000)  # doctest: +SKIP
        >>> checkpoints.load()  # doctest: +SKIP
    """

    def __init__(self, run_dir: str | Path, components: Mapping[str, Any], keep_last: int = 2) -> None:
        self.directory = Path(run_dir).absolute() / CHECKPOINTS
        self.components = components
        self._checkpoint = _bind({**components, "random_state": RandomState()})
        self._rotation = CheckpointRotation(self.directory, keep_last=keep_last, prefix=_PREFIX)
        self._last_saved: Path | None = None
        ensure_writable(self.directory)
        _remove_partial(self.directory)

    def save(self, env_steps: int, metadata: Mapping[str, Any] | None = None) -> Path:
        """Saves all parts and removes the oldest checkpoints beyond ``keep_last``.

        Checkpoints of more ``env_steps`` are removed too: they belong to a run that this one, resumed from before
        them, replaces. A second save at the same ``env_steps`` does nothing.

        Args:
            env_steps: control steps summed over environments, which names the checkpoint.
            metadata: JSON values, kept in the manifest.

        Returns:
            The checkpoint's folder.

        Raises:
            CheckpointError: if it cannot be written; the previous checkpoints are untouched.
        """
        final = self.directory / f"{_PREFIX}-{env_steps:012d}"
        if final == self._last_saved:
            return final
        partial = self.directory / f".{final.name}.partial"
        try:
            self._checkpoint.save(partial, metadata={**(metadata or {}), "env_steps": env_steps})
            _check_loadable(partial)
            _sync_tree(partial)
            _publish(partial, final)
        except Exception as error:
            shutil.rmtree(partial, ignore_errors=True)
            raise CheckpointError(
                f"The checkpoint {final} could not be written ({error}). Earlier checkpoints are untouched; check the "
                "free space and the permissions of that folder, then resume."
            ) from error
        self._last_saved = final
        self._remove_later(final)
        self._rotation.prune()
        return final

    def load(
        self,
        path: str | Path | None = None,
        map_location: torch.device | str = "cpu",
        may_lack: Collection[str] = (),
    ) -> dict[str, Any]:
        """Restores all parts.

        Args:
            path: run directory, folder of checkpoints, or one checkpoint; this run's latest if None.
            map_location: device that tensors are read to before the parts copy them to their own.
            may_lack: parts that checkpoints of older versions do not have; they are left as they are.

        Returns:
            The metadata of the checkpoint, with ``env_steps``.

        Raises:
            FileNotFoundError: if there is no complete checkpoint.
            CheckpointError: if a part is missing or does not fit.
        """
        source = latest_checkpoint(self.directory if path is None else path)
        self._last_saved = None
        lacking = set(may_lack) - Checkpoint.manifest(source)["components"].keys()
        if not lacking:
            return _restore(self._checkpoint, source, map_location)
        there = {name: part for name, part in self.components.items() if name not in lacking}
        return _restore(_bind({**there, "random_state": RandomState()}), source, map_location)

    def _remove_later(self, newest: Path) -> None:
        for path in self._rotation.checkpoints():
            if path.name > newest.name:
                logger.warning("Removing %s: the run was resumed from before it.", path)
                tombstone = path.with_name(f".{path.name}.removed")
                shutil.rmtree(tombstone, ignore_errors=True)
                os.replace(path, tombstone)
                shutil.rmtree(tombstone)


class BestCheckpoint:
    """Keeps the parts as they were at the best evaluation so far, below ``<run_dir>/best``.

    Args:
        run_dir: folder of the run.
        components: as of `RunCheckpoints`.

    Attributes:
        score: of the evaluation whose parts are kept; None before the first.
    """

    def __init__(self, run_dir: str | Path, components: Mapping[str, Any]) -> None:
        self.directory = Path(run_dir).absolute() / "best"
        self._checkpoints = RunCheckpoints(self.directory, components, keep_last=1)
        self.score: float | None = None
        with contextlib.suppress(FileNotFoundError):
            self.score = Checkpoint.manifest(latest_checkpoint(self.directory))["metadata"]["score"]

    def offer(self, score: float, env_steps: int) -> bool:
        """Save the parts if the score beats that of the kept ones; return whether it did."""
        if self.score is not None and score <= self.score:
            return False
        # A run that was resumed from before the kept one must not remove what it saves now as the older.
        shutil.rmtree(self._checkpoints.directory, ignore_errors=True)
        self._checkpoints = RunCheckpoints(self.directory, self._checkpoints.components, keep_last=1)
        self._checkpoints.save(env_steps, {"score": score})
        self.score = score
        return True


def load_components(
    path: str | Path, components: Mapping[str, Any], map_location: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Restores some parts of a checkpoint, for example ``{"learner": learner}`` for an evaluation.

    Args:
        path: run directory, folder of checkpoints, or one checkpoint.
        components: the parts by the names they were saved under.
        map_location: as in `RunCheckpoints.load`.

    Returns:
        The metadata of the checkpoint, with ``env_steps``.

    Raises:
        FileNotFoundError: if there is no complete checkpoint.
        CheckpointError: if a part is missing or does not fit.
    """
    return _restore(_bind(components), latest_checkpoint(path), map_location)


def load_state(
    path: str | Path, part: str, map_location: torch.device | str = "cpu"
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads the state of one part of a checkpoint without the part itself.

    Args:
        path: run directory, folder of checkpoints, or one checkpoint.
        part: the name that it was saved under.
        map_location: as in `RunCheckpoints.load`.

    Returns:
        The state, and the metadata of the checkpoint, with ``env_steps``.

    Raises:
        FileNotFoundError: if there is no complete checkpoint.
        CheckpointError: if it has no such part.
    """
    state = _PlainState()
    metadata = load_components(path, {part: state}, map_location)
    return dict(state.value), metadata


class _PlainState:
    """Takes whatever a checkpoint holds of a part."""

    def __init__(self) -> None:
        self.value: Mapping[str, Any] = {}

    def state_dict(self) -> Mapping[str, Any]:
        return self.value

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.value = state


def latest_checkpoint(path: str | Path) -> Path:
    """Finds the newest complete checkpoint. Folders that a killed process left incomplete are passed over.

    Args:
        path: run directory, folder of checkpoints, or one checkpoint.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(path).absolute()
    if _is_complete(path):
        return path
    for directory in (path / CHECKPOINTS, path):
        for candidate in sorted(directory.glob(f"{_PREFIX}-*"), reverse=True):
            if _is_complete(candidate):
                return candidate
            logger.warning("Passing over %s: it is not a complete checkpoint.", candidate)
    found = "exists, but holds none" if path.exists() else "does not exist"
    raise FileNotFoundError(
        f"No complete checkpoint at {path}: the path {found}. Give a run directory (with a subfolder "
        f"'{CHECKPOINTS}'), a folder of '{_PREFIX}-<env_steps>' folders, or one of these."
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


class GracefulExit:
    """Turns SIGINT and SIGTERM into a flag that a loop polls; a second signal raises `KeyboardInterrupt`.

    The handlers from before are put back at exit. Outside the main thread, where Python allows no handlers, the flag
    is never set.

    Example:
        >>> with GracefulExit() as stop:
        ...     while not stop.requested:
        ...         break
    """

    def __init__(self) -> None:
        self.signal_name: str | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has arrived."""
        return self.signal_name is not None

    def __enter__(self) -> GracefulExit:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        # No logging here: the signal may have interrupted a write to the same stream.
        name = signal.Signals(number).name
        if self.requested:
            raise KeyboardInterrupt(f"{name} after {self.signal_name}")
        self.signal_name = name


def _bind(components: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, component in components.items():
        has_state = hasattr(component, "state_dict") and not hasattr(component, "dump")
        # One ordinary file a part: TorchRL's default is a memory map per tensor, thousands of files for an optimiser,
        # and a write to a memory map on a full disk ends the process with a bus error.
        adapter = StateDictCheckpointAdapter(payload_format="torch") if has_state else None
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def _restore(checkpoint: Checkpoint, source: Path, map_location: torch.device | str) -> dict[str, Any]:
    try:
        return checkpoint.load(source, map_location=str(map_location)).manifest["metadata"]
    except CheckpointError as error:
        raise CheckpointError(f"The checkpoint {source} could not be restored. {error}") from error


def _is_complete(path: Path) -> bool:
    """Whether the manifest, which is written last, is there with every file it lists (a copy may have lost some)."""
    if not path.is_dir() or not Checkpoint.is_checkpoint(path):
        return False
    parts = Checkpoint.manifest(path)["components"].values()
    return all((path / part["path"] / name).is_file() for part in parts for name in part["files"])


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


def _publish(partial: Path, final: Path) -> None:
    """Renames into place. A folder cannot be renamed onto another, so an earlier one of that name steps aside."""
    aside = final.with_name(f".{final.name}.replaced")
    if final.exists():
        os.replace(final, aside)
    os.replace(partial, final)
    shutil.rmtree(aside, ignore_errors=True)
    descriptor = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_partial(directory: Path) -> None:
    """Removes what a killed process left; puts back a checkpoint that had stepped aside for one that never came."""
    for path in directory.glob(f".*{_PREFIX}-*"):
        final = path.with_name(path.name.removeprefix(".").removesuffix(".replaced"))
        if path.name.endswith(".replaced") and not final.exists() and _is_complete(path):
            os.replace(path, final)
        else:
            logger.info("Removing the unfinished %s.", path)
            shutil.rmtree(path, ignore_errors=True)
