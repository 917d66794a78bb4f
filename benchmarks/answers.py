"""How long one waits for `--help` of every recipe, and for the doctor.

    python benchmarks/answers.py --json answers.json

A record a command: the median over `--times` of `seconds`, the wall clock, and of `cpu_s`, user and system of the
process and those that it started. On a busy machine the second says what the first would be on an idle one, but for
waiting: the doctor watches OpenGL draw for one second, which is part of its wall clock whatever the machine does.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from measuring import print_table, write_json

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = ["command", "seconds", "cpu_s", "times", "load"]


def main() -> None:
    """Ask every recipe."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=5)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    asked = [(f"recipes/{path.name}", "--help") for path in sorted((ROOT / "recipes").glob("*.py"))]
    records = [measure(command, arguments.times) for command in [*asked, ("recipes/doctor.py",)]]
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def measure(command: tuple[str, ...], times: int) -> dict[str, Any]:
    """Run a command several times.

    Raises:
        SystemExit: it failed, other than by what the doctor finds wrong here.
    """
    load, walls, cpus = os.getloadavg()[0], [], []
    for _ in range(times):
        before, begun = _cpu_seconds(), time.monotonic()
        done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True)
        walls.append(time.monotonic() - begun)
        cpus.append(_cpu_seconds() - before)
        if done.stderr or not done.stdout:
            raise SystemExit(f"{' '.join(command)}: exit status {done.returncode}\n{done.stderr}")
    return {
        "command": " ".join(("python", *command)),
        "seconds": round(statistics.median(walls), 2),
        "cpu_s": round(statistics.median(cpus), 2),
        "times": times,
        "load": round(load, 2),
    }


def _cpu_seconds() -> float:
    """Return what all ended child processes have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
