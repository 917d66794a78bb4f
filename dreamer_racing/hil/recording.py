"""Every flight is a file: what came in at each tick and what went out, in the order in which it happened.

The file is MCAP, which robotics tools read (https://mcap.dev): messages in JSON on ``/flight`` (once: everything that
the flight was begun with) and ``/tick``. Each message is written at once, so that a flight whose loop is killed is
there up to its last ticks; by a thread, so that a disk that stalls holds up no flight. Floats are written so that
reading gives the same bits.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from dreamer_racing.commands import install_extra
from dreamer_racing.envs.tracks import Track, load_track, read_track
from dreamer_racing.hil.aside import Aside

FLIGHT, TICK = "/flight", "/tick"
FILE = "flight.mcap"
TRACK = "track_as_flown"
"""Of what a flight is begun with: the content of its track's file, as `describe_track` writes it."""
FORMAT_VERSION = 1

WAITING_MOST = 256
"""Ticks that may wait for the disk [choice]: 5 s at 50 Hz, of some kilobytes each."""

CLOSING = 10.0
"""s for which the end of a recording waits for the disk [choice]."""


class FlightRecorder:
    """Writes the file of a flight.

    Args:
        path: The file; there must be none yet.
        about: JSON values with which the flight is begun, the track under `TRACK`.

    Raises:
        FileExistsError: There is one: a flight is never overwritten.
        ImportError: mcap is not installed.
    """

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        writer = _import_mcap("writer")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("xb")
        self._writer = writer.Writer(self._file, use_chunking=False)
        self._writer.start(profile="", library="dreamer_racing")
        schema = self._writer.register_schema("dreamer_racing.json", "jsonschema", b'{"type": "object"}')
        self._channels = {
            topic: self._writer.register_channel(topic, message_encoding="json", schema_id=schema)
            for topic in (FLIGHT, TICK)
        }
        self._sequence = 0
        self._path, self._aside, self._failed = path, Aside(WAITING_MOST), False
        self._write(FLIGHT, 0.0, _encode({"format_version": FORMAT_VERSION, **about}))

    def tick(self, time: float, message: dict[str, Any]) -> None:
        """Have written what happened in a tick at a time, s by the loop's clock; wait for no disk.

        Raises:
            OSError: A tick before could not be written, or the disk has taken none for long; the file ends there.
        """
        data = _encode(message)  # now: what it speaks of may change
        if not self._aside.do(partial(self._write, TICK, time, data)):
            self._fail()

    def _write(self, topic: str, time: float, data: bytes) -> None:
        nanoseconds = int(time * 1e9)
        self._writer.add_message(self._channels[topic], nanoseconds, data, nanoseconds, self._sequence)
        self._file.flush()
        self._sequence += 1

    def _fail(self) -> None:
        self._failed = True
        raise self._aside.error or OSError(f"{self._path}: the disk does not take what is to be written.")

    def close(self) -> None:
        """Finish the file; may be called twice.

        Raises:
            OSError: Something could not be written, and `tick` has not said so.
        """
        if self._file.closed:
            return
        written, said = self._aside.close(CLOSING), self._failed
        if written and not said:
            self._writer.finish()
            self._file.close()
        elif written or self._aside.error is not None:  # else the disk would not take the end either
            with suppress(OSError):  # which has been said, or is below
                self._file.close()
        if not written and not said:
            self._fail()

    def __enter__(self) -> Self:
        """Go on recording."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Finish the file."""
        self.close()


class Flight:
    """A flight that was recorded.

    Args:
        path: The file, or the folder in which it is.

    Attributes:
        about: With what it was begun.
        ticks: What happened, a dictionary each.
        holds_track: Whether the track is in the file; it is since flights keep it.
        whole: Whether the file was finished; if not, the loop was killed.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is no such file, or of another version.
    """

    def __init__(self, path: Path) -> None:
        path = path / FILE if path.is_dir() else path
        if not path.is_file():
            raise FileNotFoundError(f"There is no flight {path}: give a folder in which recipes/hil.py flew.")
        messages = list(self._read(path))
        if not messages or messages[0][0] != FLIGHT:
            raise ValueError(f"{path} is no flight of recipes/hil.py: it does not begin with how it was begun.")
        self.about: dict[str, Any] = messages[0][1]
        if (version := self.about.get("format_version")) != FORMAT_VERSION:
            raise ValueError(f"{path}: a flight of version {version!r}; this release reads version {FORMAT_VERSION}.")
        self.ticks = [message for topic, message in messages if topic == TICK]
        self.holds_track = TRACK in self.about
        self._path = path

    def track(self) -> Track:
        """Return the track that was flown; of a flight that does not hold it, the track of its name as it is now.

        Raises:
            TrackError: The file's is damaged, or there is no such track any more.
            KeyError: The file names none.
        """
        if self.holds_track:
            return read_track(self.about[TRACK], f"{self._path}: {TRACK}")
        config = self.about.get("config") or {}
        return load_track(config.get("track") or self.about["track"])

    def _read(self, path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
        reader, exceptions = _import_mcap("stream_reader"), _import_mcap("exceptions")
        records = _import_mcap("records")
        topics: dict[int, str] = {}
        self.whole = False
        with path.open("rb") as file:
            try:
                for record in reader.StreamReader(file).records:
                    if isinstance(record, records.Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, records.Message):
                        yield topics[record.channel_id], json.loads(record.data)
                    elif isinstance(record, records.Footer):
                        self.whole = True
            except (exceptions.EndOfFile, struct.error) as error:
                if not topics:
                    raise ValueError(f"{path} is no flight: it ends before it begins.") from error
                return  # the loop was killed while it flew
            except (exceptions.McapError, ValueError, KeyError) as error:
                raise ValueError(f"{path} is no flight, or damaged ({type(error).__name__}: {error}).") from error


def _encode(message: dict[str, Any]) -> bytes:
    return json.dumps(message, default=_plain).encode()


def _plain(value: Any) -> Any:
    """Return what json does not know as what it does."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"{type(value).__name__} has no place in a recording.")


def _import_mcap(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(f"mcap.{module}")
    except ImportError as error:
        raise ImportError(f"mcap is not installed: {install_extra('hil')}.") from error
