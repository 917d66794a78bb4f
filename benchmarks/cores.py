"""Training speed of the default recipe on one core and on two, with acting in turns or in a thread.

    python benchmarks/cores.py --json results/cores.json

Every way trains anew for some env_steps, in turns, as `recipes/dreamer_v3.py track=circle` does on a CPU.
`env_steps_per_s` is over the second half of the runs, when updates are under way, the median of `--rounds`; `least` and
`most` are those of a round. `collect` and `learn` are shares of the main thread's wall-clock time; the rest is the
refresh of contexts and what is logged. Keep the machine idle meanwhile.
"""

import argparse
import csv
import os
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from measuring import print_table, write_json

from dreamer_racing.training.directory import RunDirectory

RECIPE = Path(__file__).parents[1] / "recipes" / "dreamer_v3.py"
COLUMNS = ("cores", "threads", "collector", "env_steps_per_s", "least", "most", "times", "collect", "learn")
LEARNING = ("sample", "world_model", "imagine", "optimise", "improve")


class Way(NamedTuple):
    """How a run uses the machine.

    Attributes:
        cores: Cores it may run on.
        threads: Threads of torch, and of physics and drawing.
        collector: As the recipe's setting.
    """

    cores: int
    threads: int
    collector: str


WAYS = (Way(1, 1, "local"), Way(2, 1, "local"), Way(2, 2, "local"), Way(2, 1, "overlapped"), Way(2, 2, "overlapped"))


def main() -> None:
    """Measure every way that the machine has the cores for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-steps", type=int, default=16_000)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--json")
    parser.add_argument("overrides", nargs="*", help="further settings of the recipe")
    arguments = parser.parse_args()
    available = sorted(os.sched_getaffinity(0))
    ways = [way for way in WAYS if way.cores <= len(available)]
    rounds: dict[Way, list[dict[str, float]]] = {way: [] for way in ways}
    for _ in range(arguments.rounds):
        for way in ways:
            rounds[way].append(measure(way, available[: way.cores], arguments.env_steps, arguments.overrides))
    records: list[dict[str, Any]] = []
    for way in ways:
        speeds = [measured["env_steps_per_s"] for measured in rounds[way]]
        means = {name: statistics.median(measured[name] for measured in rounds[way]) for name in rounds[way][0]}
        first = records[0]["env_steps_per_s"] if records else means["env_steps_per_s"]
        spread = {"least": min(speeds), "most": max(speeds), "times": means["env_steps_per_s"] / first}
        records.append({"benchmark": "cores", **way._asdict(), **means, **spread})
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def measure(way: Way, cores: list[int], env_steps: int, overrides: list[str]) -> dict[str, float]:
    """Train on these cores and read the speed off the run's metrics."""
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [
            sys.executable,
            str(RECIPE),
            "track=circle",
            "device=cpu",
            f"run_dir={run_dir}",
            f"total_env_steps={env_steps}",
            f"collector={way.collector}",
            "evaluation.every=0",
            "checkpoint.every=0",
            *overrides,
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": str(way.threads)}
        bind = partial(os.sched_setaffinity, 0, cores)
        done = subprocess.run(command, env=environment, preexec_fn=bind, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{way} ended with status {done.returncode}:\n{done.stderr[-2000:]}")
        rows = list(csv.DictReader(RunDirectory(run_dir).metrics.open()))
    rows = [row for row in rows if int(row["env_steps"]) > env_steps / 2 and row["wall_clock"]]
    if len(rows) < 3:
        raise SystemExit(f"--env-steps {env_steps} leaves {len(rows)} rows of metrics in the second half: give more.")
    first, last = rows[0], rows[-1]
    rows = rows[1:]  # each is of the time before it
    seconds = float(last["wall_clock"]) - float(first["wall_clock"])
    return {
        "env_steps_per_s": (int(last["env_steps"]) - int(first["env_steps"])) / seconds,
        "updates_per_s": mean(rows, "rate/updates"),
        "collect": mean(rows, "time/collect"),
        "learn": sum(mean(rows, f"time/{name}") for name in LEARNING),
    }


def mean(rows: list[dict[str, str]], column: str) -> float:
    """Average a column over the rows that have it."""
    values = [float(row[column]) for row in rows if row.get(column)]
    return sum(values) / len(values) if values else 0.0


if __name__ == "__main__":
    main()
