"""Streams of replay records, one per environment: conversion of rollouts, storage, writer and window sampler.

There is one record per observation; its layout is the table of ``docs/api/training.md``. Every environment has one
*stream*, a ring buffer of the newest ``L`` records. The storage is flat, ``slot = stream · L + position``, so that a
write is one indexed copy per key, and a window one gather per key. A window may cross the end of an episode (the RSSM
resets wherever ``is_init``), but never a stream's write head.

Shapes: N streams (= environments), L records per stream, B windows per batch, T records per window or steps per
rollout, M records of one rollout.

Reference: danijar/dreamerv3 (embodied/core/replay.py) for windows over a stream regardless of episode ends.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, TensorStorage
from torchrl.data.replay_buffers import RandomSampler, Storage, Writer

from dreamer_racing.modules.rssm import CONTEXT, LatentFormat

RACE_REWARD_KEYS = ("reward", "reward_base", "body_rate_norm")
"""Keys of a race's reward and of the terms from which `RelabelReward` recomputes it."""
END_KEYS = ("terminated", "truncated")
"""Keys of the flags that end an episode."""


def records_from_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey] = ("pixels",),
    reward_keys: Sequence[str] = RACE_REWARD_KEYS,
    latents: LatentFormat | None = None,
) -> TensorDictBase:
    """Convert a TorchRL collector's rollout to replay records.

    Every transition gives a record of the observation it leads to; every root with ``is_init`` gives another record, of
    the first observation of its episode. An episode of K steps therefore has K + 1 records.

    Args:
        rollout: Batch ``[N, T]`` with root keys ``action``, ``is_init`` and the observations, and ``("next", ...)``
            keys of the observations, the rewards, ``terminated``, ``truncated``.
        observation_keys: Keys of an observation that are stored.
        reward_keys: Keys of rewards that are stored.
        latents: Format in which the policy's latents before a record's observation are stored as its ``context``; None
            stores none.

    Returns:
        Records, batch ``[M]`` with M = N·T + number of first observations: first those of all transitions, then those
        of all first observations. Additional keys, which are not stored, are ``stream`` int64 ``(M,)``, the
        environment, and ``order`` int64 ``(M,)``, the number of these records that precede it in its stream.

    Raises:
        KeyError: If the rollout lacks a key.
        ValueError: If the rollout has no time dimension.
    """
    _check_rollout(rollout, observation_keys, reward_keys, latents)
    steps = rollout.shape[-1]
    flat = rollout.reshape(-1)  # [N·T], environment by environment
    is_init = flat["is_init"].reshape(-1)
    first = is_init.nonzero().squeeze(-1)  # (K,)
    stream = torch.arange(len(flat), device=is_init.device) // steps  # (N·T,)
    # Number of records up to and including each transition's, over all streams, minus those of earlier streams.
    count = (1 + is_init.long()).cumsum(0)
    before = torch.nn.functional.pad(count[steps - 1 :: steps], (1, 0))[stream]  # (N·T,)
    order = count - before - 1

    arrival = flat["next"].select(*observation_keys, *reward_keys, *END_KEYS)
    arrival.update({"previous_action": flat["action"], "is_init": torch.zeros_like(flat["is_init"])})
    arrival.update({"stream": stream, "order": order})
    if latents is not None:
        arrival.set(CONTEXT, latents.pack(flat["next", "belief"], flat["next", "state"]))
    initial = flat.select(*observation_keys)[first]
    zeros = arrival.select("previous_action", *reward_keys, *END_KEYS, CONTEXT, strict=False)[: len(first)]
    initial.update(zeros.apply(torch.zeros_like))
    initial.update({"is_init": flat["is_init"][first], "stream": stream[first], "order": order[first] - 1})
    return torch.cat([arrival, initial])


def _check_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey],
    reward_keys: Sequence[str],
    latents: LatentFormat | None,
) -> None:
    if rollout.ndim < 2:
        raise ValueError(f"Expected a rollout of batch [environments, time], got batch {list(rollout.shape)}.")
    root = [*observation_keys, "action", "is_init"]
    arrived = [*observation_keys, *reward_keys, *END_KEYS, *(("belief", "state") if latents is not None else ())]
    missing = [key for key in root if rollout.get(key, None) is None]
    missing += [("next", key) for key in arrived if rollout["next"].get(key, None) is None]
    if missing:
        raise KeyError(
            f"The rollout lacks {missing}. The replay needs {root} at the root and {arrived} under 'next'; "
            "'is_init' comes from torchrl's InitTracker, the reward terms from DroneRacingEnv."
        )


def _rows(tensor: Tensor) -> Tensor:
    """View records ``(M, ...)`` as rows of 8-byte words ``(M, W)`` if their size is a multiple of 8 bytes.

    Torch indexes element by element, so copying an image as words instead of bytes takes a quarter of the time.
    """
    rows = tensor.as_subclass(Tensor).contiguous().flatten(1)
    return rows.view(torch.int64) if rows.shape[1] * rows.element_size() % 8 == 0 else rows


def check_layout(key: NestedKey, new: Tensor, stored: Tensor) -> None:
    """Raise ``ValueError`` unless new values ``(M, ...)`` have the type and shape of the stored ones ``(N·L, ...)``."""
    layout, expected = ((value.dtype, list(value.shape[1:])) for value in (new, stored))
    if layout != expected:
        raise ValueError(f"The replay stores {key!r} as {expected}, got {layout}.")


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device; copies from the CPU to CUDA are asynchronous, through pinned memory."""
    if device.type == "cuda" and tensor.device.type == "cpu":
        return tensor.contiguous().pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


class RecordStorage(TensorStorage):
    """Storage of records in slots that may be filled in any order; its length is the number of filled slots."""

    _named: Tensor | None = None  # int64 (N·L,), −1 between calls of `_last_of`

    def fields(self) -> Iterator[tuple[NestedKey, Tensor]]:
        """Yield key and values of all slots ``(N·L, ...)`` for each field; nothing before the first write."""
        if self.initialized:
            yield from self._storage.items(include_nested=True, leaves_only=True)

    def set_length(self, filled: int) -> None:
        """Set the number of filled slots."""
        self._len = filled

    def set(self, cursor: Tensor | slice, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Write records ``[M]`` to slots ``(M,)``; the first write allocates the storage."""
        if not self.initialized:
            self._init(data[0])
        self._write(cursor, data, dict(self.fields()))

    def overwrite(self, slots: Tensor, data: TensorDictBase) -> None:
        """Replace some fields of the records in slots ``(M,)`` by data ``[M]``; the last entry of a slot counts."""
        slots = send(slots, self.device)
        data = data[send(self._last_of(slots), data.device or self.device)]
        self._write(slots, data, {key: stored for key, stored in self.fields() if key in data.keys(True, True)})

    def _last_of(self, slots: Tensor) -> Tensor:
        """Return the index of the last occurrence of each slot in ``(M,)``, int64 ``(M,)``, without synchronising."""
        if self._named is None:
            self._named = torch.full((self.max_size,), -1, device=slots.device)
        place = torch.arange(len(slots), device=slots.device)
        last = self._named.scatter_reduce_(0, slots, place, "amax")[slots]
        self._named.index_fill_(0, slots, -1)
        return last

    def _write(self, slots: Tensor | slice, data: TensorDictBase, fields: dict[NestedKey, Tensor]) -> None:
        for key, stored in fields.items():
            new = send(data.get(key), self.device)
            check_layout(key, new, stored)
            if isinstance(slots, slice):
                stored[slots] = new
            else:
                _rows(stored).index_copy_(0, send(slots, self.device), _rows(new))
        self._bump_mutation_revision()

    def get(self, index: Tensor | slice) -> TensorDictBase:
        """Return copies of the records in slots of any shape, or a view of those in a slice."""
        if not isinstance(index, Tensor):
            return self._storage[index]
        index = send(index, self.device)
        out = TensorDict({}, batch_size=index.shape, device=self.device)
        for key, stored in self.fields():
            rows = _rows(stored).index_select(0, index.flatten())
            out.set(key, rows.view(stored.dtype).view(*index.shape, *stored.shape[1:]))
        return out


class StreamTensorStorage(RecordStorage, LazyTensorStorage):
    """Record storage in memory, on any device; allocated at the first write."""


class StreamMemmapStorage(RecordStorage, LazyMemmapStorage):
    """Record storage in memory-mapped files; allocated at the first write."""


class StreamWriter(Writer):
    """Appends records to the ring buffers of their streams.

    Cursors are on the CPU for any storage device, so that sampling needs no device synchronisation.

    Args:
        num_streams: N, the number of environments.
        stream_length: L, records kept of each.

    Attributes:
        cursor: int64 ``(N,)``, the position each stream writes next.
        filled: int64 ``(N,)``, records each stream holds.
    """

    cursor: Tensor
    filled: Tensor
    _storage: RecordStorage
    _write_count: int

    def __init__(self, num_streams: int, stream_length: int) -> None:
        super().__init__()
        self.num_streams = num_streams
        self.stream_length = stream_length
        self._empty()

    def add(self, data: Any) -> int:
        """Raise ``NotImplementedError``, because only whole rollouts can be added."""
        raise NotImplementedError("Only whole rollouts can be added: use extend().")

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write records ``[M]`` of `records_from_rollout`; return their slots, int64 ``(M,)``, on the CPU.

        If a stream receives more than L, the newest L are kept.

        Raises:
            ValueError: If the rollout has another number of environments.
        """
        stream, order = torch.stack([data["stream"], data["order"]]).cpu()
        if (found := int(stream.max()) + 1) != self.num_streams:
            raise ValueError(f"The rollout has {found} environments, the replay was made for {self.num_streams}.")
        count = torch.bincount(stream, minlength=self.num_streams)  # (N,)
        slots = stream * self.stream_length + (self.cursor[stream] + order) % self.stream_length
        kept = order >= (count - self.stream_length)[stream]
        records, written = data.exclude("stream", "order"), slots
        if not kept.all():
            records, written = records[kept.to(data["stream"].device)], slots[kept]
        self._storage.set(written, records, set_cursor=False)
        self.cursor = (self.cursor + count) % self.stream_length
        self.filled = (self.filled + count).clamp(max=self.stream_length)
        self._write_count += len(stream)
        self._storage.set_length(int(self.filled.sum()))
        return slots

    def slots(self, stream: int) -> Tensor:
        """Return the filled slots of one stream, oldest record first, int64 ``(filled,)``."""
        age = torch.arange(int(self.filled[stream])) - self.filled[stream]
        return stream * self.stream_length + (self.cursor[stream] + age) % self.stream_length

    def _empty(self, empty_write_count: bool = True) -> None:
        self.cursor = torch.zeros(self.num_streams, dtype=torch.int64)
        self.filled = torch.zeros(self.num_streams, dtype=torch.int64)
        if empty_write_count:
            self._write_count = 0

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        streams = {"num_streams": self.num_streams, "stream_length": self.stream_length}
        positions = {"cursor": self.cursor.tolist(), "filled": self.filled.tolist()}
        return {**streams, **positions, "write_count": self._write_count}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the cursors; see `check`."""
        self.check(state_dict)
        self.cursor = torch.tensor(state_dict["cursor"], dtype=torch.int64)
        self.filled = torch.tensor(state_dict["filled"], dtype=torch.int64)
        self._write_count = state_dict["write_count"]
        self._storage.set_length(int(self.filled.sum()))

    def check(self, state_dict: dict[str, Any]) -> None:
        """Raise ``ValueError`` unless a saved state has the same number and length of streams."""
        saved = (state_dict["num_streams"], state_dict["stream_length"])
        if saved != (self.num_streams, self.stream_length):
            raise ValueError(
                f"The saved replay has {saved[0]} streams of {saved[1]} records, this one has {self.num_streams} of "
                f"{self.stream_length}: resume with the same number of environments and the same capacity."
            )

    def dumps(self, path: str | Path) -> None:
        """Save the cursors as JSON."""
        Path(path).write_text(json.dumps(self.state_dict()), encoding="utf-8")

    def loads(self, path: str | Path) -> None:
        """Restore the cursors from JSON."""
        self.load_state_dict(json.loads(Path(path).read_text(encoding="utf-8")))


class StreamSampler(RandomSampler):
    """Samples windows of T consecutive records of one stream, uniformly over all such windows or the newest ones.

    Args:
        writer: Writer of the sampled streams.
        batch_length: T.
        recent_share: Share of windows that are drawn from the newest ``recent_length`` records per stream, at least T.
        held_out: Number of last streams that are never sampled.
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
        self.recent_length = max(batch_length, writer.stream_length if recent_length is None else recent_length)
        self._held_out = torch.arange(writer.num_streams) >= writer.num_streams - held_out  # (N,)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Return the slots of ``batch_size`` windows, int64 ``(B, T)`` on the CPU, the recent ones last.

        Raises:
            RuntimeError: If no stream holds T records yet.
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
        """Return the slots of windows in the held-out streams, or None; see `StreamReplay.held_out`."""
        reach = self.writer.filled.masked_fill(~self._held_out, 0)  # (N,)
        reach = reach if recent is None else reach.clamp(max=recent)
        if int(reach.max()) < length:
            return None
        generator = torch.Generator().manual_seed(self.writer._write_count)
        return self._draw(num_windows, length, reach, generator)

    def newest(self, length: int) -> Tensor | None:
        """Return the slots of each stream's newest records, int64 ``(N, length)``, or None if one holds fewer."""
        if int(self.writer.filled.min()) < length:
            return None
        writer = self.writer
        position = (writer.cursor.unsqueeze(-1) + torch.arange(-length, 0)) % writer.stream_length  # (N, length)
        return torch.arange(writer.num_streams).unsqueeze(-1) * writer.stream_length + position

    def _draw(self, count: int, length: int, reach: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw the slots ``(count, length)`` of windows in the newest ``reach`` records ``(N,)`` of the streams."""
        writer = self.writer
        windows = (reach - length + 1).clamp(min=0)  # (N,)
        ends = windows.cumsum(0)  # (N,) number of windows in all streams up to this one
        window = torch.randint(int(ends[-1]), (count,), generator=generator)
        stream = torch.searchsorted(ends, window, right=True)
        start = writer.cursor[stream] - reach[stream] + window - (ends - windows)[stream]
        position = (start.unsqueeze(-1) + torch.arange(length)) % writer.stream_length  # (count, T)
        return stream.unsqueeze(-1) * writer.stream_length + position

    def _sampleable_count(self, storage: Storage, batch_size: int) -> int:
        windows = (self.writer.filled - self.batch_length + 1).clamp(min=0)  # (N,)
        return int(windows.masked_fill(self._held_out, 0).sum())
