"""Flights on disk: read as written, whole or cut off anywhere, and nothing else taken for one."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from dreamer_racing.hil.recording import FILE, WAITING_MOST, Flight, FlightRecorder


@pytest.fixture
def recorded(tmp_path):
    path = tmp_path / "flight" / FILE
    with FlightRecorder(path, {"track": "circle"}) as recorder:
        for index in range(50):
            recorder.tick(0.04 * index, {"index": index, "numbers": np.full(3, 0.1 * index), "sent": bytes([index])})
    return path


def test_a_flight_is_read_as_it_was_written(recorded):
    flight = Flight(recorded.parent)
    assert flight.whole and flight.about["track"] == "circle" and len(flight.ticks) == 50
    assert flight.ticks[7] == {"index": 7, "numbers": [0.1 * 7] * 3, "sent": "07"}


def test_a_flight_whose_loop_is_killed_is_there_up_to_its_last_tick(tmp_path):
    recorder = FlightRecorder(tmp_path / FILE, {})
    recorder.tick(0.0, {"index": 0})
    recorder.tick(0.1, {"index": 1})
    deadline = time.monotonic() + 10
    while len((flight := Flight(tmp_path)).ticks) < 2 and time.monotonic() < deadline:  # nothing was closed
        time.sleep(0.01)
    assert not flight.whole and [tick["index"] for tick in flight.ticks] == [0, 1]
    recorder.close()
    recorder.close()


def stall(recorder, monkeypatch):
    """Let the disk take nothing until the event is set; 20 s at most."""
    released, add = threading.Event(), recorder._writer.add_message

    def wait(*values):
        released.wait(20)
        add(*values)

    monkeypatch.setattr(recorder._writer, "add_message", wait)
    return released


def test_a_disk_that_stalls_for_a_while_holds_nobody_up_and_loses_nothing(tmp_path, monkeypatch):
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        released, began = stall(recorder, monkeypatch), time.monotonic()
        message = {"index": 0}
        for message["index"] in range(WAITING_MOST):
            recorder.tick(0.02 * message["index"], message)
        assert time.monotonic() - began < 5
        released.set()
    flight = Flight(tmp_path)
    assert flight.whole and [tick["index"] for tick in flight.ticks] == list(range(WAITING_MOST))


def test_a_disk_that_takes_nothing_for_too_long_ends_the_recording_without_a_gap(tmp_path, monkeypatch):
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        released, taken = stall(recorder, monkeypatch), []

        def fly() -> None:
            for index in range(WAITING_MOST + 2):  # one is being written when the queue is full
                recorder.tick(0.02 * index, {"index": index})
                taken.append(index)

        with pytest.raises(OSError, match=r"flight\.mcap: the disk has stalled"):
            fly()
        released.set()
    flight = Flight(tmp_path)
    assert not flight.whole and [tick["index"] for tick in flight.ticks] == taken and len(taken) >= WAITING_MOST


@pytest.mark.parametrize("noticed", [True, False])
def test_a_full_disk_is_said_by_the_next_tick_or_else_at_the_end(tmp_path, monkeypatch, noticed):
    def full(*values):
        raise OSError(28, "No space left on device")

    recorder = FlightRecorder(tmp_path / FILE, {})
    monkeypatch.setattr(recorder._writer, "add_message", full)
    recorder.tick(0.0, {})
    if noticed:
        deadline = time.monotonic() + 10
        while recorder._worker.error is None and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(OSError, match="No space left"):
            recorder.tick(0.1, {})
    else:
        with pytest.raises(OSError, match="No space left"):
            recorder.close()
    recorder.close()


def test_a_file_may_end_anywhere(recorded):
    data = recorded.read_bytes()
    counts = []
    for end in range(600, len(data), 97):
        recorded.write_bytes(data[:end])
        counts.append(len(Flight(recorded).ticks))
    assert counts == sorted(counts) and counts[0] < 5 and counts[-1] == 50


@pytest.mark.parametrize("content", [b"", b"nonsense, and more of it", bytes(range(256)) * 8])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(ValueError, match="is not a flight"):
        Flight(tmp_path)


def test_a_flight_is_never_overwritten(recorded):
    with pytest.raises(FileExistsError):
        FlightRecorder(recorded, {})


def test_there_must_be_one(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"There is no flight .*: give the run folder of a flight"):
        Flight(tmp_path / "nowhere")


def test_a_newer_version_is_refused(tmp_path):
    FlightRecorder(tmp_path / FILE, {"format_version": 99}).close()
    with pytest.raises(ValueError, match="a flight of version 99; this release reads version 2"):
        Flight(tmp_path)


def test_a_flight_without_its_track_is_refused(tmp_path):
    FlightRecorder(tmp_path / FILE, {}).close()
    with pytest.raises(ValueError, match=r"holds no track \(track_as_flown\): it was not written by recipes/hil.py"):
        Flight(tmp_path).track()
