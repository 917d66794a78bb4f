"""Streams of records, one an environment: how they are made of rollouts, where they lie, which windows are drawn.

A record is of an observation; its layout is the table of ``docs/api/training.md``. Every environment owns one
*stream*, a ring of the newest ``L`` records. The storage is flat, ``slot = stream · L + position``, so that a write
is one indexed copy per key and a window one gather per key. A window may cross the end of an episode (the RSSM resets
wherever ``is_init``) but never a stream's write head.

Shapes: N streams (= environments), L records a stream, B windows a batch, T records a window or steps a rollout, M
records of one rollout.

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
"""The reward of a race and the terms of which `RelabelReward` recomputes it."""
END_KEYS = ("terminated", "truncated")
"""How an episode may end."""


def records_from_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey] = ("pixels",),
    reward_keys: Sequence[str] = RACE_REWARD_KEYS,
    latents: LatentFormat | None = None,
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
        latents: how the policy's latents are kept as each record's ``context``: what it had in mind before it saw the
            record's observation. None: they are not.

    Returns:
        Records, batch ``[M]`` with M = N·T + number of first observations, first all arrivals, then all first
        observations. Beside the record's own keys: ``stream`` int64 ``(M,)``, the environment, and ``order`` int64
        ``(M,)``, how many of these records precede it in its stream. Stored records carry neither.

    Raises:
        KeyError: if the rollout lacks a key.
        ValueError: if the rollout has no time dimension.
    """
    _check_rollout(rollout, observation_keys, reward_keys, latents)
    steps = rollout.shape[-1]
    flat = rollout.reshape(-1)  # [N·T], environment by environment
    is_init = flat["is_init"].reshape(-1)
    first = is_init.nonzero().squeeze(-1)  # (K,)
    stream = torch.arange(len(flat), device=is_init.device) // steps  # (N·T,)
    # Records up to and including each arrival, over all streams, less those of the streams before.
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
    """Views records ``(M, ...)`` as rows of 8-byte words ``(M, W)`` where their size allows it.

    Torch indexes element by element: an image copied as words instead of bytes takes a quarter of the time.
    """
    rows = tensor.as_subclass(Tensor).contiguous().flatten(1)
    return rows.view(torch.int64) if rows.shape[1] * rows.element_size() % 8 == 0 else rows


def check_layout(key: NestedKey, new: Tensor, stored: Tensor) -> None:
    """Refuse values ``(M, ...)`` of another type or shape than those stored ``(N·L, ...)``.

    Raises:
        ValueError: the message gives both.
    """
    layout, expected = ((value.dtype, list(value.shape[1:])) for value in (new, stored))
    if layout != expected:
        raise ValueError(f"The replay stores {key!r} as {expected}, got {layout}.")


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device; what goes to a CUDA device goes from pinned memory, and the CPU does not wait."""
    if device.type == "cuda" and tensor.device.type == "cpu":
        return tensor.contiguous().pin_memory().to(device, non_blocking=True)
    return tensor.to(device)


class RecordStorage(TensorStorage):
    """Indexed copies of whole records, over slots of which any may be filled; its length is how many are."""

    _named: Tensor | None = None  # int64 (N·L,), −1 between calls of `_last_of`

    def fields(self) -> Iterator[tuple[NestedKey, Tensor]]:
        """Yields what a record has: key and values of all slots ``(N·L, ...)``. Nothing before the first write."""
        if self.initialized:
            yield from self._storage.items(include_nested=True, leaves_only=True)

    def set_length(self, filled: int) -> None:
        """Takes note of how many slots are filled."""
        self._len = filled

    def set(self, cursor: Tensor | slice, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Writes records ``[M]`` to slots ``(M,)``; the first write allocates."""
        if not self.initialized:
            self._init(data[0])
        self._write(cursor, data, dict(self.fields()))

    def overwrite(self, slots: Tensor, data: TensorDictBase) -> None:
        """Replaces some fields, data ``[M]``, of the records in slots ``(M,)``; of a slot named twice, by the last."""
        slots = send(slots, self.device)
        data = data[send(self._last_of(slots), data.device or self.device)]
        self._write(slots, data, {key: stored for key, stored in self.fields() if key in data.keys(True, True)})

    def _last_of(self, slots: Tensor) -> Tensor:
        """Return where each of the slots ``(M,)`` is named for the last time, int64 ``(M,)``, without waiting."""
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
        """Returns copies of the records in slots of any shape, or those of a slice themselves."""
        if not isinstance(index, Tensor):
            return self._storage[index]
        index = send(index, self.device)
        out = TensorDict({}, batch_size=index.shape, device=self.device)
        for key, stored in self.fields():
            rows = _rows(stored).index_select(0, index.flatten())
            out.set(key, rows.view(stored.dtype).view(*index.shape, *stored.shape[1:]))
        return out


class StreamTensorStorage(RecordStorage, LazyTensorStorage):
    """Streams in memory, on any device; allocated at the first write."""


class StreamMemmapStorage(RecordStorage, LazyMemmapStorage):
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
    _storage: RecordStorage
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
        self.check(state_dict)
        self.cursor = torch.tensor(state_dict["cursor"], dtype=torch.int64)
        self.filled = torch.tensor(state_dict["filled"], dtype=torch.int64)
        self._write_count = state_dict["write_count"]
        self._storage.set_length(int(self.filled.sum()))

    def check(self, state_dict: dict[str, Any]) -> None:
        """Refuse the state of other streams than this writer's.

        Raises:
            ValueError: the message gives both.
        """
        saved = (state_dict["num_streams"], state_dict["stream_length"])
        if saved != (self.num_streams, self.stream_length):
            raise ValueError(
                f"The saved replay has {saved[0]} streams of {saved[1]} records, this one has {self.num_streams} of "
                f"{self.stream_length}: resume with the same number of environments and the same capacity."
            )

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
        self.recent_length = max(batch_length, writer.stream_length if recent_length is None else recent_length)
        self._held_out = torch.arange(writer.num_streams) >= writer.num_streams - held_out  # (N,)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Returns the slots of ``batch_size`` windows, int64 ``(B, T)`` on the CPU, and which are among the newest.

        The latter as ``{"recent": bool (B, T)}``, which a replay delivers with the records.

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
        is_recent = torch.arange(batch_size) >= batch_size - recent  # (B,)
        return torch.cat(slots), {"recent": is_recent.unsqueeze(-1).expand(-1, self.batch_length)}

    def held_out(self, num_windows: int, length: int, recent: int | None = None) -> Tensor | None:
        """Returns the slots of windows in the streams that are held out, or None; see `StreamReplay.held_out`.

        Which they are depends on what has been written alone: looking more or less often changes nothing.
        """
        reach = self.writer.filled.masked_fill(~self._held_out, 0)  # (N,)
        reach = reach if recent is None else reach.clamp(max=recent)
        if int(reach.max()) < length:
            return None
        generator = torch.Generator().manual_seed(self.writer._write_count)
        return self._draw(num_windows, length, reach, generator)

    def newest(self, length: int) -> Tensor | None:
        """Returns the slots of each stream's newest records, int64 ``(N, length)``, or None if one holds fewer."""
        if int(self.writer.filled.min()) < length:
            return None
        writer = self.writer
        position = (writer.cursor.unsqueeze(-1) + torch.arange(-length, 0)) % writer.stream_length  # (N, length)
        return torch.arange(writer.num_streams).unsqueeze(-1) * writer.stream_length + position

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
