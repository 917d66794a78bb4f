"""How long it takes a new user to see an agent fly: a fresh clone, an empty home, no environment, two commands.

    python benchmarks/first_minutes.py --times 3 --json first_minutes.json
    python benchmarks/first_minutes.py --keep PIP_FIND_LINKS --json first_minutes.json    # with wheels in a folder

The commands are `git clone` and `./dev python recipes/fly.py agent=kidney`; they see of this machine its programs and
system libraries, and of its environment variables nothing but PATH and what `--keep` names (a proxy, where packages
come from). So nothing is left of earlier starts: no packages, no pip cache, no byte code, no compiled kernels. The
clone is of this repository's last commit, by git's own transport from this disk: a network's time comes on top.

A record a time: `clone_s`, `environment_s` (until `./dev` has made it) with its `steps_s`, `flight_s` (until video and
map are written), `total_s`, `cpu_s` (user and system of all processes), and `load` (the mean number of processes that
wanted a core in the minute before): on a busy machine the wall clock is an upper bound.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

from measuring import print_table, write_json

ROOT = Path(__file__).resolve().parents[1]
FLY = ("./dev", "python", "recipes/fly.py", "agent=kidney")
SEEN = ("runs/fly/onboard.mp4", "runs/fly/onboard.gif", "runs/fly/top_down.png")
PATHS = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
COLUMNS = ["clone_s", "environment_s", "flight_s", "total_s", "cpu_s", "load", "rendering"]


def main() -> None:
    """Do it as often as asked, each time in folders of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--keep", nargs="*", default=[], metavar="NAME", help="environment variables to hand on")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    kept = {name: os.environ[name] for name in arguments.keep}
    records = []
    for _ in range(arguments.times):
        with tempfile.TemporaryDirectory(prefix="first_minutes_") as folder:
            records.append(begin(Path(folder), {"PATH": PATHS, **kept}))
        print_table(records[-1:], COLUMNS)
        print("  ".join(f"{what}: {seconds}" for what, seconds in records[-1]["steps_s"].items()), flush=True)
        write_json(records, arguments.json)


def begin(folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Clone, make the environment and fly, as somebody does who has nothing yet.

    Raises:
        SystemExit: a command failed, or left nothing to watch.
    """
    home, clone = folder / "home", folder / "dreamer_racing"
    home.mkdir()
    environment |= {"HOME": str(home), "TMPDIR": str(folder)}
    load, spent, begun = os.getloadavg()[0], _cpu_seconds(), time.monotonic()
    subprocess.run(["git", "clone", "-q", ROOT.as_uri(), clone], env=environment, check=True)
    cloned = time.monotonic()
    lines = list(_timed_lines(clone, environment))
    ended = time.monotonic()
    if missing := [name for name in SEEN if not (clone / name).is_file()]:
        raise SystemExit(f"{' '.join(FLY)} left no {', '.join(missing)}:\n" + "\n".join(line for _, line in lines))
    said = [(moment, line) for moment, line in lines if line.startswith("dev: ")]
    ready = next(moment for moment, line in said if "environment ready" in line)
    return {
        "commands": ["git clone", " ".join(FLY)],
        "clone_s": round(cloned - begun, 1),
        "environment_s": round(ready - cloned, 1),
        "flight_s": round(ended - ready, 1),
        "total_s": round(ended - begun, 1),
        "cpu_s": round(_cpu_seconds() - spent, 1),
        "load": round(load, 2),
        "steps_s": _steps(said),
        "rendering": next((line.partition("rendering: ")[2] for _, line in said if "rendering" in line), ""),
        "laps": next(line.removeprefix("laps").strip() for _, line in lines if re.match("laps ", line)),
        "cloned": _revision(clone),
    }


def _revision(clone: Path) -> str:
    """Return the commit that was flown."""
    return subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=clone, text=True).strip()


def _timed_lines(clone: Path, environment: dict[str, str]) -> list[tuple[float, str]]:
    """Run the flight; return what it printed, with the moment of each line."""
    lines = []
    with subprocess.Popen(
        FLY, cwd=clone, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        lines = [(time.monotonic(), line.rstrip()) for line in process.stdout]
    if process.returncode:
        print("\n".join(line for _, line in lines), file=sys.stderr)
        raise SystemExit(f"{' '.join(FLY)}: exit status {process.returncode}")
    return lines


def _steps(said: list[tuple[float, str]]) -> dict[str, float]:
    """Return how long each thing took that `./dev` announced: until it announced the next one."""
    announced = [(moment, line.removeprefix("dev: ").partition(" from ")[0]) for moment, line in said]
    following = pairwise(announced)
    return {what[:40]: round(after - moment, 1) for (moment, what), (after, _) in following if "NOTE" not in what}


def _cpu_seconds() -> float:
    """Return what all ended child processes have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
