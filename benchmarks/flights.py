"""Benchmark of real-time flights with the plant in a separate process: success, speed and latency.

    python benchmarks/flights.py --actors circle kidney figure8 --flights 10 --json flights.json
    python benchmarks/flights.py --actors exports/paper_large --disarmed 15 --plant track=circle

Each flight runs `recipes/plant.py` and `recipes/hil.py`, as a user would in two terminals, for three laps and with its
own seed. The plant is the drone that the agent was trained on; by default, poses have a jitter of up to 2 ms, 1 % loss
and noise of 1 mm and 0.17°.
A flight is finished when every gate of its laps was passed. With --disarmed the loop runs for so many seconds without
arming, which measures the latency of actors that cannot fly. Keep both cores idle meanwhile.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from measuring import make_parser, print_table, write_json

from dreamer_racing.export.agents import agent_path
from dreamer_racing.export.onnx_actor import read_contract

RECIPES = Path(__file__).parents[1] / "recipes"
PLANT = ["jitter=0.002", "packet_loss=0.01", "position_noise=0.001", "attitude_noise=0.003"]
COLUMNS = ("actor", "seed", "finished", "gates", "laps_s", "speed_max", "latency_p99_ms", "jitter_p99_ms", "overruns")
PILOT = "pilot"
LONGEST = 120  # s, timeout of a flight, including the start of both programs


def main() -> None:
    """Fly every actor the given number of times, one flight after another."""
    parser = make_parser(__doc__)
    parser.add_argument("--actors", nargs="+", required=True, help="included agents, paths of exports, or pilot")
    parser.add_argument("--flights", type=int, default=1, help="flights of each actor, with seeds from 1 on")
    parser.add_argument("--laps", type=int, default=3)
    parser.add_argument("--disarmed", type=float, metavar="SECONDS", help="never arm, and end after this time")
    parser.add_argument("--plant", nargs="*", default=PLANT, help="options of recipes/plant.py")
    parser.add_argument("--hil", nargs="*", default=[], help="further options of recipes/hil.py")
    arguments = parser.parse_args()
    records = []
    for actor in arguments.actors:
        for seed in range(1, arguments.flights + 1):
            with tempfile.TemporaryDirectory() as folder:
                records.append(fly(actor, seed, arguments, Path(folder)))
            print_table(records[-1:], COLUMNS)
            write_json(records, arguments.json)


def preset_of(actor: str) -> str:
    """Return the physics preset that an actor was trained with; ``easy`` for the pilot."""
    if actor == PILOT:
        return "easy"
    return str(read_contract(agent_path(actor))["source"].get("preset", "easy"))


def fly(actor: str, seed: int, arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run one flight and return its record.

    Raises:
        RuntimeError: The flight did not start; the message is the output of the loop.
    """
    own = {"track": "circle" if actor == PILOT else Path(actor).name, "preset": preset_of(actor)}
    given = dict(option.split("=", 1) for option in arguments.plant)
    plant = [f"{name}={value}" for name, value in (own | {"seed": seed} | given).items()]
    hil = [f"actor={actor}", f"run_dir={folder}", *arguments.hil]
    if actor == PILOT:  # it has no contract with these
        hil += [option for option in plant if option.startswith(("track=", "preset="))]
    if arguments.disarmed:
        hil += ["arm=false", f"patience={arguments.disarmed:g}"]
    else:
        hil += ["arm=true", f"laps={arguments.laps}", "patience=30", "duration=60"]
    vehicle = subprocess.Popen([sys.executable, str(RECIPES / "plant.py"), *plant], stdout=subprocess.DEVNULL)
    try:
        loop = subprocess.run(
            [sys.executable, str(RECIPES / "hil.py"), *hil],
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
    finally:
        vehicle.send_signal(signal.SIGTERM)
        vehicle.wait()
    if not (folder / "statistics.json").exists():
        raise RuntimeError(f"actor={actor}: {loop.stderr.strip() or loop.stdout.strip()}")
    statistics = json.loads((folder / "statistics.json").read_text(encoding="utf-8"))
    return {
        "actor": actor,
        "seed": seed,
        "finished": not arguments.disarmed and loop.returncode == 0,
        "gates": len(statistics["passes"]),
        "laps_s": [round(lap, 3) for lap in statistics["laps"]],
        "speed_max": None if arguments.disarmed else speed_max(folder),
        "latency_p99_ms": statistics["loop"]["latency"]["p99_ms"],
        "jitter_p99_ms": statistics["loop"]["jitter"]["p99_ms"],
        "overruns": statistics["loop"]["overruns"],
        "plant": plant,
        "hil": hil,
        "ended": statistics["ended"],
        "loop": statistics["loop"],
    }


def speed_max(folder: Path) -> float:
    """Return the highest speed of a recorded flight from its report, m/s."""
    subprocess.run([sys.executable, str(RECIPES / "hil.py"), f"report={folder}"], stdout=subprocess.DEVNULL, check=True)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return float(report["flown"]["speed_max"])


if __name__ == "__main__":
    main()
