"""A loop that hangs: the vehicle is disarmed by another thread, and by one sender at a time."""

from __future__ import annotations

import threading
import time

import pytest

from dreamer_racing.hil.vehicle import Command, at_rest, hover
from dreamer_racing.hil.watchdog import Watchdog

ARMED = Command(True, hover())


class Wire:
    """A link that notices when two send at a time."""

    def __init__(self) -> None:
        self.armed: list[bool] = []
        self.mixed, self.breaks = False, False
        self._busy = threading.Lock()

    def send(self, command: Command) -> bytes:
        if not self._busy.acquire(blocking=False):
            self.mixed = True
            return b""
        time.sleep(1e-4)  # bytes go out
        self.armed.append(command.armed)
        self._busy.release()
        if self.breaks:
            raise OSError("the device is gone")
        return b"frame"

    refusal = ""

    def listen(self):
        return []

    def reckon_with(self, voltage: float) -> None:
        pass

    def close(self) -> None:
        pass


class Time:
    """A clock that a test turns."""

    now = 10.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def wire():
    return Wire()


@pytest.fixture
def clock():
    return Time()


@pytest.fixture
def watchdog(wire, clock):
    watching = Watchdog(wire, 0.02, clock)
    yield watching
    watching.close()


def wait_for(condition) -> None:
    deadline = time.monotonic() + 10
    while not condition() and time.monotonic() < deadline:
        time.sleep(1e-3)
    assert condition()


def test_it_disarms_again_and_again_once_no_command_has_come_for_too_long(watchdog, wire, clock):
    watchdog.send(ARMED)
    clock.now += 0.0199
    time.sleep(0.05)  # it has looked by now
    assert wire.armed == [True] and not watchdog.acted
    clock.now += 0.0002
    wait_for(lambda: len(wire.armed) > 4)
    assert wire.armed[0] and not any(wire.armed[1:]) and watchdog.acted


def test_after_it_has_acted_nothing_armed_goes_out_any_more(watchdog, wire, clock):
    watchdog.send(ARMED)
    clock.now += 1.0
    wait_for(lambda: watchdog.acted)
    watchdog.send(ARMED)
    assert not any(wire.armed[1:])


def test_a_loop_that_comes_back_before_it_has_looked_is_late_all_the_same(wire, clock):
    watchdog = Watchdog(wire, 600.0, clock)  # it looks once a minute
    watchdog.send(ARMED)
    clock.now += 601.0
    watchdog.send(ARMED)
    assert wire.armed == [True, False] and watchdog.acted
    watchdog.close()


def test_a_vehicle_that_is_disarmed_is_left_alone(watchdog, wire, clock):
    for command in (at_rest(), ARMED, at_rest()):
        watchdog.send(command)
    clock.now += 9.0
    time.sleep(0.05)
    assert wire.armed == [False, True, False] and not watchdog.acted


def test_two_never_send_at_a_time(watchdog, wire, clock):
    watchdog.send(ARMED)
    clock.now += 1.0
    sent = 0
    while len(wire.armed) - sent < 5 and sent < 20_000:  # until the other one has sent too
        watchdog.send(ARMED)
        sent += 1
    assert not wire.mixed and len(wire.armed) - sent >= 5


def test_a_link_that_breaks_is_tried_again(watchdog, wire, clock):
    watchdog.send(ARMED)
    wire.breaks = True
    clock.now += 1.0
    wait_for(lambda: len(wire.armed) > 3)
    assert "the device is gone" in str(watchdog.error)
    wire.breaks = False
    wait_for(lambda: watchdog.error is None)
