"""Command packets as they arrive: counted, refused, and missed when they stop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.vehicle import Command, Setpoint
from dreamer_racing.plant.commands import CommandReceiver, Failsafe
from dreamer_racing.plant.vehicle import PlantVehicle


def packet(sequence: int, armed: bool = True, thrust: float = GRAVITY) -> bytes:
    return encode_command(CommandPacket(sequence, 0.0, Command(armed, Setpoint(thrust, np.zeros(3)))))


@pytest.fixture(scope="module")
def vehicle() -> PlantVehicle:
    """A drone on its stand; without delay."""
    return PlantVehicle("circle", "easy")


def armed_after(vehicle: PlantVehicle) -> bool:
    vehicle.advance(0.002)
    return vehicle.armed


def test_it_arms_after_a_disarmed_command_only(vehicle: PlantVehicle, caplog: pytest.LogCaptureFixture) -> None:
    vehicle.reset()
    receiver = CommandReceiver(vehicle)
    for sequence in range(3):
        assert receiver.take(packet(sequence), 0.0)
    assert not armed_after(vehicle)
    assert caplog.text.count("armed without having been disarmed") == 1  # once is enough
    receiver.take(packet(3, armed=False), 0.0)
    assert not armed_after(vehicle)
    receiver.take(packet(4), 0.0)
    assert armed_after(vehicle)


def test_silence_cuts_the_motors_at_its_time_until_disarmed_and_armed_again(vehicle: PlantVehicle) -> None:
    vehicle.reset()
    receiver = CommandReceiver(vehicle, timeout=0.3)
    assert receiver.due == np.inf  # nothing to cut
    receiver.take(packet(0, armed=False), 1.0)
    receiver.take(packet(1), 1.1)
    assert receiver.due == pytest.approx(1.4)
    receiver.act(1.39)
    assert armed_after(vehicle) and receiver.failsafe.events == 0
    receiver.act(receiver.due)
    assert not armed_after(vehicle) and receiver.failsafe.events == 1 and receiver.due == np.inf
    receiver.act(2.0)
    receiver.take(packet(2), 2.1)
    assert not armed_after(vehicle) and receiver.failsafe.events == 1
    receiver.take(packet(3, armed=False), 2.2)
    receiver.take(packet(4), 2.2)
    assert armed_after(vehicle)


def test_what_is_no_command_is_counted_and_keeps_nothing_alive(vehicle: PlantVehicle) -> None:
    vehicle.reset()
    receiver = CommandReceiver(vehicle)
    receiver.take(packet(0, armed=False), 0.0)
    receiver.take(packet(1), 0.0)
    good = packet(2, thrust=20.0)
    damaged = bytes((*good[:20], good[20] ^ 1, *good[21:]))
    bad = (b"", b"DRC1", good[:-1], good + b"\0", damaged, b"DRP1" + good[4:], packet(2, thrust=float("nan")))
    for data in bad:
        assert not receiver.take(data, 0.2)
    assert receiver.malformed == len(bad) and receiver.received == 2
    assert receiver.due == pytest.approx(0.25)
    assert armed_after(vehicle)


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=80))
def test_no_bytes_upset_it(vehicle: PlantVehicle, data: bytes) -> None:
    receiver = CommandReceiver(vehicle)
    assert not receiver.take(data, 0.0) and receiver.malformed == 1


def test_lost_and_stale_commands_are_counted_across_the_end_of_the_sequence(vehicle: PlantVehicle) -> None:
    vehicle.reset()
    receiver = CommandReceiver(vehicle)
    for sequence in (2**32 - 3, 2**32 - 1, 2**32 - 2, 2**32 - 1, 1):
        receiver.take(packet(sequence, armed=False), 0.0)
    assert (receiver.received, receiver.lost, receiver.stale) == (3, 2, 2)
    assert "3 commands (2 lost, 2 stale, 0 malformed), 0 failsafe(s)" in receiver.summary()


def test_a_sender_that_begins_anew_is_heard_after_the_failsafe(vehicle: PlantVehicle) -> None:
    vehicle.reset()
    receiver = CommandReceiver(vehicle)
    receiver.take(packet(5000, armed=False), 0.0)
    assert not receiver.take(packet(0, armed=False), 0.1)
    receiver.act(0.25)
    assert receiver.take(packet(1, armed=False), 0.3) and receiver.lost == 0


def test_failsafe_counts_only_what_it_ended() -> None:
    failsafe = Failsafe(0.1)
    assert not failsafe.expire(5.0)
    assert not failsafe.hear(True, 5.0) and failsafe.deadline == np.inf
    assert not failsafe.hear(False, 5.0) and failsafe.hear(True, 5.05)
    assert failsafe.expire(5.2) and not failsafe.expire(5.3) and failsafe.events == 1
