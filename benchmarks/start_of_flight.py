"""Three laps in the loop, in lock step, by how a flight begins and how late poses are.

    python benchmarks/start_of_flight.py --actor exports/figure8 --preset faithful --json start_of_flight.json

On its stand a vehicle shows an actor the first image again and again, until the loop sees that it moves: with poses
that are late, and a vehicle that answers late, the actor's first action is flown for two or three ticks instead of one.
`--lift 0` is that; with `--lift 1.35`, the default of `recipes/hil.py`, it is lifted straight up with ever more thrust,
up to so many times its weight, until it rises, and the actor begins then. Poses are otherwise as
`recipes/sim_to_real.py` has them.
"""

import argparse
import dataclasses
from pathlib import Path

from measuring import print_table, write_json

from dreamer_racing.hil.chain import LIFT, ChainConfig
from dreamer_racing.hil.flyer import ActorFlyer, trained_track
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.plant.lock_step import LockStep, make_chain
from dreamer_racing.plant.study import LIMITS, USUAL
from dreamer_racing.plant.vehicle import PlantVehicle

LATENCIES = (0.0, 0.005, 0.01, 0.02, 0.03)  # s, of poses
LONGEST = 30.0  # s of a flight


def main() -> None:
    """Fly every latency so often, from the stand as it is and lifted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--actor", type=Path, required=True, help="folder of an agent or of an export")
    parser.add_argument("--preset", default="faithful", help="physics of the vehicle")
    parser.add_argument(
        "--lift", type=float, nargs="+", default=[0.0, LIFT], help="weights; 0: the actor from the stand"
    )
    parser.add_argument("--flights", type=int, default=2, help="of each, with different noise")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = []
    for lift in arguments.lift:
        flyer = ActorFlyer(arguments.actor)
        for latency in LATENCIES:
            flights = [fly(flyer, arguments.preset, lift, latency, seed) for seed in range(arguments.flights)]
            gates, ended = zip(*flights, strict=True)
            records.append(
                {"preset": arguments.preset, "lift": lift, "latency_s": latency, "gates": gates, "ended": ended}
            )
            print_table([records[-1]], list(records[-1])[:-1])
    write_json(records, arguments.json)


def fly(flyer: ActorFlyer, preset: str, lift: float, latency: float, seed: int) -> tuple[int, str]:
    """Fly three laps; return the gates passed, and why the flight ended."""
    vehicle = PlantVehicle(trained_track(flyer.contract), preset)
    limits = SafetyLimits.of_track(vehicle.track, **LIMITS)
    chain = make_chain(flyer, vehicle, ChainConfig(limits, laps=vehicle.track.laps, arm=True, lift=lift))
    try:
        plant = LockStep(vehicle, dataclasses.replace(USUAL, seed=seed, latency=latency))
        ended = plant.fly(chain, flyer.rate, LONGEST)
    finally:
        chain.close()
    return vehicle.gates_passed, ended


if __name__ == "__main__":
    main()
