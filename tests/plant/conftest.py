from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import print_settings
from dreamer_racing.hil.betaflight.firmware import find_firmware
from dreamer_racing.plant.firmware_step import SteppedFirmware
from dreamer_racing.plant.vehicle import PlantVehicle

CONTRACT = Path(__file__).parents[2] / "agents" / "circle" / "contract.json"
YAW = ("set p_yaw = 30", "set i_yaw = 5")  # of link=betaflight_sitl: the plant's rotors have no torque of speeding up


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
