"""Replay of per-environment streams: one record per observation, windows that ignore episode ends.

Every environment owns one *stream*, a ring of the newest ``L`` records. The storage is flat,
``slot = stream · L + position``, so that a write is one indexed copy per key and a window one gather per key.
A window may cross the end of an episode (the RSSM resets wherever ``is_init``) but never a stream's write head.

Shapes: N streams (= environments), L records a stream, B windows a batch, T records a window or steps a rollout,
M records of one rollout. The record layout is the table of ``docs/architecture.md``.

Reference: danijar/dreamerv3 (embodied/core/replay.py) for windows over a stream regardless of episode ends.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import RandomSampler, Storage, Writer
from torchrl.envs.transforms import Transform

RACE_REWARD_KEYS = ("reward", "reward_base", "body_rate_norm")
"""The reward of a race and the terms of which `RelabelReward` recomputes it."""
_END_KEYS = ("terminated", "truncated")


def records_from_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey] = ("pixels",),
    reward_keys: Sequence[str] = RACE_REWARD_KEYS,
) -> TensorDictBase:
    """Converts what a TorchRL collector yields into replay records.

    Every transition gives one record, of the observation it arrived at; every root with ``is_init`` gives one more,
    of the first observation of its episode. An episode of K steps therefore leaves K + 1 records.

    Args:
        rollout: batch ``[N, T]`` (further leading dimensions, as of a multi-process collector, are flattened into N)
            with root keys ``action``, ``is_init`` and the observations, and ``("next", ...)`` keys of the
            observations, the rewards, ``terminated``, ``truncated``.
        observation_keys: what of an observation is kept.
        reward_keys: which rewards are kept.

    Returns:
        Records, batch ``[M]`` with M = N·T + number of first observations, first all arrivals, then all first
        observations. Beside the record's own keys: ``stream`` int64 ``(M,)``, the environment, and ``order`` int64
        ``(M,)``, how many of these records precede it in its stream. Stored records carry neither.

    Raises:
        KeyError: if the rollout lacks a key.
        ValueError: if the rollout has no time dimension.
    """
    _check_rollout(rollout, observation_keys, reward_keys)
    steps = rollout.shape[-1]
    flat = rollout.reshape(-1)  # [N·T], environment by environment
    is_init = flat["is_init"].reshape(-1)
    first = is_init.nonzero().squeeze(-1)  # (K,)
    stream = torch.arange(len(flat), device=is_init.device) // steps  # (N·T,)
    # Records up to and including each arrival, over all streams, less those of the streams before.
    count = (1 + is_init.long()).cumsum(0)
    before = torch.nn.functional.pad(count[steps - 1 :: steps], (1, 0))[stream]  # (N·T,)
    order = count - before - 1

    arrival = flat["next"].select(*observation_keys, *reward_keys, *_END_KEYS)
    arrival.update({"previous_action": flat["action"], "is_init": torch.zeros_like(flat["is_init"])})
    arrival.update({"stream": stream, "order": order})
    initial = flat.select(*observation_keys)[first]
    zeros = arrival.select("previous_action", *reward_keys, *_END_KEYS)[: len(first)]
    initial.update(zeros.apply(torch.zeros_like))
    initial.update({"is_init": flat["is_init"][first], "stream": stream[first], "order": order[first] - 1})
    return torch.cat([arrival, initial])


def _check_rollout(rollout: TensorDictBase, observation_keys: Sequence[NestedKey], reward_keys: Sequence[str]) -> None:
    if rollout.ndim < 2:
        raise ValueError(f"Expected a rollout of batch [environments, time], got batch {list(rollout.shape)}.")
    root = [*observation_keys, "action", "is_init"]
    arrived = [*observation_keys, *reward_keys, *_END_KEYS]
    missing = [key for key in root if rollout.get(key, None) is None]
    missing += [("next", key) for key in arrived if rollout["next"].get(key, None) is None]
    if missing:
        raise KeyError(
            f"The rollout lacks {missing}. The replay needs {root} at the root and {arrived} under 'next'; "
            "'is_init' comes from torchrl's InitTracker, the reward terms from DroneRacingEnv."
        )


def _rows(tensor: Tensor) -> Tensor:
    """Views records ``(M, ...)`` as rows of 8-byte words ``(M, W)`` where their size allows it.

    Torch indexes element by element: an image copied as words instead of bytes takes a quarter of the time.
    """
    rows = tensor.as_subclass(Tensor).contiguous().flatten(1)
    return rows.view(torch.int64) if rows.shape[1] * rows.element_size() % 8 == 0 else rows


def _check_layout(key: NestedKey, new: Tensor, stored: Tensor) -> None:
    layout, expected = ((value.dtype, list(value.shape[1:])) for value in (new, stored))
    if layout != expected:
        raise ValueError(f"The replay stores {key!r} as {expected}, got {layout}.")


class _RecordAccess(TensorStorage):
    """Indexed copies of whole records, over slots of which any may be filled; its length is how many are."""

    def fields(self) -> Iterator[tuple[NestedKey, Tensor]]:
        """Yields what a record has: key and values of all slots ``(N·L, ...)``. Nothing before the first write."""
        if self.initialized:
            yield from self._storage.items(include_nested=True, leaves_only=True)

    def set_length(self, filled: int) -> None:
        self._len = filled

    def set(self, cursor: Tensor | slice, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        if not self.initialized:
            self._init(data[0])
        for key, stored in self.fields():
            new = data.get(key).to(self.device, non_blocking=True)
            _check_layout(key, new, stored)
            if isinstance(cursor, slice):
                stored[cursor] = new
            else:
                _rows(stored).index_copy_(0, cursor.to(self.device), _rows(new))
        self._bump_mutation_revision()

    def get(self, index: Tensor | slice) -> TensorDictBase:
        if not isinstance(index, Tensor):
            return self._storage[index]
        index = index.to(self.device)
        out = TensorDict({}, batch_size=index.shape, device=self.device)
        for key, stored in self.fields():
            rows = _rows(stored).index_select(0, index.flatten())
            out.set(key, rows.view(stored.dtype).view(*index.shape, *stored.shape[1:]))
        return out


class StreamTensorStorage(_RecordAccess, LazyTensorStorage):
    """Streams in memory, on any device; allocated at the first write."""


class StreamMemmapStorage(_RecordAccess, LazyMemmapStorage):
    """Streams in memory-mapped files; allocated at the first write."""


class StreamWriter(Writer):
    """Appends records to the ring of the stream that each belongs to.

    The bookkeeping is on the CPU whatever the storage's device: sampling then needs no device synchronisation.

    Args:
        num_streams: N, the number of environments.
        stream_length: L, records kept of each.

    Attributes:
        cursor: int64 ``(N,)``, the position each stream writes next.
        filled: int64 ``(N,)``, records each stream holds.
    """

    cursor: Tensor
    filled: Tensor
    _storage: _RecordAccess
    _write_count: int

    def __init__(self, num_streams: int, stream_length: int) -> None:
        super().__init__()
        self.num_streams = num_streams
        self.stream_length = stream_length
        self._empty()

    def add(self, data: Any) -> int:
        """Refuse single records."""
        raise NotImplementedError("Streams grow by whole rollouts: use extend().")

    def extend(self, data: TensorDictBase) -> Tensor:
        """Writes records with one indexed copy per key.

        Args:
            data: records ``[M]`` of `records_from_rollout`. Of a stream that receives more than L, the newest L stay.

        Returns:
            Slots, int64 ``(M,)``, on the CPU.

        Raises:
            ValueError: if the rollout is of another number of environments.
        """
        stream, order = torch.stack([data["stream"], data["order"]]).cpu()
        if (found := int(stream.max()) + 1) != self.num_streams:
            raise ValueError(f"The rollout is of {found} environments, the replay was made for {self.num_streams}.")
        count = torch.bincount(stream, minlength=self.num_streams)  # (N,)
        slots = stream * self.stream_length + (self.cursor[stream] + order) % self.stream_length
        kept = order >= (count - self.stream_length)[stream]
        records = data.exclude("stream", "order")
        if kept.all():
            self._storage.set(slots, records, set_cursor=False)
        else:
            self._storage.set(slots[kept], records[kept.to(data["stream"].device)], set_cursor=False)
        self.cursor = (self.cursor + count) % self.stream_length
        self.filled = (self.filled + count).clamp(max=self.stream_length)
        self._write_count += len(stream)
        self._storage.set_length(int(self.filled.sum()))
        return slots

    def slots(self, stream: int) -> Tensor:
        """Returns the filled slots of one stream, oldest record first, int64 ``(filled,)``."""
        age = torch.arange(int(self.filled[stream])) - self.filled[stream]
        return stream * self.stream_length + (self.cursor[stream] + age) % self.stream_length

    def _empty(self, empty_write_count: bool = True) -> None:
        self.cursor = torch.zeros(self.num_streams, dtype=torch.int64)
        self.filled = torch.zeros(self.num_streams, dtype=torch.int64)
        if empty_write_count:
            self._write_count = 0

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {
            "num_streams": self.num_streams,
            "stream_length": self.stream_length,
            "cursor": self.cursor.tolist(),
            "filled": self.filled.tolist(),
            "write_count": self._write_count,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the cursors.

        Raises:
            ValueError: if the state is of other streams than this writer's.
        """
        saved = (state_dict["num_streams"], state_dict["stream_length"])
        if saved != (self.num_streams, self.stream_length):
            raise ValueError(
                f"The saved replay has {saved[0]} streams of {saved[1]} records, this one has {self.num_streams} of "
                f"{self.stream_length}: resume with the same number of environments and the same capacity."
            )
        self.cursor = torch.tensor(state_dict["cursor"], dtype=torch.int64)
        self.filled = torch.tensor(state_dict["filled"], dtype=torch.int64)
        self._write_count = state_dict["write_count"]
        self._storage.set_length(int(self.filled.sum()))

    def dumps(self, path: str | Path) -> None:
        """Save the bookkeeping as JSON."""
        Path(path).write_text(json.dumps(self.state_dict()), encoding="utf-8")

    def loads(self, path: str | Path) -> None:
        """Restore the bookkeeping from JSON."""
        self.load_state_dict(json.loads(Path(path).read_text(encoding="utf-8")))


class StreamSampler(RandomSampler):
    """Draws windows of T consecutive records inside one stream, uniformly over all such windows or the newest of them.

    Args:
        writer: whose streams are sampled.
        batch_length: T.
        recent_share: share of a batch's windows that lie in the newest records of their streams.
        recent_length: how many records of each stream those are, at least T.
        held_out: the last streams are never sampled.
    """

    def __init__(
        self,
        writer: StreamWriter,
        batch_length: int,
        recent_share: float = 0.0,
        recent_length: int | None = None,
        held_out: int = 0,
    ) -> None:
        super().__init__()
        self.writer = writer
        self.batch_length = batch_length
        self.recent_share = recent_share
        self.recent_length = max(batch_length, recent_length or writer.stream_length)
        self._held_out = torch.arange(writer.num_streams) >= writer.num_streams - held_out  # (N,)
        self._held_out_rng = torch.Generator().manual_seed(0)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Returns the slots of ``batch_size`` windows, int64 ``(B, T)`` on the CPU, and an empty dictionary.

        Raises:
            RuntimeError: if no stream holds T records yet.
        """
        filled = self.writer.filled.masked_fill(self._held_out, 0)  # (N,)
        if not self._sampleable_count(storage, batch_size):
            raise RuntimeError(
                f"The replay cannot be sampled yet: a window needs batch_length={self.batch_length} consecutive "
                f"records and the longest stream holds {int(filled.max())}. Collect more steps before the first update."
            )
        recent = round(self.recent_share * batch_size)
        slots = [self._draw(batch_size - recent, self.batch_length, filled, self._rng)]
        if recent:
            slots.append(self._draw(recent, self.batch_length, filled.clamp(max=self.recent_length), self._rng))
        return torch.cat(slots), {}

    def held_out(self, num_windows: int, length: int, recent: int | None = None) -> Tensor | None:
        """Returns the slots of windows in the streams that are held out, or None; see `StreamReplay.held_out`."""
        reach = self.writer.filled.masked_fill(~self._held_out, 0)  # (N,)
        reach = reach if recent is None else reach.clamp(max=recent)
        if int(reach.max()) < length:
            return None
        return self._draw(num_windows, length, reach, self._held_out_rng)

    def _draw(self, count: int, length: int, reach: Tensor, generator: torch.Generator | None) -> Tensor:
        """Slots ``(count, length)`` of windows in the newest ``reach`` records ``(N,)`` of the streams."""
        writer = self.writer
        windows = (reach - length + 1).clamp(min=0)  # (N,)
        ends = windows.cumsum(0)  # (N,) windows in the streams up to each
        window = torch.randint(int(ends[-1]), (count,), generator=generator)
        stream = torch.searchsorted(ends, window, right=True)
        start = writer.cursor[stream] - reach[stream] + window - (ends - windows)[stream]
        position = (start.unsqueeze(-1) + torch.arange(length)) % writer.stream_length  # (count, T)
        return stream.unsqueeze(-1) * writer.stream_length + position

    def _sampleable_count(self, storage: Storage, batch_size: int) -> int:
        windows = (self.writer.filled - self.batch_length + 1).clamp(min=0)  # (N,)
        return int(windows.masked_fill(self._held_out, 0).sum())


class StreamReplay(TensorDictReplayBuffer):
    """TorchRL replay buffer over streams; build it with `make_replay`.

    ``len(replay)`` is the number of records held; a collector may be given it as its ``replay_buffer``.

    Args:
        observation_keys: what of an observation is kept.
        reward_keys: which rewards are kept.
        **kwargs: of `TensorDictReplayBuffer`.
    """

    _storage: _RecordAccess
    _writer: StreamWriter
    _sampler: StreamSampler
    _rng: torch.Generator

    def __init__(
        self,
        *,
        observation_keys: Sequence[NestedKey] = ("pixels",),
        reward_keys: Sequence[str] = RACE_REWARD_KEYS,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.observation_keys = tuple(observation_keys)
        self.reward_keys = tuple(reward_keys)

    def extend(self, rollout: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Appends a collector's rollout ``[N, T]``; see `records_from_rollout`. Returns the slots, int64 ``(M,)``."""
        records = records_from_rollout(rollout, self.observation_keys, self.reward_keys)
        return super().extend(records, update_priority=update_priority)

    def held_out(self, num_windows: int, length: int, recent: int | None = None) -> TensorDictBase | None:
        """Returns windows ``[num_windows, length]`` of records that are never sampled, delivered as samples are.

        They are drawn from the newest ``recent`` records of the streams that are held out, with a generator of their
        own. None if there are no such streams, or if those are too short yet.
        """
        slots = self._sampler.held_out(num_windows, length, recent)
        if slots is None:
            return None
        records = self._storage.get(slots)
        return self._transform(records) if self._transform is not None and len(self._transform) else records

    def records(self, stream: int) -> TensorDictBase:
        """Returns all records of one stream, oldest first, untransformed, batch ``[filled]``."""
        return self._storage.get(self._writer.slots(stream))

    def dumps(self, path: str | Path) -> None:
        """Saves the filled part of every stream, the cursors and the random generator into a folder.

        Plain files are written, not memory maps: on a full disk a map ends the process with a bus error.
        """
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        fields = []
        for number, (key, stored) in enumerate(self._storage.fields() if len(self) else ()):
            fields.append({"key": key, "shape": list(stored.shape[1:]), "dtype": str(stored.dtype)})
            with (path / f"{number}.bin").open("wb") as file:
                for part in self._filled():
                    file.write(stored[part].cpu().contiguous().view(torch.uint8).numpy().data)
        state = {"streams": self._writer.state_dict(), "fields": fields, "generator": self._rng.get_state().tolist()}
        (path / "replay.json").write_text(json.dumps(state), encoding="utf-8")

    def loads(self, path: str | Path) -> None:
        """Restores what `dumps` saved.

        Raises:
            ValueError: if the saved streams or records do not have this replay's shape.
        """
        path = Path(path)
        state = json.loads((path / "replay.json").read_text(encoding="utf-8"))
        saved = self._open_fields(path, state["fields"], sum(state["streams"]["filled"]))
        self._writer.load_state_dict(state["streams"])
        start = 0
        for part in self._filled():
            count = part.stop - part.start
            self._storage.set(part, saved[start : start + count], set_cursor=False)
            start += count
        self._rng.set_state(torch.tensor(state["generator"], dtype=torch.uint8))

    def _filled(self) -> list[slice]:
        """The filled slots of each stream: a ring that is not full has never wrapped."""
        starts = range(0, self._storage.max_size, self._writer.stream_length)
        pairs = zip(starts, self._writer.filled.tolist(), strict=True)
        return [slice(start, start + count) for start, count in pairs if count]

    def _open_fields(self, path: Path, fields: list[dict[str, Any]], count: int) -> TensorDictBase:
        saved = TensorDict({}, batch_size=[count])
        for number, field in enumerate(fields):
            key = field["key"] if isinstance(field["key"], str) else tuple(field["key"])
            dtype = getattr(torch, field["dtype"].removeprefix("torch."))
            size = count * math.prod(field["shape"])
            values = torch.from_file(str(path / f"{number}.bin"), shared=False, size=size, dtype=dtype)
            saved.set(key, values.view(count, *field["shape"]))
        for key, stored in self._storage.fields() if fields else ():
            _check_layout(key, saved.get(key), stored)
        return saved


def replay_bytes(
    capacity: int, image_shape: Sequence[int] = (64, 64, 3), action_size: int = 4, numbers: int = 0
) -> int:
    """Returns the size in bytes of a replay of ``capacity`` records (12.3 KB each at 64×64).

    Args:
        capacity: records.
        image_shape: of ``pixels``.
        action_size: A.
        numbers: float32 observed beside the image: ``vector`` and the privileged one.
    """
    flags = 1 + len(_END_KEYS)
    return capacity * (math.prod(image_shape) + 4 * (action_size + len(RACE_REWARD_KEYS) + numbers) + flags)


def make_replay(
    capacity: int,
    num_envs: int,
    batch_size: int,
    batch_length: int,
    device: torch.device | str = "cpu",
    *,
    storage: Literal["tensor", "memmap"] = "tensor",
    storage_device: torch.device | str | None = None,
    scratch_dir: str | Path | None = None,
    seed: int = 0,
    transform: Transform | None = None,
    observation_keys: Sequence[NestedKey] = ("pixels",),
    reward_keys: Sequence[str] = RACE_REWARD_KEYS,
    recent_share: float = 0.0,
    recent_records: int | None = None,
    held_out: int = 0,
    prefetch: int | None = None,
) -> StreamReplay:
    """Builds the replay of N streams.

    Args:
        capacity: records in all; each stream keeps ``capacity // num_envs``.
        num_envs: N.
        batch_size: B, windows a sample (not records, unlike TorchRL's `SliceSampler`).
        batch_length: T, records a window.
        device: where samples are delivered.
        storage: ``"tensor"`` keeps records in memory, ``"memmap"`` in files below ``scratch_dir``.
        storage_device: where ``"tensor"`` keeps them; ``device`` if None.
        scratch_dir: folder of ``"memmap"``, overwritten; a temporary one, removed at exit, if None.
        seed: of the sampler's own generator.
        transform: applied to samples, for example `RelabelReward`.
        observation_keys: what of an observation is kept.
        reward_keys: which rewards are kept.
        recent_share: share of a sample's windows drawn from the newest records, so that the model soon knows where the
            policy has come to; the others are drawn from all. Reference: danijar/dreamerv3, ``replay.fracs.recency``.
        recent_records: how many records in all those are; all if None.
        held_out: the last streams are kept out of samples, for `StreamReplay.held_out`.
        prefetch: samples drawn ahead in threads, which hides the transfer to ``device``; they may lack the newest
            records, and a restored replay then does not continue the same samples.

    Raises:
        ValueError: if a stream could not hold one window, ``recent_share`` is not a share, or all streams are held out.

    Example:
        >>> replay = make_replay(capacity=100_000, num_envs=16, batch_size=16, batch_length=64)
        >>> replay.batch_size, len(replay)
        (16, 0)
    """
    if not 0.0 <= recent_share <= 1.0:
        raise ValueError(f"recent_share={recent_share}: a share lies between 0 and 1.")
    if not 0 <= held_out < num_envs:
        raise ValueError(f"held_out={held_out} of num_envs={num_envs} streams: at least one must be left to sample.")
    stream_length = capacity // num_envs
    if stream_length < batch_length:
        raise ValueError(
            f"capacity={capacity} gives each of num_envs={num_envs} streams {stream_length} records, less than one "
            f"window of batch_length={batch_length}: the capacity must be at least {num_envs * batch_length}."
        )
    slots = stream_length * num_envs
    if storage == "memmap":
        records = StreamMemmapStorage(slots, scratch_dir=scratch_dir, existsok=True)
    else:
        records = StreamTensorStorage(slots, device=storage_device or device)
    writer = StreamWriter(num_envs, stream_length)
    replay = StreamReplay(
        storage=records,
        writer=writer,
        sampler=StreamSampler(
            writer, batch_length, recent_share, recent_records and recent_records // num_envs, held_out
        ),
        generator=torch.Generator().manual_seed(seed),
        transform=transform,
        batch_size=batch_size,
        observation_keys=observation_keys,
        reward_keys=reward_keys,
        prefetch=prefetch,
        # Copies from pinned memory do not wait for the device.
        pin_memory=torch.device(device).type == "cuda" and records.device.type == "cpu",
    )
    if records.device != torch.empty((), device=device).device:
        replay.append_transform(lambda sample: sample.to(device, non_blocking=True))
    return replay
