"""What the PPO of others learns on Circle from numbers: three examples run to their ends, learning curves and races.

    python benchmarks/front_doors.py --folder results/front_doors
    python benchmarks/front_doors.py --folder /tmp/doors --examples sb3 --env-steps 500000

Every example is run as a user runs it, and read as it prints. The folder gets two files for each, the curve as CSV
(`env_steps`, `seconds` since its start, `return` and `gates` of training episodes since the row before; of
Stable-Baselines3, of the latest hundred) and as JSON what became of 100 noisy starts at the end; and a picture of all
curves that are there.
"""

import argparse
import csv
import math
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from measuring import print_table, write_json

EXAMPLES = {"cleanrl": "CleanRL-style", "ppo": "TorchRL", "sb3": "Stable-Baselines3"}
CURVE = ("env_steps", "seconds", "return", "gates")
PROGRESS = re.compile(r"(\d+) steps: return (-?[\d.]+), ([\d.]+) gates an episode")
RACES = re.compile(r"(sampled|mean) actions: three laps from (\d+) of (\d+) noisy starts, (nan|[\d.]+) s a lap")


def main() -> None:
    """Run the examples, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--examples", nargs="*", choices=EXAMPLES, default=list(EXAMPLES))
    parser.add_argument("--env-steps", type=int, default=1_500_000)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.examples:
        curve, record = run(name, arguments.env_steps)
        with (arguments.folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([CURVE, *curve])
        write_json([record], str(arguments.folder / f"{name}.json"))
        print_table([record], list(record))
    draw(arguments.folder)


def run(name: str, env_steps: int) -> tuple[list[tuple[float, ...]], dict[str, Any]]:
    """Run an example; return its learning curve and what its races came to."""
    command = ["python", f"examples/{name}.py", "--env-steps", str(env_steps)]
    curve: list[tuple[float, ...]] = []
    races: dict[str, re.Match[str]] = {}
    begun = time.monotonic()
    with subprocess.Popen([sys.executable, *command[1:]], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if row := PROGRESS.match(line):
                curve.append((int(row[1]), round(time.monotonic() - begun, 1), float(row[2]), float(row[3])))
            if flown := RACES.match(line):
                races[flown[1]] = flown
    if process.returncode or len(races) != 2:
        raise SystemExit(f"{' '.join(command)}: exit status {process.returncode}")
    return curve, {
        "example": name,
        "command": " ".join(command),
        "env_steps": curve[-1][0],
        "training_s": curve[-1][1],
        **{key: value for actions, flown in races.items() for key, value in _outcome(actions, flown).items()},
    }


def _outcome(actions: str, flown: re.Match[str]) -> dict[str, Any]:
    """Return what flights by sampled or by mean actions came to; the first under plain names."""
    prefix = "" if actions == "sampled" else f"{actions}_"
    lap = float(flown[4])
    return {
        f"{prefix}finished": int(flown[2]),
        f"{prefix}starts": int(flown[3]),
        f"{prefix}lap_s": None if math.isnan(lap) else lap,
    }


def draw(folder: Path) -> None:
    """Draw the curves that a folder has."""
    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, column, label in zip(
        figure.subplots(1, 2), (2, 3), ("Return (training episodes)", "Gates (training episodes)"), strict=True
    ):
        for name, title in EXAMPLES.items():
            if (path := folder / f"{name}.csv").exists():
                curve = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
                axes.plot(curve[:, 0] / 1e6, curve[:, column], label=title)
        axes.set(xlabel="env_steps (millions)", ylabel=label)
        axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(folder / "curves.png", dpi=100)


if __name__ == "__main__":
    main()
