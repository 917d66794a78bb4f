"""What is watched in flight: the loop itself, and the battery."""

from __future__ import annotations

import math
import threading
import time

import pytest

from dreamer_racing.hil.battery import Battery, BatteryConfig, Reading
from dreamer_racing.hil.links.crsf import CrsfTelemetry, crc8, encode_crsf
from dreamer_racing.hil.links.link import ChannelLink
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import Command, at_rest, hover
from dreamer_racing.hil.watchdog import Watchdog
from tests.hil.links.frames import Recorder, read_channels

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


@pytest.fixture
def wire():
    return Wire()


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


# The battery's voltage: believed, smoothed and kept, by closed forms, up to the throttle that comes of it.


CONFIG = BatteryConfig(voltage=16.0, tolerance=0.25, smoothing=0.5)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=16.0)


def test_the_first_reading_counts_whole_and_a_step_comes_through_by_63_per_cent_in_a_time_constant():
    battery = Battery(CONFIG)
    assert battery.update(0.5, []) == 16.0 and battery.age == math.inf and battery.readings == 0
    assert battery.update(1.0, [Reading(1.0, 15.0)]) == 15.0
    assert battery.update(1.5, [Reading(1.5, 14.0)]) == pytest.approx(14.0 + math.exp(-1.0))
    assert battery.update(9.0, []) == pytest.approx(14.0 + math.exp(-1.0))  # what is old stays
    assert battery.age == pytest.approx(7.5)


def test_how_often_it_is_read_does_not_matter_to_the_filter():
    often, seldom = Battery(CONFIG), Battery(CONFIG)
    for battery in (often, seldom):
        battery.update(0.0, [Reading(0.0, 16.0)])
    often.update(1.0, [Reading(0.1 * step, 13.0) for step in range(1, 11)])
    assert often.voltage == pytest.approx(seldom.update(1.0, [Reading(1.0, 13.0)]))


@pytest.mark.parametrize(
    ("voltage", "believed"), [(11.99, False), (12.01, True), (19.99, True), (20.01, False), (3.9, False),
                              (math.nan, False), (math.inf, False), (-15.0, False)],
)  # fmt: skip
def test_both_sides_of_what_is_believed(voltage, believed):
    battery = Battery(CONFIG)
    assert battery.update(1.0, [Reading(1.0, voltage)]) == (voltage if believed else 16.0)
    assert (battery.readings, battery.implausible) == (believed, not believed)


@pytest.mark.parametrize("numbers", [{"voltage": 0.0}, {"voltage": 16.0, "tolerance": 0.6}, {"voltage": math.nan}])
def test_what_no_battery_is_like_is_refused(numbers):
    with pytest.raises(ValueError, match=r"BatteryConfig\.(voltage|tolerance)="):
        BatteryConfig(**numbers)


def throttle(link: ChannelLink) -> float:
    return read_channels("crsf", link.send(Command(True, hover())))[2]


def test_a_frame_of_the_flight_controller_changes_the_throttle_by_the_thrust_law():
    """At 14.4 V of 16 the motors' command for the same thrust is 16 / 14.4 as high."""
    frame = bytes.fromhex("c80a08 0090 0000 000000 00")  # 144 decivolts
    wire = Recorder((5.0, frame + bytes([crc8(frame[2:])])))
    link = ChannelLink(wire, encode_crsf, RateMap(roll=10.0, pitch=10.0, yaw=4.0), THRUST, telemetry=CrsfTelemetry())
    before = throttle(link)
    readings = link.listen()
    assert readings == [Reading(5.0, 14.4)]
    link.set_voltage(Battery(CONFIG).update(5.0, readings))
    assert motor(throttle(link)) / motor(before) == pytest.approx(16 / 14.4, rel=2e-3)  # in whole ticks
    assert link.listen() == [] and link.rejected == 0


@pytest.mark.parametrize("voltage", [0.0, 8.9, 9.2, 22.6, -15.0, math.nan, math.inf])
@pytest.mark.parametrize("mass", [0.6, 0.2, 1.6])
def test_no_reading_in_flight_raises(voltage, mass):
    """The reference is 15 V: from 7.5 V, or what just lifts the drone, to 22.5 V."""
    thrust = ThrustMap(mass=mass, full_thrust=16.0, reference_voltage=15.0, voltage=16.0)
    link = ChannelLink(Recorder(), encode_crsf, RateMap(roll=10.0, pitch=10.0, yaw=4.0), thrust)
    link.set_voltage(voltage)
    lifting = 15.0 * math.sqrt(9.81 * mass / 16.0)
    expected = min(max(voltage, 7.5, lifting), 22.5) if math.isfinite(voltage) else 16.0
    assert link.thrust.voltage == pytest.approx(expected, rel=1e-4)
    link.set_voltage(16.0)
    assert link.thrust == thrust


def motor(microseconds: float) -> float:
    return 0.055 + 0.945 * (microseconds - 1050) / 950
