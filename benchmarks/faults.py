"""What a training run survives: kills, damaged files, a disk that fills up, a reward that is not finite, a clock.

    OMP_NUM_THREADS=1 python benchmarks/faults.py --kills 50 --json results/faults.json

Every case is a short training by `recipes/dreamer_v3.py` in a process of its own, disturbed in one way and resumed to
its end. It *survived* if the last checkpoint then holds what that of an undisturbed run holds, bit for bit, and the
rows of metrics.csv, wall clock aside, are the same. Kinds of faults:

* `kill`: SIGKILL at a random time after the start, as often as asked;
* `kill at rename`, `kill at fsync`: SIGKILL just before or just after the n-th of them;
* `damage`: 16 bytes in the middle of a file of the newest checkpoint are turned, each file in turn;
* `full disk`: no file can grow beyond some size from the n-th checkpoint on (`RLIMIT_FSIZE`), until it is resumed;
* `clock`: the wall clock stands still, or goes backwards;
* `not finite`: a reward is infinite; it is to end with exit status 1 and the checkpoint before it whole.
"""

import argparse
import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from measuring import print_table, write_json

from dreamer_racing.training.checkpoint import CHECKSUMS
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

RECIPE = Path(__file__).parents[1] / "recipes" / "dreamer_v3.py"
SETTINGS = [
    "track=circle", "tuned=none", "model=debug", "model.batch_size=2", "model.batch_length=8", "model.replay_ratio=4",
    "env.num_envs=4", "env.episode_steps=40", "prefill=64", "replay.capacity=600",
    "evaluation.every=400", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=200",
    "checkpoint.keep=2", "logger.every=200", "logger=csv", "device=cpu", "total_env_steps=1200",
]  # fmt: skip
KINDS = ("kill", "rename", "fsync", "damage", "disk", "clock", "not_finite")
CLOCKS = ("time/", "rate/", "wall_clock")  # columns that a wall clock writes
COUNT_CALLS = """
import os, signal
def counted(function, name, last, after):
    def call(*args, **kwargs):
        calls[name] += 1
        if calls[name] == last and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*args, **kwargs)
        if calls[name] == last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    return call
calls = dict(replace=0, fsync=0)
os.{name} = counted(os.{name}, "{name}", {last}, {after})
"""
PRINT_CALLS = COUNT_CALLS + "\nimport atexit\natexit.register(lambda: print('calls', calls['{name}']))\n"
FULL = """
import os, resource, signal
from dreamer_racing.training import checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
saved = checkpoint.RunCheckpoints.save
def save(self, *args, **kwargs):
    if {first} <= len(list(self.directory.glob("checkpoint-*"))):
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    try:
        return saved(self, *args, **kwargs)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
checkpoint.RunCheckpoints.save = save
"""
STILL = "import time\ntime.time = lambda: 1e9\n"
BACKWARDS = "import itertools, time\nticks = itertools.count()\ntime.time = lambda: 1e9 - next(ticks)\n"
INFINITE = """
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
step, steps = DroneRacingEnv._step, []
def poisoned(env, tensordict):
    steps.append(0)
    data = step(env, tensordict)
    return data if len(steps) < 150 else data.set("reward_base", data["reward_base"] + float("inf"))
DroneRacingEnv._step = poisoned
"""


def main() -> None:
    """Disturb runs in every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--kills", type=int, default=50, help="at random times")
    parser.add_argument("--calls", type=int, default=10, help="renames, and fsyncs, to be killed at")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    draw = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        arena = Arena(Path(folder))
        ways: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {
            "kill": lambda: arena.kills(arguments.kills, draw),
            "rename": lambda: arena.kills_at_calls("replace", arguments.calls),
            "fsync": lambda: arena.kills_at_calls("fsync", arguments.calls),
            "damage": arena.damages,
            "disk": arena.full_disks,
            "clock": arena.clocks,
            "not_finite": arena.not_finite,
        }
        cases = [case for kind in arguments.faults for case in ways[kind]()]
    all_cases = Counter(case["fault"] for case in cases)
    survived = Counter(case["fault"] for case in cases if case["survived"])
    counts = [{"fault": kind, "cases": number, "survived": survived[kind]} for kind, number in all_cases.items()]
    print_table(counts, ["fault", "cases", "survived"])
    for case in cases:
        if not case["survived"]:
            print(f"{case['fault']}, {case['where']}: {case['differs']}")
    write_json([{"benchmark": "faults", **case} for case in cases], arguments.json)


class Arena:
    """Undisturbed and disturbed runs in one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = 0
        self._whole = folder / "whole"
        begun = time.monotonic()
        self._run("run_dir=whole", *SETTINGS)
        self._seconds = time.monotonic() - begun
        print(f"an undisturbed run takes {self._seconds:.0f} s", flush=True)

    def kills(self, number: int, draw: random.Random) -> Iterator[dict[str, Any]]:
        """Kill so often at random times, resume after each; a run that comes to its end gives way to another."""
        killed = 0
        while killed < number:
            name, kills = self._name(), 0  # of this run
            while killed < number:
                process = self._start(*self._arguments(name))
                try:
                    process.communicate(timeout=draw.uniform(0.3, 1.0) * self._seconds)
                    break
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.communicate()
                    killed, kills = killed + 1, kills + 1
            else:
                self._run(*self._arguments(name))
            yield from [self._verdict("kill", f"one of {kills} kills of a run", name)] * kills

    def kills_at_calls(self, function: str, number: int) -> Iterator[dict[str, Any]]:
        """Kill before and after some calls of a function of `os`, spread over the run."""
        name = self._name()
        printed = self._run(
            *self._arguments(name), before=PRINT_CALLS.format(name=function, last=0, after=False)
        ).stdout
        total = int(printed.rpartition("calls ")[2].split()[0])
        label = "kill at rename" if function == "replace" else f"kill at {function}"
        for index in range(number):
            last, after = 1 + index * total // number, index % 2 == 1
            name = self._name()
            before = COUNT_CALLS.format(name=function, last=last, after=after)
            process = self._start(*self._arguments(name), before=before)
            process.communicate()
            was_killed = process.returncode == -signal.SIGKILL
            self._run(*self._arguments(name))
            where = f"{'after' if after else 'before'} call {last} of {total}"
            yield self._verdict(label, where, name, "" if was_killed else "it was not killed")

    def damages(self) -> Iterator[dict[str, Any]]:
        """Damage each file of the newest of two checkpoints, and go on."""
        stopped = self._name()
        self._run(f"run_dir={stopped}", *SETTINGS, "total_env_steps=800")
        newest = latest_checkpoint(self._folder / stopped)
        files = sorted(path.relative_to(newest) for path in newest.rglob("*") if path.is_file())
        for file in files:
            name = self._name()
            shutil.copytree(self._folder / stopped, self._folder / name)
            path = latest_checkpoint(self._folder / name) / file
            content = bytearray(path.read_bytes())
            middle = len(content) // 2
            content[middle : middle + 16] = bytes(255 - byte for byte in content[middle : middle + 16])
            path.write_bytes(content)
            done = self._run(f"resume={name}", "total_env_steps=1200")
            said = done.stdout + done.stderr
            named = "is damaged" in said or "not complete" in said
            yield self._verdict("damage", str(file), name, "" if named else "the damage was not said")

    def full_disks(self) -> Iterator[dict[str, Any]]:
        """Let no file grow while checkpoints are written, from the second or from the third on."""
        for first in (1, 2):
            name = self._name()
            done = self._start(*self._arguments(name), before=FULL.format(first=first))
            _, printed = done.communicate()
            said = "NOT SAVED" in printed or "could not be written" in printed
            self._run(f"resume={name}")
            yield self._verdict("full disk", f"from checkpoint {first + 1} on", name, "" if said else "it was not said")

    def clocks(self) -> Iterator[dict[str, Any]]:
        """Stop the wall clock, or let it go backwards."""
        for where, before in (("stands still", STILL), ("goes backwards", BACKWARDS)):
            name = self._name()
            self._run(*self._arguments(name), before=before)
            yield self._verdict("clock", where, name)

    def not_finite(self) -> Iterator[dict[str, Any]]:
        """Poison a reward; the run is to end, and its checkpoint to be continued without the poison."""
        name = self._name()
        process = self._start(*self._arguments(name), before=INFINITE)
        _, printed = process.communicate()
        ended = process.returncode == 1 and "is not finite" in printed and "Traceback" not in printed
        self._run(f"resume={name}")
        yield self._verdict("not finite", "reward", name, "" if ended else f"exit status {process.returncode}")

    def _name(self) -> str:
        self._number += 1
        return f"run{self._number}"

    def _arguments(self, name: str) -> list[str]:
        """Return what begins a run, or continues it once it has a checkpoint."""
        try:
            latest_checkpoint(self._folder / name)
        except FileNotFoundError:
            shutil.rmtree(self._folder / name, ignore_errors=True)
            return [f"run_dir={name}", *SETTINGS]
        return [f"resume={name}"]

    def _start(self, *overrides: str, before: str = "") -> subprocess.Popen[str]:
        program = [str(RECIPE)]
        if before:
            start = f"import runpy, sys\nsys.path.insert(0, {str(RECIPE.parent)!r})\nsys.argv[0] = {str(RECIPE)!r}\n"
            program = ["-c", f"{start}{before}\nrunpy.run_path({str(RECIPE)!r}, run_name='__main__')"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, *program, *overrides],
            cwd=self._folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def _run(self, *overrides: str, before: str = "") -> subprocess.CompletedProcess[str]:
        """Run to the end."""
        process = self._start(*overrides, before=before)
        printed = process.communicate()
        if process.returncode:
            raise RuntimeError(f"{' '.join(overrides)} ended with {process.returncode}: {printed[1][-2000:]}")
        return subprocess.CompletedProcess([], 0, *printed)

    def _verdict(self, fault: str, where: str, name: str, otherwise: str = "") -> dict[str, Any]:
        differs = otherwise or difference(self._whole, self._folder / name)
        print(f"{fault}, {where}: {differs or 'survived'}", flush=True)
        return {"fault": fault, "where": where, "survived": not differs, "differs": differs}


def difference(whole: Path, other: Path) -> str:
    """Say in what two runs' ends differ; nothing if they do not."""
    if (state := state_of(whole)).keys() != (found := state_of(other)).keys():
        return f"parts {sorted(state.keys() ^ found.keys())}"
    for name, value in state.items():
        if not same(value, found[name]):
            return f"checkpoint: {name}"
    rows, others = rows_of(whole), rows_of(other)
    if len(rows) != len(others):
        return f"metrics.csv has {len(others)} rows, not {len(rows)}"
    columns = {column for row, own in zip(rows, others, strict=True) for column in row if row[column] != own[column]}
    return f"metrics.csv: {', '.join(sorted(columns))}" if columns else ""


def state_of(run_dir: Path) -> dict[str, Any]:
    """Return what the last checkpoint of a run holds, by file."""
    newest, found = latest_checkpoint(run_dir), {}
    for path in sorted(newest.rglob("*")):
        name = path.relative_to(newest).as_posix()
        if path.suffix == ".pt":
            found[name] = torch.load(path, weights_only=True)
        elif path.suffix in (".zst", ".json") and path.name not in ("manifest.json", CHECKSUMS):
            found[name] = path.read_bytes()
    return found


def same(first: Any, second: Any) -> bool:
    """Whether two states are equal, bit for bit."""
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    return bool(first == second)


def rows_of(run_dir: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics without what a clock writes."""
    with RunDirectory(run_dir).metrics.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if not name.startswith(CLOCKS)} for row in rows]


if __name__ == "__main__":
    main()
