"""The link to Betaflight's SITL, and whole flights through it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.hil.chain import FlightChain
from dreamer_racing.hil.links.link import ChannelLink
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.vehicle import Command, Pose
from dreamer_racing.plant.betaflight_sitl import CONVENTIONS, BetaflightSitl, convention_of, decode_motors, encode_state
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import FirmwareStep, Radio
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.process import Plant
from dreamer_racing.plant.vehicle import PlantVehicle
from tests.firmware import FAILSAFE, MIN_CHECK, Firmware
from tests.plant.conftest import RATES, THRUST, chain_of

FIRMWARES = ("2026.6", "before")


def closed(version: str, preset: str = "faithful") -> tuple[Plant, Firmware]:
    """A plant whose every state packet is answered at once."""
    vehicle, firmware = PlantVehicle("circle", preset), Firmware(version)
    answers: list[Callable[[bytes], bool]] = []
    sitl = BetaflightSitl(
        vehicle, lambda data: answers[0](firmware.answer(data)) if answers else None, version, timeout=0.25
    )
    plant = Plant(vehicle, sitl, Delivery(rate=100.0), lambda data: None)
    answers.append(plant.take)
    return plant, firmware


def take_off(plant: Plant, firmware: Firmware) -> float:
    """Fly at hover; return the hover command."""
    hover = math.sqrt(0.6 * GRAVITY / 16.0)
    plant.advance_to(plant.time + 0.1)
    firmware.armed = True
    plant.advance_to(plant.time + 0.2)
    firmware.throttle = hover
    plant.advance_to(plant.time + 0.4)
    assert not plant.vehicle.on_stand
    return hover


@pytest.mark.parametrize(("version", "sign"), [("2026.6", 1.0), ("before", -1.0)])
def test_the_state_packet_is_as_the_firmware_reads_it(version: str, sign: float) -> None:
    pose = Pose(
        7.5,
        np.array((1.0, 2.0, 3.0)),
        np.array((0.8, 0.0, 0.6, 0.0)),
        np.array((4.0, 5.0, 6.0)),
        np.array((0.1, 0.2, 0.3)),
    )
    data = encode_state(pose, np.array((0.5, -0.6, 9.81)), CONVENTIONS[version])
    assert len(data) == 144
    numbers = struct.unpack("<18d", data)
    assert numbers[1:4] == pytest.approx((0.1, -0.2, sign * 0.3))
    assert numbers[4:7] == pytest.approx((-0.5, 0.6, -9.81))
    assert numbers[7:17] == pytest.approx((0.8, 0.0, 0.6, 0.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0))
    assert 101325.0 - numbers[17] == pytest.approx(12.0 * 3.0, rel=0.01)  # Pa: 12 a metre near the ground
    later = encode_state(pose._replace(time=99.0), np.zeros(3), CONVENTIONS[version])
    assert struct.unpack("<18d", later)[0] == numbers[0]  # a constant stamp


def test_motors_are_put_in_order_and_within_limits() -> None:
    data = struct.pack("<4f", 0.1, 0.2, 0.3, 0.4)
    assert decode_motors(data, CONVENTIONS["2026.6"]) == pytest.approx((0.1, 0.2, 0.3, 0.4))
    assert decode_motors(data, CONVENTIONS["before"]) == pytest.approx((0.4, 0.1, 0.2, 0.3))  # M2 M3 M4 M1
    wild = decode_motors(struct.pack("<4f", -0.5, 1.5, 0.0, 1.0), CONVENTIONS["2026.6"])
    assert wild == pytest.approx((0.0, 1.0, 0.0, 1.0))
    for bad in (
        b"",
        data[:-1],
        data + b"\0",
        struct.pack("<4f", math.nan, 0, 0, 0),
        struct.pack("<4f", math.inf, 0, 0, 0),
    ):
        assert decode_motors(bad, CONVENTIONS["2026.6"]) is None


@pytest.mark.parametrize("version", FIRMWARES)
def test_idle_motors_arm_and_leave_it_on_the_stand(version: str) -> None:
    plant, firmware = closed(version)
    plant.advance_to(0.2)
    assert not plant.vehicle.armed and len(firmware.stamps) == 1
    assert firmware.accelerometer == pytest.approx((0.0, 0.0, GRAVITY))  # as an accelerometer at rest
    firmware.armed = True
    plant.advance_to(0.5)
    assert plant.vehicle.armed and plant.vehicle.on_stand
    assert plant.controls.summary() == "501 motor packets (0 malformed), 0 failsafe(s)"  # one a physics step


@pytest.mark.parametrize("version", FIRMWARES)
@pytest.mark.parametrize(("axis", "rate"), [(0, 3.5), (1, -3.5), (2, 1.5)])
def test_the_closed_loop_holds_the_rate_that_the_firmware_wants(version: str, axis: int, rate: float) -> None:
    plant, firmware = closed(version)
    take_off(plant, firmware)
    assert np.abs(plant.vehicle.pose().body_rates).max() < 1e-6
    firmware.rates[axis] = rate
    plant.advance_to(plant.time + 0.3)
    wanted = np.zeros(3)
    wanted[axis] = rate
    tolerance = (0.05 if axis < 2 else 0.2) * abs(rate)  # yaw still overshoots, as the real one does
    assert plant.vehicle.pose().body_rates == pytest.approx(wanted, abs=tolerance)
    assert firmware.gyro == pytest.approx(plant.vehicle.pose().body_rates, abs=0.02 * abs(rate))
    assert plant.vehicle.crash is CrashCause.NONE


def test_silence_of_the_firmware_cuts_the_motors_until_it_has_been_disarmed() -> None:
    plant, firmware = closed("2026.6")
    take_off(plant, firmware)
    answer, heard = firmware.answer, plant.time
    firmware.answer = lambda data: b"nothing"
    plant.advance_to(heard + 0.24)
    assert plant.vehicle.armed
    plant.advance_to(heard + 0.26)
    assert not plant.vehicle.armed and plant.controls.failsafe.events == 1 and plant.controls.malformed > 200
    firmware.answer = answer
    plant.advance_to(heard + 0.3)
    assert not plant.vehicle.armed  # still armed over there
    firmware.armed = False
    plant.advance_to(heard + 0.32)
    firmware.armed = True
    plant.advance_to(heard + 0.34)
    assert plant.vehicle.armed


@pytest.mark.parametrize(
    ("release", "convention"),
    [
        *(("4.5", "before"), ("4.6.0", "before"), ("2025.12.1", "before"), ("before", "before")),
        *(("2026.6", "2026.6"), ("2026.12.0-alpha", "2026.6"), ("2027.6", "2026.6")),
    ],
)
def test_a_release_has_its_convention(release: str, convention: str) -> None:
    assert convention_of(release) is CONVENTIONS[convention]


# The whole loop around a firmware: pilot → channels → the firmware's rate loop → motors → plant → poses → pilot.


class RecordedRadio(Radio):
    """Keeps the channels that were sent."""

    def __init__(self, firmware: Firmware) -> None:
        super().__init__(firmware)
        self.sent: list[tuple[int, ...]] = []

    def write(self, data: bytes) -> bool:
        self.sent.append(struct.unpack("<d16H", data)[1:])
        return super().write(data)


class SitlStep(FirmwareStep):
    """A plant that the stand-in of a firmware flies by its motors, and the loop by the firmware's radio."""

    def __init__(self, version: str) -> None:
        self.firmware = Firmware(version)
        stepped = SimpleNamespace(
            firmware=SimpleNamespace(release=version), exchange=lambda state: [self.firmware.answer(state)]
        )
        self.radio = RecordedRadio(self.firmware)
        link = ChannelLink(self.radio, encode_sitl, RATES, THRUST)
        super().__init__(PlantVehicle("circle", "faithful"), stepped, link)
        self.pull_after: float | None = None  # s

    def send(self, command: Command) -> bytes:
        self.radio.disconnected = self.pull_after is not None and self.elapsed >= self.pull_after
        return super().send(command)


def pilot_on(step: SitlStep) -> FlightChain:
    return chain_of(step, PilotFlyer(step.plant.vehicle.track, "faithful"), laps=1)


@pytest.mark.parametrize("version", FIRMWARES)
def test_the_pilot_flies_a_lap_through_the_firmware(version: str) -> None:
    step = SitlStep(version)
    chain = pilot_on(step)
    assert step.plant.vehicle.armed is False
    assert step.fly(chain, 50.0, 15.0) == "disarmed: the flight is over"
    assert step.plant.vehicle.gates_passed == step.plant.vehicle.track.num_gates
    assert step.firmware.stamps == {1.0} and step.firmware.refused == 0
    armed = [channels for channels in step.radio.sent if channels[4] == 2000]
    assert armed[0][2] < MIN_CHECK, "armed at low throttle"
    assert np.ptp(np.array(armed)[:, :4], axis=0).min() > 20, "each stick was moved"
    assert not step.firmware.armed and step.radio.sent[-1][4] == 1000


def test_a_radio_that_is_pulled_out_drops_it_by_the_firmwares_own_failsafe() -> None:
    step = SitlStep("2026.6")
    step.pull_after = 1.5
    step.fly(pilot_on(step), 50.0, 15.0)
    assert step.disarmed_at is not None
    assert step.pull_after + FAILSAFE - 0.02 < step.disarmed_at < step.pull_after + FAILSAFE + 0.05
    assert not step.firmware.armed
