"""The whole loop around a firmware: pilot → channels → the firmware's rate loop → motors → plant → poses → pilot."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import rate_map
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.links.link import ChannelLink
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.hil.vehicle import Command
from dreamer_racing.plant.betaflight_sitl import BetaflightSitl
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import LockStep, make_chain
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.process import Plant
from dreamer_racing.plant.vehicle import PlantVehicle
from tests.firmware import FAILSAFE, MIN_CHECK, Firmware

CONTRACT = Path(__file__).parents[2] / "agents" / "circle" / "contract.json"
RATES = rate_map(read_contract(CONTRACT))
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)  # the faithful drone's


class Radio:
    """A transport to the firmware that can be pulled out; it keeps what was sent."""

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        self.sent: list[tuple[int, ...]] = []
        self.pulled = False

    def write(self, data: bytes) -> bool:
        self.sent.append(struct.unpack("<d16H", data)[1:])
        if not self.pulled:
            self._firmware.hear(data)
        return True

    def discard(self) -> None:
        pass

    def read(self) -> Iterator[tuple[float, bytes]]:
        return iter(())

    def close(self) -> None:
        pass


class SitlStep(LockStep):
    """A plant that a firmware flies by its motors, and the loop by the firmware's radio; time is the physics'."""

    def __init__(self, version: str) -> None:
        vehicle = PlantVehicle("circle", "faithful")
        super().__init__(vehicle)
        self.firmware = Firmware(version)
        controls = BetaflightSitl(vehicle, lambda data: self.plant.take(self.firmware.answer(data)), version)
        self.plant = Plant(vehicle, controls, Delivery(), self._deliver)
        self.radio = Radio(self.firmware)
        self._link = ChannelLink(self.radio, encode_sitl, RATES, THRUST)
        self.pull_after: float | None = None  # s
        self.disarmed_at: float | None = None  # s, after it was armed

    def send(self, command: Command) -> bytes:
        self.radio.pulled = self.pull_after is not None and self.elapsed >= self.pull_after
        return self._link.send(command)

    def sleep_until(self, deadline: float) -> None:
        was_armed = self.plant.vehicle.armed
        super().sleep_until(deadline)
        if was_armed and not self.plant.vehicle.armed and self.disarmed_at is None:
            self.disarmed_at = self.elapsed


def pilot_on(step: SitlStep, laps: int) -> FlightChain:
    vehicle = step.plant.vehicle
    config = ChainConfig(SafetyLimits.of_track(vehicle.track), laps=laps, arm=True)
    return make_chain(PilotFlyer(vehicle.track, "faithful"), vehicle, config)


@pytest.mark.parametrize("version", ["2026.6", "before"])
def test_the_pilot_flies_a_lap_through_the_firmware(version: str) -> None:
    step = SitlStep(version)
    chain = pilot_on(step, laps=1)
    assert step.plant.vehicle.armed is False
    assert step.fly(chain, 50.0, 15.0) == "disarmed: the flight is over"
    assert step.plant.vehicle.gates_passed == step.plant.vehicle.track.num_gates
    assert step.firmware.stamps == {1.0} and step.firmware.refused == 0
    armed = [channels for channels in step.radio.sent if channels[4] == 2000]
    assert armed[0][2] < MIN_CHECK, "armed at low throttle"
    assert np.ptp(np.array(armed)[:, :4], axis=0).min() > 20, "each stick was moved"
    assert not step.firmware.armed and step.radio.sent[-1][4] == 1000


def test_another_dialect_does_not_fly() -> None:
    """What tells the two apart in the guide: with the wrong one it tumbles at once."""
    step = SitlStep("2026.6")
    step.firmware.version = "before"
    chain = pilot_on(step, laps=1)
    assert step.fly(chain, 50.0, 15.0).startswith("cut")
    assert step.plant.vehicle.gates_passed == 0


def test_a_radio_that_is_pulled_out_drops_it_by_the_firmwares_own_failsafe() -> None:
    step = SitlStep("2026.6")
    step.pull_after = 1.5
    step.fly(pilot_on(step, laps=1), 50.0, 15.0)
    assert step.disarmed_at is not None
    assert step.pull_after + FAILSAFE - 0.02 < step.disarmed_at < step.pull_after + FAILSAFE + 0.05
    assert not step.firmware.armed
