"""What a training run survives: kills, signals, damaged files, a full disk, a reward that is not finite, a clock.

    OMP_NUM_THREADS=1 python tests/robustness/faults.py --kills 50 --json results/faults.json

Every case is a short training by `recipes/dreamer_v3.py` in processes of its own, disturbed in one way and continued
to its end: by the same command as long as it has no checkpoint, then by `resume=`. It *survived* if the last checkpoint
then holds what that of an undisturbed run holds, bit for bit, the rows of metrics.csv, wall clock aside, are the same,
no process left a traceback or another exit status than it should, and what was lost was said. The methods of `Arena`
say what they do to a run. The exit status is 1 if any case was not survived, and the last lines say which.
"""

import argparse
import contextlib
import csv
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from dreamer_racing.machine import provenance  # noqa: E402
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint  # noqa: E402
from dreamer_racing.training.publishing import CHECKSUMS  # noqa: E402
from tests.forked import recipe  # noqa: E402

RECIPE = ROOT / "recipes" / "dreamer_v3.py"
SETTINGS = [
    "track=circle", "tuned=none", "model=debug", "model.batch_size=2", "model.batch_length=8", "model.replay_ratio=1",
    "env.num_envs=4", "env.episode_steps=40", "prefill=64", "replay.capacity=600",
    "evaluation.every=400", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=200",
    "checkpoint.keep=2", "logger.every=200", "logger=csv", "device=cpu", "seed=3",
    "total_env_steps=1200",
]  # fmt: skip
TO_THE_END = SETTINGS[-1]
HALF_WAY = "total_env_steps=800"  # at an evaluation, so that this end leaves no row that a longer run has not
CLOCKS = ("time/", "rate/", "wall_clock", "cpu_clock")  # columns that clocks write
REFUSED = 2
HUNG = 124  # as of `timeout`
COUNT_CALLS = """
import atexit, builtins, io, os, signal
from dreamer_racing.training import checkpoint
calls, before_a_checkpoint = 0, []
def count(last={last}):
    global calls
    calls += 1
    if calls == last:
        os.kill(os.getpid(), signal.SIGKILL)
def counted(function):
    def call(*args, **kwargs):
        count()
        return function(*args, **kwargs)
    return call
def counted_open(file, mode="r", *args, opened=open, **kwargs):
    result = opened(file, mode, *args, **kwargs)
    if set(mode) & set("wax+") and isinstance(file, (str, os.PathLike)):
        count()
    return result
def save(*args, saved=checkpoint.RunCheckpoints.save, **kwargs):
    before_a_checkpoint.append(calls)
    return saved(*args, **kwargs)
checkpoint.RunCheckpoints.save = save
if "{name}" == "open":
    io.open = builtins.open = counted_open  # the former is what pathlib calls
elif "{name}" == "rename":
    os.replace, os.rename = counted(os.replace), counted(os.rename)
else:
    os.fsync = counted(os.fsync)
atexit.register(lambda: print("calls", *before_a_checkpoint[:1], calls))
"""
FULL = """
import os, resource, signal
from dreamer_racing.training import checkpoint
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
saved = checkpoint.RunCheckpoints.save
def save(self, *args, **kwargs):
    if {first} <= len(list(self.directory.glob("checkpoint-*"))):
        resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, resource.RLIM_INFINITY))
    try:
        return saved(self, *args, **kwargs)
    finally:
        if not {stays}:
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
KINDS = ("kill", "by_clock", "early", "open", "rename", "fsync", "sigterm", "damage", "disk", "clock", "not_finite")
Case = dict[str, Any]


def main() -> None:
    """Disturb runs in every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--kills", type=int, default=50, help="at random times; a fifth as many by the clock")
    parser.add_argument("--sigterms", type=int, default=10, help="at random times")
    parser.add_argument("--most", type=int, help="of the cases of the other kinds, spread evenly; all if left out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="written after each case")
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"  # of every process to come, so that all compute the same
    where, cases = provenance(), []
    with tempfile.TemporaryDirectory() as folder:
        arena = Arena(Path(folder))
        for kind in arguments.faults:
            for case in arena.cases(kind, arguments):
                cases.append({"benchmark": "faults", **case, **where})
                if arguments.json:
                    arguments.json.write_text(json.dumps(cases, indent=1) + "\n")
    survived = Counter(case["fault"] for case in cases if case["survived"])
    for fault, number in Counter(case["fault"] for case in cases).items():
        print(f"{fault}: {survived[fault]} of {number} survived")
    if failed := [f"{case['fault']}, {case['where']}: {case['differs']}" for case in cases if not case["survived"]]:
        raise SystemExit("not survived:\n" + "\n".join(failed))


class Arena:
    """Undisturbed and disturbed runs in one folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = 0
        begun = time.monotonic()
        with self._start(*self._arguments("whole")) as process:
            _, said = process.communicate()
        if problem := trouble(process.returncode, said):
            raise SystemExit(f"the undisturbed run: {problem}")
        self._seconds = time.monotonic() - begun
        self._limit = 10 * self._seconds + 60
        self._whole = folder / "whole"
        if latest_checkpoint(RunDirectory(self._whole).best.path).name != latest_checkpoint(self._whole).name:
            print("the undisturbed run replaces no best at its end, so no kill meets that: try another seed")
        print(f"an undisturbed run takes {self._seconds:.0f} s", flush=True)

    def cases(self, kind: str, asked: argparse.Namespace) -> Iterator[Case]:
        """Yield the cases of one of the `KINDS`, as many as is asked."""
        draw, most, by_clock = random.Random(asked.seed), asked.most, "checkpoint.minutes=1e-6"  # after every rollout
        ways: dict[str, Iterator[Case]] = {  # generators, of which one will run
            "kill": self.kills("kill", asked.kills, draw),
            "by_clock": self.kills("kill by the clock", max(1, asked.kills // 5), draw, by_clock),
            "early": self.early_kills(most),
            **{name: self.kills_at_calls(name, most, draw) for name in ("open", "rename", "fsync")},
            "sigterm": self.terminations(asked.sigterms, draw),
            "damage": self.damages(most),
            "disk": self.full_disks(),
            "clock": self.clocks(),
            "not_finite": self.not_finite(),
        }
        return ways[kind]

    def kills(self, fault: str, number: int, draw: random.Random, *settings: str) -> Iterator[Case]:
        """Kill so often at random times, go on after each; a run that comes to its end gives way to another."""
        killed, limit = 0, self._seconds
        while killed < number:
            name, kills, problem = self._name(), 0, ""  # of this run
            while killed < number and not problem:
                begun = time.monotonic()
                with self._start(*self._arguments(name, *settings)) as process:
                    try:
                        _, said = process.communicate(timeout=draw.uniform(0.05, 1.0) * limit)
                        problem = trouble(process.returncode, said)
                        if not kills:
                            limit = min(limit, time.monotonic() - begun)  # the machine may have become faster
                        break
                    except subprocess.TimeoutExpired:
                        process.kill()
                        process.communicate()
                        killed, kills = killed + 1, kills + 1
            problem = problem or self._to_its_end(name, *settings)
            if problem and not kills:
                raise SystemExit(f"{fault}: a run that was not killed: {problem}")
            yield from [self._verdict(fault, f"one of {kills} kills of a run", name, problem)] * kills

    def early_kills(self, most: int | None) -> Iterator[Case]:
        """Kill a new run at every file it opens for writing before its first checkpoint; then repeat the command."""
        name = self._name()
        done = self._run(f"run_dir={name}", *SETTINGS, before=COUNT_CALLS.format(name="open", last=0))
        before_a_checkpoint = int(done.stdout.rpartition("calls ")[2].split()[0])
        for call in spread(range(1, before_a_checkpoint + 1), most):
            where, before = f"after opening {call} of {before_a_checkpoint}", COUNT_CALLS.format(name="open", last=call)
            yield self._disturbed_verdict("kill early", where, self._name(), before=before, status=-signal.SIGKILL)
        name = self._half_way()
        again = self._run(f"run_dir={name}", *SETTINGS)
        advised = again.returncode == REFUSED and f"continue it with resume={name}" in again.stderr
        problem = trouble(again.returncode, again.stderr, REFUSED) or ("" if advised else "it did not say how to go on")
        problem = problem or self._to_its_end(name)
        yield self._verdict("kill early", "the same command where a checkpoint is", name, problem)

    def kills_at_calls(self, function: str, most: int | None, draw: random.Random) -> Iterator[Case]:
        """Kill at calls of a function in the second half of a run, in a random order."""
        name = self._half_way()
        done = self._run(f"resume={name}", TO_THE_END, before=COUNT_CALLS.format(name=function, last=0))
        total = int(done.stdout.rpartition("calls ")[2].split()[-1])
        calls = spread(range(1, total + 1), most)
        for call in draw.sample(calls, len(calls)):
            where, before = f"call {call} of {total}", COUNT_CALLS.format(name=function, last=call)
            yield self._disturbed_verdict(
                f"kill at {function}", where, self._half_way(), before=before, status=-signal.SIGKILL
            )

    def terminations(self, number: int, draw: random.Random) -> Iterator[Case]:
        """Ask a process to end at a random time; one that has ended before that is no case."""
        cases, limit = 0, self._seconds
        while cases < number:
            name, at = self._name(), draw.uniform(0.05, 0.9) * limit
            begun = time.monotonic()
            with self._start(f"run_dir={name}", *SETTINGS) as process:
                try:
                    process.communicate(timeout=at)
                    limit = min(limit, time.monotonic() - begun)
                    continue
                except subprocess.TimeoutExpired:
                    process.terminate()
                    printed, said = process.communicate(timeout=self._limit)
            cases += 1
            saved = "saved; continue with resume=" in printed
            # Python's own answer to the signal while modules are still being loaded is to die of it.
            expected = 128 + signal.SIGTERM if saved or process.returncode >= 0 else -signal.SIGTERM
            problem = trouble(process.returncode, said, expected) or self._to_its_end(name)
            where = f"after {at:.1f} of {self._seconds:.0f} s, {'saved' if saved else 'before there was a run to save'}"
            yield self._verdict("SIGTERM", where, name, problem)

    def damages(self, most: int | None) -> Iterator[Case]:
        """Damage each file of the newest of two checkpoints in each way, and go on."""
        newest = latest_checkpoint(self._folder / self._half_way())
        files = sorted(path.relative_to(newest) for path in newest.rglob("*") if path.is_file())
        for way, file in spread([(way, file) for file in files for way in (turn, cut, Path.unlink)], most):
            name = self._half_way()
            way(latest_checkpoint(self._folder / name) / file)
            named = f"{newest.name} is damaged|not a complete checkpoint"
            yield self._disturbed_verdict("damage", f"{way.__name__} {file}", name, named, "is lost")

    def full_disks(self) -> Iterator[Case]:
        """Let no file grow while checkpoints are written, or ever after, from the second or from the third on."""
        for first in (1, 2):
            for stays, size, what in ((False, 4096, "checkpoints"), (True, 512, "any file")):
                where, words = f"{what}, from checkpoint {first + 1} on", ("NOT SAVED", "could not be written")
                before = FULL.format(first=first, size=size, stays=stays)
                yield self._disturbed_verdict("full disk", where, self._name(), *words, before=before, status=1)

    def clocks(self) -> Iterator[Case]:
        """Stop the wall clock, or let it go backwards."""
        for where, before in (("stands still", STILL), ("goes backwards", BACKWARDS)):
            yield self._disturbed_verdict("clock", where, self._name(), before=before)

    def not_finite(self) -> Iterator[Case]:
        """Poison a reward; the run is to end, and its checkpoint to be continued without the poison."""
        words = "is not finite"
        yield self._disturbed_verdict("not finite", "reward", self._name(), words, before=INFINITE, status=1)

    def _name(self) -> str:
        self._number += 1
        return f"run{self._number}"

    def _half_way(self) -> str:
        """Make a copy of a run that was ended half way, with two checkpoints."""
        template = self._folder / "half"
        if not template.exists():
            done = self._run("run_dir=half", *SETTINGS, HALF_WAY)
            if problem := trouble(done.returncode, done.stderr):
                raise SystemExit(f"half of an undisturbed run: {problem}")
        name = self._name()
        shutil.copytree(template, self._folder / name)
        return name

    def _arguments(self, name: str, *settings: str) -> list[str]:
        """Return what begins a run, also once more where one left no checkpoint, or else continues it."""
        with contextlib.suppress(FileNotFoundError):
            latest_checkpoint(self._folder / name)
            return [f"resume={name}", TO_THE_END]
        return [f"run_dir={name}", *SETTINGS, *settings]

    def _start(self, *overrides: str) -> subprocess.Popen[str]:
        """Start a process that is disturbed by the clock, which is to find it while it imports, too."""
        return subprocess.Popen(
            [sys.executable, str(RECIPE), *overrides],
            cwd=self._folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def _run(self, *overrides: str, before: str = "") -> subprocess.CompletedProcess[str]:
        """Run until it ends, forked off one that has imported; what hangs is ended, with a status of its own."""
        try:
            return recipe(RECIPE.stem, *overrides, cwd=self._folder, timeout=self._limit, before=before)
        except subprocess.TimeoutExpired as late:
            said = f"it hung for {self._limit:.0f} s: {late.stderr!r}"
            return subprocess.CompletedProcess(overrides, HUNG, "", said)

    def _to_its_end(self, name: str, *settings: str) -> str:
        """Begin or continue a run and let it be; return what is wrong with how it ends, or nothing."""
        done = self._run(*self._arguments(name, *settings))
        return trouble(done.returncode, done.stderr)

    def _disturbed_verdict(
        self, fault: str, where: str, name: str, *words: str, before: str = "", status: int = 0
    ) -> Case:
        """Begin or continue a run, disturbed by lines of Python before it, and let it come to its end; then compare.

        The disturbed process must say some words, given as patterns, on either stream, and end with a
        status; 0 is the end of the run.
        """
        done = self._run(*self._arguments(name), before=before)
        unsaid = [pattern for pattern in words if not re.search(pattern, done.stdout + done.stderr)]
        problem = trouble(done.returncode, done.stderr, status) or (f"it did not say {unsaid}" if unsaid else "")
        return self._verdict(fault, where, name, problem or (self._to_its_end(name) if status else ""))

    def _verdict(self, fault: str, where: str, name: str, problem: str) -> Case:
        """Compare a run that has come to its end with the undisturbed one, and forget it unless they differ."""
        differs = problem or difference(self._whole, self._folder / name)
        print(f"{fault}, {where}: {differs or 'survived'}", flush=True)
        if not differs:
            shutil.rmtree(self._folder / name)
        return {"fault": fault, "where": where, "survived": not differs, "differs": differs}


def turn(file: Path) -> None:
    """Turn the bits of 16 bytes in the middle."""
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 16] = bytes(255 - byte for byte in content[middle : middle + 16])
    file.write_bytes(content)


def cut(file: Path) -> None:
    """Cut off the second half."""
    os.truncate(file, file.stat().st_size // 2)


def spread(cases: Any, most: int | None) -> list[Any]:
    """Return at most so many of some cases, evenly spread; all if nothing is asked."""
    cases = list(cases)
    number = len(cases) if most is None else min(most, len(cases))
    return [cases[index * len(cases) // number] for index in range(number)]


def trouble(returncode: int, said: str, expected: int = 0) -> str:
    """Say in what a process did not end as it should, or nothing."""
    if "Traceback" in said:
        return f"a traceback: {said.strip().splitlines()[-1][:300]}"
    return "" if returncode == expected else f"exit status {returncode}, not {expected}: {said.strip()[-300:]}"


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
    if rows and [*rows[0]] != [*others[0]]:
        return "metrics.csv: other columns, or in another order"
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
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    return torch.equal(first, second) if isinstance(first, torch.Tensor) else bool(first == second)


def rows_of(run_dir: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics without what a clock writes."""
    with RunDirectory(run_dir).metrics.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if not name.startswith(CLOCKS)} for row in rows]


if __name__ == "__main__":
    main()
