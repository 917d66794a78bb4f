"""Records each flight to a file: the inputs and outputs of every tick, in order.

The file is MCAP, which robotics tools read (https://mcap.dev), with JSON messages on ``/flight`` (once: the settings of
the flight) and ``/tick``. A thread writes each message at once, so that the recording of a killed loop ends only a few
ticks early, and a disk that stalls does not delay the loop. Floats are written so that reading gives the same bits.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from dreamer_racing.commands import import_extra
from dreamer_racing.envs.tracks import Track, read_track
from dreamer_racing.hil.background_worker import BackgroundWorker

FLIGHT, TICK = "/flight", "/tick"
FILE = "flight.mcap"
TRACK = "track_as_flown"
"""Key in the ``/flight`` message of the content of the track's file, as `describe_track` writes it."""
FORMAT_VERSION = 2

WAITING_MOST = 256  # ticks that may wait for the disk [choice]: 5 s at 50 Hz, of some kilobytes each
CLOSING = 10.0  # s for which `FlightRecorder.close` waits for the disk [choice]


class FlightRecorder:
    """Writes the file of a flight.

    Args:
        path: The file; it must not exist yet.
        about: JSON values that describe the flight, with its track under `TRACK`.

    Raises:
        FileExistsError: The file exists: a flight is never overwritten.
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
        self._path, self._worker, self._failed = path, BackgroundWorker(WAITING_MOST), False
        self._write(FLIGHT, 0.0, _encode({"format_version": FORMAT_VERSION, **about}))

    def tick(self, time: float, message: dict[str, Any]) -> None:
        """Queue a tick's message without waiting for the disk; its time is in s, by the loop's clock.

        Raises:
            OSError: An earlier tick could not be written, or the disk has stalled for long; the file ends there.
        """
        data = _encode(message)  # now, because its objects may change
        if not self._worker.submit(partial(self._write, TICK, time, data)):
            self._fail()

    def _write(self, topic: str, time: float, data: bytes) -> None:
        nanoseconds = int(time * 1e9)
        self._writer.add_message(self._channels[topic], nanoseconds, data, nanoseconds, self._sequence)
        self._file.flush()
        self._sequence += 1

    def _fail(self) -> None:
        self._failed = True
        raise self._worker.error or OSError(f"{self._path}: the disk has stalled, and some ticks could not be written.")

    def close(self) -> None:
        """Finish the file; may be called twice.

        Raises:
            OSError: Something could not be written, and `tick` has not raised that.
        """
        if self._file.closed:
            return
        written, said = self._worker.close(CLOSING), self._failed
        if written and not said:
            self._writer.finish()
            self._file.close()
        elif written or self._worker.error is not None:  # else the disk hangs, and closing would, too
            with suppress(OSError):  # raised before, or below
                self._file.close()
        if not written and not said:
            self._fail()

    def __enter__(self) -> Self:
        """Return the recorder."""
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the file."""
        self.close()


class Flight:
    """A recorded flight.

    Args:
        path: The file, or its folder.

    Attributes:
        about: The values that describe it.
        ticks: The messages of its ticks.
        whole: Whether the file was finished; if not, the loop was killed.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a recorded flight, or of another version.
    """

    def __init__(self, path: Path) -> None:
        path = path / FILE if path.is_dir() else path
        if not path.is_file():
            raise FileNotFoundError(f"There is no flight {path}: give the run folder of a flight of recipes/hil.py.")
        messages = list(self._read(path))
        if not messages or messages[0][0] != FLIGHT:
            raise ValueError(f"{path} is not a flight of recipes/hil.py: its first message is not {FLIGHT}.")
        self.about: dict[str, Any] = messages[0][1]
        if (version := self.about.get("format_version")) != FORMAT_VERSION:
            raise ValueError(f"{path}: a flight of version {version!r}; this release reads version {FORMAT_VERSION}.")
        self.ticks = [message for topic, message in messages if topic == TICK]
        self._path = path

    def track(self) -> Track:
        """Return the track that was flown.

        Raises:
            TrackError: The recorded track is damaged.
            ValueError: The file holds no track.
        """
        if TRACK not in self.about:
            raise ValueError(f"{self._path} holds no track ({TRACK}): it was not written by recipes/hil.py.")
        return read_track(self.about[TRACK], f"{self._path}: {TRACK}")

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
                    raise ValueError(f"{path} is not a flight: it ends before its first message.") from error
                return  # the loop was killed while it flew
            except (exceptions.McapError, ValueError, KeyError) as error:
                raise ValueError(f"{path} is not a flight, or is damaged ({type(error).__name__}: {error}).") from error


def _encode(message: dict[str, Any]) -> bytes:
    return json.dumps(message, default=_plain).encode()


def _plain(value: Any) -> Any:
    """Convert a value that json cannot encode to one that it can."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"{type(value).__name__} cannot be written to a recording.")


def _import_mcap(module: str) -> Any:
    return import_extra(f"mcap.{module}", "hil", "Recordings of flights need mcap")
