"""Checkpoints of a run: crash-safe saving and restoring of folders in the format of `torchrl.checkpoint`.

If several processes train together (`parallel`), a checkpoint holds the state of all of them: rank 0 writes its parts
as a single process does, and each other process writes its own parts (environments, replay, random state) below
``process-<n>``. Any number of processes can restore it: all read the shared parts; each reads its own ones if their
number is as before, else the replay streams are redistributed, and the other own parts start afresh.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState, StateDictCheckpointAdapter

from dreamer_racing import parallel
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, setting
from dreamer_racing.training.directory import (
    PREFIX,
    PROCESS,
    PROCESSES,
    REPLACED,
    RunDirectory,
    complete_checkpoints,
    ensure_writable,
    is_complete,
)
from dreamer_racing.training.publishing import damage_of, publish, remove, remove_unfinished

logger = logging.getLogger(__name__)


@dataclass
class CheckpointConfig:
    """Checkpoints during training."""

    every: int = setting(50_000, NOT_NEGATIVE)  # env_steps between checkpoints
    # minutes of wall-clock time between checkpoints, for preemptible machines; 0: only one soon after each start
    minutes: float = setting(0.0, NOT_NEGATIVE)
    keep: int = setting(2, COUNT)  # number of newest checkpoints kept

    def disk_needed(self, replay: int, directory: RunDirectory) -> str:
        """Return a line on the peak disk use of checkpoints with a replay of so many bytes, and on the free space."""
        there = sum(file.stat().st_size for file in directory.checkpoints.rglob("*") if file.is_file())
        peak, free = (self.keep + 1) * replay, shutil.disk_usage(directory.path).free + there
        line = (
            f"disk: at most {peak / 1e9:.1f} GB for the replay in checkpoint.keep={self.keep} checkpoints and the one "
            f"being written, about a seventh of that for images of races; {free / 1e9:.1f} GB free"
        )
        advice = "lower checkpoint.keep= or replay.capacity=, or choose another run_dir=; else saving may fail"
        return f"{line}: MAY NOT BE ENOUGH, {advice}" if peak > free else line


class RunCheckpointError(CheckpointError, ValueError):
    """Raised if a checkpoint cannot be written or restored; the message says what to do."""


class RandomState(GlobalRNGState):
    """State of the Python, NumPy and torch generators; CUDA's is skipped if the number of devices differs."""

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


class RunCheckpoints:
    """Saves and restores the named parts of a run.

    A part has ``dump(path)``/``load(path)`` (a replay), or ``state_dict()``/``load_state_dict(state)`` of tensors and
    plain Python values (learner, optimiser, curriculum), or is a dictionary of JSON values, restored in place
    (counters). The random state of Python, NumPy and torch is always saved, too, as the part ``random_state``.

    Args:
        run_dir: Folder of the run; checkpoints go to ``checkpoints/checkpoint-<env_steps>`` below it.
        components: Parts by name.
        keep_last: Number of checkpoints kept.
        own: Names of the parts that differ between processes, besides the random state; if there are any, all processes
            must save and load together. If empty, rank 0 saves alone.

    Example:
        >>> counters = {"env_steps": 0}
        >>> checkpoints = RunCheckpoints("runs/example", {"counters": counters})  # doctest: +SKIP
        >>> checkpoints.save(env_steps=1000)  # doctest: +SKIP
        >>> checkpoints.load()  # doctest: +SKIP
    """

    def __init__(
        self, run_dir: str | Path, components: Mapping[str, Any], keep_last: int = 2, own: Collection[str] = ()
    ) -> None:
        self.directory = RunDirectory(Path(run_dir).absolute()).checkpoints
        self.components = components
        self._own_names = frozenset(own)  # also of parts that only other processes have
        self._own = {name: components[name] for name in own if name in components}
        self._checkpoint = _bind({**components, "random_state": RandomState()})
        self._keep_last = keep_last
        self._last_saved: Path | None = None
        if parallel.is_first():
            ensure_writable(self.directory)
            remove_unfinished(self.directory)

    def save(self, env_steps: int, metadata: Mapping[str, Any] | None = None) -> Path:
        """Save all parts with JSON ``metadata``, remove the oldest checkpoints beyond ``keep_last``, return the folder.

        Checkpoints with more ``env_steps`` are removed, too: they belong to the run that this one replaces, because it
        was resumed from an earlier checkpoint. A second save at the same ``env_steps`` does nothing.

        Raises:
            RunCheckpointError: if it cannot be written; the previous checkpoints are untouched.
        """
        final = self.directory / f"{PREFIX}-{env_steps:012d}"
        if final == self._last_saved:
            return final
        partial = self.directory / f".{final.name}.partial"
        processes = {PROCESSES: parallel.num_processes()} if self._own and parallel.num_processes() > 1 else {}
        about = {**(metadata or {}), "env_steps": env_steps, **processes}
        first = parallel.is_first()
        own = _bind({**self._own, "random_state": RandomState()})
        try:
            self._step(lambda: self._checkpoint.save(partial, metadata=about), of_this_process=first)
            self._step(lambda: own.save(partial / f"{PROCESS}{parallel.rank()}"), of_this_process=not first)
            self._step(lambda: publish(partial, final), of_this_process=first)
        except Exception as error:
            if first:
                shutil.rmtree(partial, ignore_errors=True)
            raise RunCheckpointError(
                f"The checkpoint {final} could not be written ({error}). Earlier checkpoints are untouched; check the "
                "free space and the permissions of that folder, then resume."
            ) from error
        self._last_saved = final
        if first:
            try:
                self._remove_obsolete(final)
            except OSError as error:  # the checkpoint itself is complete
                logger.warning("Obsolete checkpoints beside %s could not be removed: %s.", final.name, error)
        return final

    def _step(self, action: Callable[[], object], of_this_process: bool) -> None:
        """Run a step of a save if it is this process's; if all save together, wait for the others."""
        action = action if of_this_process else lambda: None
        if self._own:
            parallel.run_in_all(action)
        else:
            action()

    def load(self, path: str | Path | None = None, may_lack: Collection[str] = ()) -> dict[str, Any]:
        """Restore all parts; return the metadata of the checkpoint, with ``env_steps``.

        If a checkpoint is damaged, the one before it is restored; what is lost is logged.

        Args:
            path: Run directory, folder of checkpoints, or one checkpoint; this run's latest if None.
            may_lack: Parts that the checkpoint may lack; they are left as they are then.

        Raises:
            FileNotFoundError: if there is no complete checkpoint.
            RunCheckpointError: if all are damaged, or a part is missing or does not fit.
        """
        self._last_saved = None
        path = self.directory if path is None else path
        parts = {**self.components, "random_state": RandomState()}
        if not self._own:
            return load_components(path, parts, may_lack)
        found = str(newest_sound(path, {*parts, *self._own_names})) if parallel.is_first() else ""
        source = Path(parallel.broadcast(found))
        metadata = Checkpoint.manifest(source)["metadata"]
        own = {name: part for name, part in parts.items() if name in self._own or name == "random_state"}
        same_number = (saved := metadata.get(PROCESSES, 1)) == parallel.num_processes()
        if same_number and parallel.is_first():
            return _restore(source, parts, may_lack)
        _restore(source, {name: part for name, part in parts.items() if name not in own}, may_lack)
        if same_number:
            _restore(source / f"{PROCESS}{parallel.rank()}", own)
        else:
            self._redistribute(source, saved)
        return metadata

    def _redistribute(self, source: Path, saved: int) -> None:
        """Redistribute replay streams by descending rank, so that rank 0 gets the last ones, which may be held out."""
        for name, part in self._own.items():
            if not hasattr(part, "load_shards"):
                continue
            folders = [source / f"{PROCESS}{rank}" if rank else source for rank in reversed(range(saved))]
            paths = [folder / Checkpoint.manifest(folder)["components"][name]["path"] for folder in folders]
            try:
                part.load_shards(paths, skip=(parallel.num_processes() - 1 - parallel.rank()) * part.num_streams)
            except (OSError, ValueError) as error:
                raise RunCheckpointError(f"The checkpoint {source} could not be restored. {error}") from error
        logger.info(
            "%s was saved by another number of processes (%d there, %d here): its replay is redistributed. Episodes, "
            "random numbers and the collection of steps for the next policy update start again.",
            source.name,
            saved,
            parallel.num_processes(),
        )

    def _remove_obsolete(self, newest: Path) -> None:
        """Remove the complete checkpoints after the newest one, and the oldest before it beyond ``keep_last``."""
        complete = [path for path in sorted(self.directory.glob(f"{PREFIX}-*")) if is_complete(path)]
        kept = [path for path in complete if path.name <= newest.name]
        for path in complete[len(kept) :]:
            logger.warning("Removing %s: the run was resumed from an earlier checkpoint.", path)
            remove(path)
        for path in kept[: -self._keep_last]:
            remove(path)


class BestCheckpoint:
    """Keeps the parts as they were at the best evaluation so far, in ``<run_dir>/best``; its ``score`` is None before.

    A best checkpoint of more ``env_steps`` than those at which the run starts or resumes belongs to a part of the run
    that is now repeated: it is moved to ``<run_dir>/best.replaced``.
    """

    def __init__(self, run_dir: str | Path, components: Mapping[str, Any], env_steps: int) -> None:
        self.directory = RunDirectory(Path(run_dir).absolute()).best.path
        self.score: float | None = None
        if parallel.is_first():  # only rank 0 calls `offer` and writes there
            self._find(env_steps)
        self._checkpoints = RunCheckpoints(self.directory, components, keep_last=1)

    def _find(self, env_steps: int) -> None:
        """Read the score of an existing best checkpoint, or move that away if it has later env_steps."""
        try:
            kept = Checkpoint.manifest(newest_sound(self.directory))["metadata"]
        except (FileNotFoundError, RunCheckpointError):  # the next evaluation replaces a damaged one
            return
        if kept["env_steps"] <= env_steps:
            self.score = kept["score"]
            return
        aside = self.directory.with_name(self.directory.name + REPLACED)
        shutil.rmtree(aside, ignore_errors=True)
        self.directory.rename(aside)
        logger.warning(
            "the best policy so far, of %s env_steps, is later than the resumed checkpoint: it was moved to %s",
            f"{kept['env_steps']:,}",
            aside,
        )

    def offer(self, score: float, env_steps: int) -> bool:
        """Save the parts if the score is higher than that of the kept ones; return whether it was."""
        if self.score is not None and score <= self.score:
            return False
        self._checkpoints.save(env_steps, {"score": score})  # afterwards removes the previous one
        self.score = score
        return True


def load_components(path: str | Path, components: Mapping[str, Any], may_lack: Collection[str] = ()) -> dict[str, Any]:
    """Restore some parts of a checkpoint, for example ``{"learner": learner}``, as `RunCheckpoints.load` does."""
    return _restore(newest_sound(path, components), components, may_lack)


def newest_sound(path: str | Path, parts: Collection[str] | None = None) -> Path:
    """Return the newest complete checkpoint with correct checksums; log which ones are skipped, and why.

    Args:
        path: Run directory, folder of checkpoints, or one checkpoint.
        parts: Names of the parts to check; None for all.

    Raises:
        FileNotFoundError: if there is no complete checkpoint.
        RunCheckpointError: if all are damaged.
    """
    damaged: dict[str, str] = {}  # description of the damage by checkpoint
    for candidate in complete_checkpoints(path):
        damage = damage_of(candidate, parts)
        if damage is None:
            if damaged:
                found = ". ".join(damaged.values())
                logger.warning("%s. Continuing from %s; later training is lost.", found, candidate.name)
            return candidate
        damaged[candidate.name] = f"{candidate} is damaged: {damage}"
    others = [other.name for other in complete_checkpoints(candidate.parent) if other.name not in damaged]
    advice = f"there are others beside it: {', '.join(others)}" if others else "there is no other beside it"
    raise RunCheckpointError(f"{'. '.join(damaged.values())}. It was not read; {advice}.")


class SavedState:
    """Part of a checkpoint that is only read: ``state`` is what was saved, once it is loaded."""

    state: dict[str, Any]

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: it is never saved."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Keep what was saved."""
        self.state = dict(state)


def load_state(path: str | Path, part: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the saved state of one part of a checkpoint, and the checkpoint's metadata with ``env_steps``.

    Raises:
        FileNotFoundError: if there is no complete checkpoint.
        RunCheckpointError: if it has no such part, or all are damaged.
    """
    saved = SavedState()
    metadata = load_components(path, {part: saved})
    return saved.state, metadata


def _bind(components: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, component in components.items():
        has_state = hasattr(component, "state_dict") and not hasattr(component, "dump")
        # One ordinary file per part: TorchRL's default is a memory map per tensor, thousands of files for an optimiser,
        # and a write to a memory map on a full disk kills the process with a bus error.
        adapter = StateDictCheckpointAdapter(payload_format="torch") if has_state else None
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def _restore(source: Path, components: Mapping[str, Any], may_lack: Collection[str] = ()) -> dict[str, Any]:
    """Restore some parts of a checkpoint, or of one process's folder in it, whose checksums were compared before."""
    lacking = set(may_lack) - Checkpoint.manifest(source)["components"].keys()
    there = {name: part for name, part in components.items() if name not in lacking}
    try:
        return _bind(there).load(source, map_location="cpu").manifest["metadata"]
    except CheckpointError as error:
        # torch's own message advises to load the file without its safeguard
        reason = "One of its files does not contain a saved state." if "weights_only" in str(error) else error
        raise RunCheckpointError(f"The checkpoint {source} could not be restored. {reason}") from error
