"""The operator's word, and the pages that an operator reads."""

from __future__ import annotations

import os
import pty
import re
import socket
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from dreamer_racing.hil.links import LINKS
from dreamer_racing.hil.operator import (
    DEAD_MAN,
    KILLS,
    KeyboardOperator,
    Operator,
    TimedOperator,
    UdpOperator,
    encode_operator,
    send_operator,
)
from dreamer_racing.hil.pose_sources import POSE_SOURCES
from dreamer_racing.hil.safety import Reason, State
from dreamer_racing.hil.safety_limits import BELOW_FLOOR, SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.view import PORT


@pytest.fixture
def switch(clock):
    operator = UdpOperator(0, clock=clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        operator.say = lambda data: sending.sendto(data, operator.address)
        yield operator
    operator.close()


def test_an_enable_lapses_when_nothing_comes(switch, clock):
    assert switch.poll() == Operator(False, False)
    switch.say(encode_operator(1, Operator(True, False)))
    assert switch.poll() == Operator(True, False)
    clock.now = DEAD_MAN - 0.01
    assert switch.poll().enable
    clock.now = DEAD_MAN
    assert not switch.poll().enable


def test_a_kill_is_remembered_whatever_comes_after(switch, clock):
    switch.say(encode_operator(5, Operator(True, True)))
    switch.say(encode_operator(6, Operator(True, False)))
    clock.now = 100.0
    assert switch.poll().kill


def test_a_replayed_enable_is_refused_and_a_replayed_kill_is_not(switch):
    switch.say(encode_operator(9, Operator(False, False)))
    switch.say(encode_operator(8, Operator(True, False)))
    switch.say(encode_operator(9, Operator(True, False)))
    assert switch.poll() == Operator(False, False) and switch.rejected == 2
    switch.say(encode_operator(8, Operator(False, True)))
    assert switch.poll().kill


def test_nonsense_is_counted(switch):
    good = encode_operator(1, Operator(True, False))
    for data in (b"", good[:-1], good + b"x", b"DRO2" + good[4:], good[:8] + b"\x02" + good[9:]):
        switch.say(data)
    assert switch.poll() == Operator(False, False) and switch.rejected == 5


def test_keys():
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r", buffering=1) as terminal:
        operator = KeyboardOperator(terminal)
        assert operator.poll() == Operator(False, False)
        os.write(ours, b"e")
        assert operator.poll() == Operator(True, False)
        os.write(ours, b"e")
        assert operator.poll() == Operator(False, False)
        os.write(ours, b"e ")  # between two ticks
        assert operator.poll() == Operator(True, True)
        operator.close()
        operator.close()
    os.close(ours)


def test_a_terminal_that_is_gone_kills():
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r", buffering=1) as terminal:
        operator = KeyboardOperator(terminal)
        os.close(ours)
        assert operator.poll().kill


def test_a_flood_does_not_hold_the_loop(switch):
    for sequence in range(2000):
        switch.say(encode_operator(sequence, Operator(False, False)))
    switch.poll()
    assert switch._sequence < 1100


def test_without_a_terminal_there_are_no_keys(tmp_path):
    (tmp_path / "file").touch()
    with (tmp_path / "file").open() as file, pytest.raises(OSError, match="operator=keyboard needs a terminal"):
        KeyboardOperator(file)


def test_a_timed_operator_enables_by_itself(clock):
    operator, given = TimedOperator(0.5, clock), []
    for clock.now in (7.0, 7.4, 7.5, 7.9, 8.1, 8.6, 9.2):  # again and again, until it is armed
        given.append(operator.poll(armed=False).enable)
    assert given == [False, False, True, True, False, True, False]
    assert operator.poll(armed=True) == Operator(True, False)
    assert operator.poll(armed=False) == Operator(True, False)


class Will:
    """An operator whose will is a list, tick by tick; None is Ctrl-C."""

    def __init__(self, *wills: Operator | None) -> None:
        self.wills = list(wills)

    def poll(self, armed: bool = False) -> Operator:
        will = self.wills.pop(0)
        if will is None:
            raise KeyboardInterrupt
        return will

    def close(self) -> None:
        pass


@pytest.mark.parametrize("last", [Operator(True, True), None])
def test_the_switch_of_a_terminal_is_heard_and_ends_with_a_kill(last, clock, switch, caplog):
    """A kill is repeated, for packets are lost; a network that is gone for a packet is waited for."""
    gone = iter([False, True, False])
    heard = []

    def send(data: bytes) -> None:
        if next(gone, False):
            raise OSError("Network is unreachable")
        switch.say(data)
        heard.append(switch.poll())

    with caplog.at_level("INFO", "dreamer_racing.hil.operator"):
        send_operator(
            Will(Operator(False, False), Operator(True, False), Operator(True, False), last), send, lambda _: None
        )
    assert heard[:2] == [Operator(False, False), Operator(True, False)]
    assert [will.kill for will in heard[2:]] == [True] * KILLS
    said = [record.getMessage() for record in caplog.records]
    assert said[1:] == [
        "the enable is given, but it could not be sent: Network is unreachable", "the enable is given", "kill"
    ]  # fmt: skip


def test_a_kill_waits_for_a_network_that_is_gone(switch):
    tries = iter(range(100))

    def send(data: bytes) -> None:
        if next(tries) < 50:
            raise OSError("Network is unreachable")
        switch.say(data)

    send_operator(Will(Operator(False, True)), send, lambda _: None)
    assert switch.poll().kill and next(tries) == 50 + KILLS


def test_a_switch_that_is_begun_anew_is_not_taken_for_a_replayed_one(switch, monkeypatch):
    for now in (1.8e9, 1.8e9 + 5.0):
        monkeypatch.setattr("dreamer_racing.hil.operator.time.time", lambda now=now: now)
        send_operator(Will(Operator(True, False), Operator(False, True)), switch.say, lambda _: None)
    switch.poll()
    assert switch.rejected == 0


# The pages on flight have every limit with its default, every reason, and every source and link that there is.


DOCS = Path(__file__).parents[2] / "docs"
SAFETY = (DOCS / "hil_safety.md").read_text(encoding="utf-8")
TEXT = "".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("hil*.md")))
LIMITS = SAFETY.partition("## Limits")[2].partition("\n## ")[0]
ROWS = {
    name: cells.split(" | ") for name, cells in re.findall(r"^\| (?:\*\*)?`(\w+)`(?:\*\*)? \| (.*) \|$", LIMITS, re.M)
}


@pytest.mark.parametrize("limit", fields(SafetyLimits), ids=lambda limit: limit.name)
def test_every_limit_is_there_with_its_default(limit):
    default, says = ROWS[limit.name]
    assert says
    if limit.default is MISSING:
        assert default.startswith("the track's")
    else:
        numbers = [float(number) for number in re.findall(r"[\d.]+", default)]
        assert numbers == list(limit.default if isinstance(limit.default, tuple) else [limit.default])


def test_no_limit_is_there_that_is_none():
    assert ROWS.keys() == {limit.name for limit in fields(SafetyLimits)}


@pytest.mark.parametrize("reason", Reason, ids=lambda reason: reason.name)
def test_every_reason_is_there(reason):
    assert f"*{reason.value}*" in " ".join(TEXT.split())


@pytest.mark.parametrize("name", [*LINKS, *POSE_SOURCES, *(each.value for each in (*State, *Stamping))])
def test_every_choice_is_there(name):
    assert f"`{name}`" in TEXT


def test_numbers_in_the_text():
    assert f"{BELOW_FLOOR:g} m lower" in ROWS["fence_low"][0]
    assert f"lapses after {DEAD_MAN:g} s without" in TEXT and f"`view={PORT}`" in TEXT
