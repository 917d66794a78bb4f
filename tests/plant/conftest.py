from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import print_settings, rate_map
from dreamer_racing.hil.betaflight.firmware import find_firmware
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.plant.lock_step import FirmwareStep, SteppedFirmware
from dreamer_racing.plant.vehicle import PlantVehicle

CONTRACT = Path(__file__).parents[2] / "agents" / "circle" / "contract.json"
RATES = rate_map(read_contract(CONTRACT))
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)  # the faithful drone's
YAW = ("set p_yaw = 30", "set i_yaw = 5")  # of link=betaflight_sitl: the plant's rotors have no torque of speeding up


def chain_of(step: FirmwareStep, flyer: Flyer, laps: int) -> FlightChain:
    track = step.plant.vehicle.track
    return FlightChain(flyer, track, ChainConfig(SafetyLimits.of_track(track), laps=laps, arm=True))


@pytest.fixture(scope="session")
def vehicle() -> PlantVehicle:
    """A drone without delay; a test gets it from `fresh`."""
    return PlantVehicle("circle", "easy")


@pytest.fixture
def fresh(vehicle: PlantVehicle) -> PlantVehicle:
    """The drone on its stand."""
    vehicle.reset()
    return vehicle


@pytest.fixture(scope="session")
def program() -> Path:
    """A real Betaflight, or the tests of one are skipped."""
    try:
        return find_firmware()
    except FileNotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def set_up(program: Path) -> Iterator[Callable[[str], SteppedFirmware]]:
    """Gives the firmware of a link, set up once and started anew."""
    firmwares: dict[str, SteppedFirmware] = {}

    def start(link: str = "betaflight_sitl") -> SteppedFirmware:
        if link not in firmwares:
            firmwares[link] = SteppedFirmware(program, [*print_settings(read_contract(CONTRACT), link), *YAW])
        firmwares[link].start()
        return firmwares[link]

    yield start
    for firmware in firmwares.values():
        firmware.close()
