"""Replay buffer of a collector's rollouts: sampling of windows, and checkpoints.

Records are stored in one stream per environment (`dreamer_racing.experience.streams`).

Shapes: N streams (= environments), L records per stream, B windows per batch, T records per window or steps per
rollout, M records of one rollout.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import torch
import zstandard
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.transforms import Transform

from dreamer_racing.experience.streams import (
    RACE_REWARD_KEYS,
    RecordStorage,
    StreamMemmapStorage,
    StreamSampler,
    StreamTensorStorage,
    StreamWriter,
    check_layout,
    records_from_rollout,
    send,
)
from dreamer_racing.modules.rssm import CONTEXT, LatentFormat
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, SHARE, setting

_FIELD = "{}.zst"


class Storage(Enum):
    """Where replay records are stored."""

    tensor = "tensor"
    memmap = "memmap"


@dataclass
class ReplayConfig:
    """The replay buffer."""

    capacity: int = setting(250_000, COUNT)  # records, of 12.3 KB each at image_size 64
    storage: Storage = Storage.tensor  # tensor (memory) | memmap (files)
    device: str = "auto"  # for storage=tensor; auto: the learner's device if it has room, else cpu


@dataclass
class SequenceReplayConfig(ReplayConfig):
    """The replay buffer of a world model."""

    # environments whose records are never trained on, to evaluate the model; null: 1 if there are at least 4
    held_out: int | None = setting(None, NOT_NEGATIVE)
    recent_share: float = setting(0.0, SHARE)  # share of a batch's windows drawn from the newest records
    recent_records: int = setting(20_000, COUNT)  # number of these newest records
    # windows start from stored latents, refreshed at each update, instead of initial ones; null: if the recipe shortens
    # windows, as it does for model=auto on CUDA
    context: bool | None = None


class StreamReplay(TensorDictReplayBuffer):
    """TorchRL replay buffer over streams; build it with `make_replay`.

    ``len(replay)`` is the number of records stored.
    """

    _storage: RecordStorage
    _writer: StreamWriter
    _sampler: StreamSampler
    _rng: torch.Generator

    def __init__(
        self,
        *,
        observation_keys: Sequence[NestedKey] = ("pixels",),
        reward_keys: Sequence[str] = RACE_REWARD_KEYS,
        latents: LatentFormat | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.observation_keys = tuple(observation_keys)
        self.reward_keys = tuple(reward_keys)
        self.latents = latents

    @property
    def num_streams(self) -> int:
        """N, the number of streams."""
        return self._writer.num_streams

    def extend(self, rollout: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Append a collector's rollout ``[N, T]``; see `records_from_rollout`. Return the slots, int64 ``(M,)``."""
        records = records_from_rollout(rollout, self.observation_keys, self.reward_keys, self.latents)
        return super().extend(records, update_priority=update_priority)

    def _sample(self, batch_size: int) -> tuple[TensorDictBase, dict]:
        """Sample a batch including its slots; TorchRL's own method would copy those synchronously."""
        with self._replay_lock, self._write_lock:
            slots, _ = self._sampler.sample(self._storage, batch_size)
            records = self._storage.get(slots)
        records.set("index", send(slots, self._storage.device))
        return self._transformed(records), {}

    def refresh(self, slots: Tensor, belief: Tensor, state: Tensor) -> None:
        """Replace the context of sampled records by the world model's current latents of the records before them.

        Args:
            slots: Slots of windows just sampled (``"index"`` of the sample), int64 ``(B, T)``.
            belief: Belief after each of their records, ``(B, T, D)``.
            state: State after each of their records, ``(B, T, S)``.

        Reference: danijar/dreamerv3, ``replay_context`` (latents written back to the replay after each update).
        """
        assert self.latents is not None, "made without latents: there is no context to refresh"
        packed = self.latents.pack(belief[:, :-1], state[:, :-1]).flatten()
        # Windows may overlap: `overwrite` then takes belief and state from the same window.
        self._storage.overwrite(slots[:, 1:].flatten(), TensorDict({CONTEXT: packed}, packed.batch_size))

    def held_out(self, num_windows: int, length: int, recent: int | None = None) -> TensorDictBase | None:
        """Return windows ``[num_windows, length]`` of the held-out streams, transformed like samples.

        They are drawn from the newest ``recent`` records with a seed that depends on the number of records written.
        Return None if no streams are held out, or if they are still too short.
        """
        slots = self._sampler.held_out(num_windows, length, recent)
        return None if slots is None else self._transformed(self._storage.get(slots))

    def newest(self, length: int) -> TensorDictBase | None:
        """Return the newest records of every stream, ``[N, length]``, transformed like samples.

        Return None as long as a stream holds fewer.
        """
        slots = self._sampler.newest(length)
        return None if slots is None else self._transformed(self._storage.get(slots))

    def _transformed(self, records: TensorDictBase) -> TensorDictBase:
        return self._transform(records) if self._transform is not None and len(self._transform) else records

    def records(self, stream: int) -> TensorDictBase:
        """Return all records of one stream, oldest first, untransformed, batch ``[filled]``."""
        return self._storage.get(self._writer.slots(stream))

    def dumps(self, path: str | Path) -> None:
        """Save the filled part of every stream, the cursors and the random generator into a folder.

        Each field is a file with one Zstandard frame per stream; rendered images shrink to a twentieth. The files are
        not memory-mapped, because on a full disk a memory map kills the process with a bus error.
        """
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        fields = []
        starts = range(0, self._storage.max_size, self._writer.stream_length)
        pairs = zip(starts, self._writer.filled.tolist(), strict=True)
        filled = [slice(start, start + count) for start, count in pairs if count]  # not full: never wrapped around
        with ThreadPoolExecutor(torch.get_num_threads()) as threads:  # compression releases the GIL
            for number, (key, stored) in enumerate(self._storage.fields() if len(self) else ()):
                with (path / _FIELD.format(number)).open("wb") as file:
                    frames = threads.map(_compressed, (stored[part] for part in filled))
                    sizes = [file.write(frame) for frame in frames]
                layout = {"shape": list(stored.shape[1:]), "dtype": str(stored.dtype)}
                fields.append({"key": key, **layout, "frames": sizes})
        state = {"streams": self._writer.state_dict(), "fields": fields, "generator": self._rng.get_state().tolist()}
        (path / "replay.json").write_text(json.dumps(state), encoding="utf-8")

    def loads(self, path: str | Path) -> None:
        """Restore what `dumps` saved.

        Raises:
            ValueError: If the saved streams or records do not have this replay's shape.
        """
        path = Path(path)
        state = self._read_state(path)
        self._writer.load_state_dict(state["streams"])
        for stream in range(self.num_streams):
            self._read_stream(path, state, stream, stream)
        self._rng.set_state(torch.tensor(state["generator"], dtype=torch.uint8))

    def load_shards(self, paths: Sequence[str | Path], skip: int) -> None:
        """Load this replay's number of streams from several saved replays, which are concatenated in their order.

        The random generator stays as it is. Other replays load the first ``skip`` streams.

        Raises:
            ValueError: As in ``loads``; also if there are too few streams.
        """
        here = self._writer
        streams: list[tuple[Path, dict[str, Any], int]] = []  # all that are saved: folder, its state, number in it
        for path in map(Path, paths):
            state = self._read_state(path)
            saved = state["streams"]["num_streams"]
            StreamWriter(saved, here.stream_length).check(state["streams"])
            streams += [(path, state, stream) for stream in range(saved)]
        chosen = streams[skip : skip + here.num_streams]
        if len(chosen) != here.num_streams:
            raise ValueError(
                f"The saved replays have {len(streams)} streams, but streams {skip} to {skip + here.num_streams} are "
                "needed: resume with the same number of environments."
            )
        cursor, filled = (
            [state["streams"][name][number] for _, state, number in chosen] for name in ("cursor", "filled")
        )
        state = {**here.state_dict(), "cursor": cursor, "filled": filled, "write_count": sum(filled)}
        here.load_state_dict(state)
        for target, (path, state, stream) in enumerate(chosen):
            self._read_stream(path, state, stream, target)

    def _read_state(self, path: Path) -> dict[str, Any]:
        """Read the state of a folder, and check that it fits this replay, before anything is restored."""
        state = json.loads((path / "replay.json").read_text(encoding="utf-8"))
        fields = state["fields"]
        for field in fields:
            field["key"] = field["key"] if isinstance(field["key"], str) else tuple(field["key"])
            field["dtype"] = getattr(torch, field["dtype"].removeprefix("torch."))
        layouts = {field["key"]: torch.empty(0, *field["shape"], dtype=field["dtype"]) for field in fields}
        for key, stored in self._storage.fields() if fields else ():
            if key not in layouts:
                raise ValueError(f"The replay stores {key!r}, which the saved one does not have.")
            check_layout(key, layouts[key], stored)
        has, wants = (any(field["key"][0] == CONTEXT for field in fields), self.latents is not None)
        if fields and has is not wants:
            raise ValueError(
                f"The saved replay was recorded {'with' if has else 'without'} latents, and this one is "
                f"{'with' if wants else 'without'} latents: resume with replay.context={str(has).lower()}."
            )
        streams = sum(filled > 0 for filled in state["streams"]["filled"])
        for number, field in enumerate(fields):
            file = path / _FIELD.format(number)
            if len(field["frames"]) != streams or file.stat().st_size != sum(field["frames"]):
                raise ValueError(f"{file} does not hold a frame for each of {streams} streams.")
        return state

    def _read_stream(self, path: Path, state: dict[str, Any], stream: int, target: int) -> None:
        """Read a stream of a folder into one of this replay's streams."""
        filled = state["streams"]["filled"]
        if not filled[stream]:
            return
        frame = sum(count > 0 for count in filled[:stream])  # an empty stream has no frame
        records = TensorDict({}, batch_size=[filled[stream]])
        for number, field in enumerate(state["fields"]):
            with (path / _FIELD.format(number)).open("rb") as file:
                file.seek(sum(field["frames"][:frame]))
                content = file.read(field["frames"][frame])
            records.set(field["key"], _expanded(content, (filled[stream], *field["shape"]), field["dtype"]))
        start = target * self._writer.stream_length
        self._storage.set(slice(start, start + filled[stream]), records, set_cursor=False)


def _compressed(records: Tensor) -> bytes:
    """Return the values of one field as a Zstandard frame of level 1."""
    return zstandard.compress(records.cpu().contiguous().view(torch.uint8).numpy().data, level=1)


def _expanded(frame: bytes, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return the values in a frame of `_compressed`."""
    try:
        if zstandard.frame_content_size(frame) != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"A frame of the saved replay does not hold {list(shape)} values of {dtype}.")
        content = zstandard.decompress(frame)
    except zstandard.ZstdError as error:
        raise ValueError(f"A frame of the saved replay is damaged: {error}.") from error
    return torch.frombuffer(bytearray(content), dtype=dtype).view(shape)


def make_replay(
    capacity: int,
    num_envs: int,
    batch_size: int,
    batch_length: int,
    device: torch.device | str = "cpu",
    *,
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
    latents: LatentFormat | None = None,
) -> StreamReplay:
    """Make the replay buffer of N streams.

    Args:
        capacity: Number of records in all; each stream stores ``capacity // num_envs``.
        num_envs: N.
        batch_size: B, windows per sample (not records, unlike TorchRL's `SliceSampler`).
        batch_length: T, records per window.
        device: Device of samples.
        storage_device: Device that stores the records; ``device`` if None.
        scratch_dir: Folder for memory-mapped files, which are overwritten, instead of memory; None uses memory.
        seed: Seed of the sampler's own generator.
        transform: Applied to samples, for example `RelabelReward`.
        observation_keys: Keys of an observation that are stored.
        reward_keys: Keys of rewards that are stored.
        recent_share: Share of a sample's windows drawn from the newest records, so that the model soon learns newly
            visited states; others are drawn from all. Reference: danijar/dreamerv3, ``replay.fracs.recency``.
        recent_records: Number of these newest records, over all streams; all if None.
        held_out: Number of last streams that are never sampled, for `StreamReplay.held_out`.
        prefetch: Number of samples drawn ahead in threads, which hides the transfer to ``device``; they may lack the
            newest records, and a restored replay then does not continue the same samples.
        latents: Format in which the policy's latents are stored as each record's ``context``; None stores none.

    Raises:
        ValueError: If a stream cannot hold a window, ``recent_share`` is not a share, or all streams are held out.

    Example:
        >>> replay = make_replay(capacity=100_000, num_envs=16, batch_size=16, batch_length=64)
        >>> replay.batch_size, len(replay)
        (16, 0)
    """
    stream_length = capacity // num_envs
    if stream_length < batch_length:
        raise ValueError(
            f"capacity={capacity} gives each of num_envs={num_envs} streams {stream_length} records, less than one "
            f"window of batch_length={batch_length}: the capacity must be at least {num_envs * batch_length}."
        )
    if not 0.0 <= recent_share <= 1.0:
        raise ValueError(f"recent_share={recent_share}: must be between 0 and 1.")
    if not 0 <= held_out < num_envs:
        raise ValueError(f"held_out={held_out} of num_envs={num_envs} streams: at least one must be left to sample.")
    slots = stream_length * num_envs
    if scratch_dir is not None:
        records = StreamMemmapStorage(slots, scratch_dir=scratch_dir, existsok=True)
    else:
        records = StreamTensorStorage(slots, device=storage_device or device)
    writer = StreamWriter(num_envs, stream_length)
    recent = None if recent_records is None else recent_records // num_envs
    replay = StreamReplay(
        storage=records,
        writer=writer,
        sampler=StreamSampler(writer, batch_length, recent_share, recent, held_out),
        generator=torch.Generator().manual_seed(seed),
        transform=transform,
        batch_size=batch_size,
        observation_keys=observation_keys,
        reward_keys=reward_keys,
        latents=latents,
        prefetch=prefetch,
    )
    if records.device != torch.empty((), device=device).device:
        replay.append_transform(_delivery(records.device, torch.device(device)))
    return replay


def _delivery(kept_on: torch.device, device: torch.device) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return the function that moves samples to a device, asynchronously from pinned memory if possible."""
    pinned = device.type == "cuda" and kept_on.type == "cpu"
    return lambda sample: (sample.pin_memory() if pinned else sample).to(device, non_blocking=pinned)
