"""Input that nobody means: 100,000 cases at tracks, actions, contracts, overrides and checkpoints.

    OMP_NUM_THREADS=1 python tests/robustness/fuzz.py --json results/fuzz.json

Each kind of input has a process of its own. A case is either taken or refused by the errors that are promised for it;
everything else fails it: another error, more than 10 s, a process that dies. An audit hook fails what starts a process,
opens a connection, compiles a text of the input, or writes, renames or removes anything outside the case's folder.
"""

import argparse
import contextlib
import io
import json
import math
import os
import platform
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import hydra
import torch
import yaml
from hydra.errors import HydraException
from omegaconf import OmegaConf
from torchrl.envs import InitTracker, TransformedEnv

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from dreamer_racing.envs import DroneRacingEnv  # noqa: E402
from dreamer_racing.envs.drone.parameters import PRESETS  # noqa: E402
from dreamer_racing.envs.race.gates import CrashCause  # noqa: E402
from dreamer_racing.envs.tracks import Track, TrackError, load_track  # noqa: E402
from dreamer_racing.envs.worlds import RaceWorlds  # noqa: E402
from dreamer_racing.experience.replay import make_replay  # noqa: E402
from dreamer_racing.export.onnx_actor import OnnxActor, read_contract  # noqa: E402
from dreamer_racing.machine import provenance  # noqa: E402
from dreamer_racing.training.checkpoint import RunCheckpointError, RunCheckpoints  # noqa: E402
from dreamer_racing.training.directory import latest_checkpoint  # noqa: E402
from dreamer_racing.training.publishing import write_checksums  # noqa: E402
from tests.forked import Forked  # noqa: E402

TRACKS = ROOT / "dreamer_racing" / "envs" / "tracks"
AGENT = ROOT / "agents" / "kidney"
CASES = {"tracks": 40_000, "actions": 40_960, "contracts": 16_000, "overrides": 2_000, "checkpoints": 2_000}
SECONDS, HOUR = 10, 3600  # of a case, and of a kind
DRONES = 256
ODD: tuple[Any, ...] = (
    None, True, "", "x" * 3000, "\0", "é", "1e400", "nan", -1, 0, 1, 2**40, 10**30, -(10**30), 1e-300, 1e300, -1e300,
    math.nan, math.inf, -math.inf, [], {}, [[[[]]]], [0.0] * 5000, {"a": {"b": None}},
)  # fmt: skip
MARK = "code_of_an_input"
"""In every text that is code in some language, to know it if Python compiles it."""
PIECES = (
    f"!!python/object/apply:eval ['\"{MARK}\"']", f"!!python/object/apply:exec ['{MARK} = 1']", f"__import__('{MARK}')",
    "&a [*a, *a]", "!!python/object/apply:os.system ['true']", "!!python/name:os.system", "<<: *a", "? [1]", "%YAML 9",
    "---\n", "- ", ": ", "{", "}", "[", "]", "\t", "\x00", "#" * 99, "1e999", ".nan", "0x7f", "2001-01-01", "~", "'",
)  # fmt: skip
FORBIDDEN = (
    "os.symlink", "os.link", "os.system", "os.exec", "os.spawn", "os.posix_spawn", "os.fork", "os.forkpty", "os.kill",
    "os.putenv", "os.unsetenv", "os.lockf", "pty.spawn", "subprocess.Popen", "socket.connect", "socket.bind",
    "socket.sendto", "code.__new__",
)  # fmt: skip
CHANGING = {
    "os.remove": ((0, 1),), "os.rmdir": ((0, 1),), "os.mkdir": ((0, 2),), "os.rename": ((0, 2), (1, 3)),
    "os.truncate": ((0, None),), "os.utime": ((0, 3),), "os.chmod": ((0, 2),), "os.chown": ((0, 3),),
    "os.setxattr": ((0, None),), "os.removexattr": ((0, None),),
}  # fmt: skip
"""Events that change the disk: where among their arguments stand a path and the folder that it is relative to."""


class EscapedError(BaseException):
    """A case did what no input may make the program do; nobody catches this by accident."""


class HangError(BaseException):
    """A case took too long."""


def watch(folder: Path) -> None:
    """From now on fail what starts processes, opens connections, compiles input, or changes what lies elsewhere."""

    def is_inside(path: str | bytes | os.PathLike[str] | int, relative_to: int | None = -1) -> bool:
        if isinstance(path, int):
            return True  # opened before, which was looked at
        place = Path(os.fsdecode(path))
        if relative_to not in (-1, None):
            place = Path(os.readlink(f"/proc/self/fd/{relative_to}")) / place
        place = Path(os.path.normpath(place.absolute()))
        return place.is_relative_to(folder) or "__pycache__" in place.parts

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in FORBIDDEN:
            raise EscapedError(f"{event}{arguments}")
        for index, folder_index in CHANGING.get(event, ()):
            if not is_inside(arguments[index], None if folder_index is None else arguments[folder_index]):
                raise EscapedError(f"{event}{arguments}")
        if event == "compile" and MARK in str(arguments[0]):
            raise EscapedError(f"compiles {arguments[0]!r}")
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path, mode, flags = arguments
            writes = any(letter in (mode or "") for letter in "wax+") or (flags or 0) & (os.O_WRONLY | os.O_RDWR)
            if writes and not is_inside(path) and os.fsdecode(path) != os.devnull:
                raise EscapedError(f"opens {path!r} for writing")

    sys.addaudithook(hook)


def twist(text: str, draw: random.Random) -> bytes:
    """Turn bytes of a text, or move, drop, double and insert pieces."""
    content = bytearray(text.encode())
    for _ in range(draw.randint(1, 4)):
        start = draw.randrange(len(content) + 1)
        end = min(len(content), start + draw.choice((1, 2, 8, 40)))
        way = draw.randrange(5)
        if way == 0 and start < len(content):
            content[start] = draw.randrange(256)
        elif way == 1:
            del content[start:end]
        elif way == 2:
            content[start:start] = content[start:end] * draw.choice((1, 2, 50))
        elif way == 3:
            content[start:end] = draw.choice(PIECES).encode()
        else:
            piece = content[start:end]
            del content[start:end]
            at = draw.randrange(len(content) + 1)
            content[at:at] = piece
    return bytes(content)


def replace_somewhere(value: Any, draw: random.Random) -> Any:
    """Replace, drop or double something at any depth of a structure of lists and dictionaries."""
    if not isinstance(value, dict | list) or not value or draw.random() < 0.1:
        return draw.choice(ODD)
    key = draw.choice(list(value) if isinstance(value, dict) else range(len(value)))
    way = draw.random()
    if way < 0.1:
        del value[key]
    elif way < 0.2 and isinstance(value, list):
        value.extend([value[key]] * draw.choice((1, 5, 300)))
    elif way < 0.3 and isinstance(value, dict):
        value[draw.choice(("name", "gates", "x", "", 7))] = draw.choice(ODD)
    else:
        value[key] = replace_somewhere(value[key], draw)
    return value


def fly(track: Track) -> None:
    """Make a step on a track."""
    worlds = RaceWorlds(track, 2, from_pixels=False)
    worlds.reset()
    worlds.step(torch.zeros(2, 4))


def tracks(draw: random.Random, folder: Path) -> Callable[[], bool]:
    """Make a case that loads a track file with spoilt text or structure; every hundredth of those taken is flown."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(TRACKS.glob("*.yaml"))]
    file = folder / "track.yaml"

    def case() -> bool:
        text = draw.choice(texts)
        structure = draw.random() < 0.5
        spoilt = yaml.safe_dump(replace_somewhere(yaml.safe_load(text), draw)).encode() if structure else b""
        file.write_bytes(spoilt or twist(text, draw))
        try:
            track = load_track(file)
        except TrackError:
            return False
        if draw.random() < 0.01:
            fly(track)
        return True

    fly(load_track("circle"))  # loads its libraries before the watch begins
    return case


def actions(draw: random.Random, folder: Path) -> Callable[[], bool]:
    """Make a case that is a step of `DRONES` drones fed float32 of random bits, NaN, infinities and huge numbers."""
    generator = torch.Generator().manual_seed(draw.randrange(2**31))
    env = DroneRacingEnv("kidney", num_envs=DRONES, from_pixels=False, seed=0)
    carrier = env.reset()

    def case() -> bool:
        nonlocal carrier
        bits = torch.randint(-(2**31), 2**31, (DRONES, 4), generator=generator).int().view(torch.float32)
        tame = torch.rand(DRONES, 4, generator=generator) * 2 - 1
        wild = torch.rand(DRONES, 1, generator=generator) < 0.3
        action = torch.where(wild, bits, tame)
        done, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        invalid = ~action.isfinite().all(-1)
        said = done["next", "race", "crash"].squeeze(-1) == CrashCause.INVALID_ACTION
        assert torch.equal(invalid, said), "an action that is not finite is a crash of that name, no other is"
        assert done["next", "reward"].isfinite().all(), "a reward is not finite"
        assert carrier["privileged", "position"].isfinite().all(), "a position is not finite"
        return True

    return case


def contracts(draw: random.Random, folder: Path) -> Callable[[], bool]:
    """Make a case that reads a spoilt `contract.json` of a shipped agent; every twentieth with its actor."""
    text = (AGENT / "contract.json").read_text(encoding="utf-8")
    shutil.copytree(AGENT, folder, dirs_exist_ok=True)
    file = folder / "contract.json"

    def case() -> bool:
        structure = draw.random() < 0.5
        spoilt = json.dumps(replace_somewhere(json.loads(text), draw)).encode() if structure else twist(text, draw)
        file.write_bytes(spoilt)
        try:
            OnnxActor(folder / "actor.onnx") if draw.random() < 0.05 else read_contract(file)
        except (ValueError, FileNotFoundError):
            return False
        return True

    return case


def overrides(draw: random.Random, folder: Path) -> Callable[[], bool]:
    """Make a case that composes, resolves and checks up to three settings of `recipes/dreamer_v3.py` of any value."""
    sys.path.insert(0, str(ROOT / "recipes"))
    from composing import entry, launching, options, schema
    from dreamer_v3 import resolve

    for preset in PRESETS:  # one's own reward is tried in such worlds, whose kernels are compiled once
        RaceWorlds("circle", 2, preset, from_pixels=False).close()
    config_dir = str(ROOT / "recipes" / "config")
    names = options.names("dreamer_v3")
    os.chdir(folder)

    def value() -> str:
        odd = draw.choice(ODD)
        text = odd if isinstance(odd, str) else json.dumps(odd)
        return draw.choice((text[:200], str(draw.randint(-3, 3)), str(draw.uniform(-2, 2)), "1e6", draw.choice(PIECES)))

    def case() -> bool:
        chosen = draw.choices(names, k=draw.choice((1, 1, 1, 2, 3)))
        given = [f"{draw.choice(('',) * 8 + ('+', '~'))}{name}={value()}" for name in chosen]
        given = ["device=cpu", *(entry.normalise_argument(override) for override in given)]
        quiet = io.StringIO()
        try:
            with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet), entry.plain_errors():
                options.check_arguments("dreamer_v3", given)
                with hydra.initialize_config_dir(config_dir, version_base="1.3"):
                    config = hydra.compose("dreamer_v3", overrides=given)
                launching.check_overrides(config, given)
                cast(schema.WorldModelRunConfig, OmegaConf.to_object(resolve(config))).check()
        except HydraException as error:
            return not entry.in_plain_words(error, "dreamer_v3", given)
        except SystemExit as refused:
            if refused.code == 2:
                return False
            raise
        return True

    return case


class Payload:
    """What a pickle that calls a function looks like."""

    def __init__(self, call: tuple[Any, ...]) -> None:
        self._call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


PAYLOADS: tuple[tuple[Any, ...], ...] = (
    (os.system, ("true",)), (exec, (f"{MARK} = 1",)), (eval, (f"'{MARK}'",)), (os.mkdir, ("../escaped",)),
    (open, ("../escaped", "w")), (os.remove, (__file__,)), (os.rename, (__file__, "escaped")), (os._exit, (3,)),
)  # fmt: skip


def checkpoints(draw: random.Random, folder: Path) -> Callable[[], bool]:
    """Make a case that restores a checkpoint with turned bytes, cut files or pickles that run code.

    Half of them have checksums that fit again.
    """

    def run(place: Path) -> RunCheckpoints:
        learner = torch.nn.Linear(30, 30)
        parts = {"learner": learner, "replay": make_replay(200, 2, 4, 5), "counters": {"env_steps": 0}}
        return RunCheckpoints(place, parts)

    first = run(folder / "whole")
    env = TransformedEnv(DroneRacingEnv("kidney", num_envs=2, seed=0), InitTracker())
    first.components["replay"].extend(env.rollout(20, break_when_any_done=False))
    env.close()
    saved = first.save(10)
    files = sorted(path.relative_to(saved) for path in saved.rglob("*") if path.is_file())

    def case() -> bool:
        place = folder / "damaged"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(folder / "whole", place)
        newest = latest_checkpoint(place)
        path = newest / draw.choice(files)
        if path.suffix == ".pt" and draw.random() < 0.3:
            torch.save({"weight": Payload(draw.choice(PAYLOADS))}, path)
        content = bytearray(path.read_bytes())
        if draw.random() < 0.3:
            del content[draw.randrange(len(content)) :]
        for _ in range(draw.choice((0, 1, 1, 16))):
            if content:
                content[draw.randrange(len(content))] = draw.randrange(256)
        path.write_bytes(content)
        if draw.random() < 0.5:
            write_checksums(newest)
        try:
            run(place).load()
        except (FileNotFoundError, RunCheckpointError):
            return False
        return True

    return case


KINDS = {
    "tracks": tracks,
    "actions": actions,
    "contracts": contracts,
    "overrides": overrides,
    "checkpoints": checkpoints,
}


def attack(kind: str, cases: int, seed: int) -> dict[str, Any]:
    """Go through the cases of a kind; return how many were taken, refused, and failed how."""
    draw = random.Random(f"{kind} {seed}")
    counts: Counter[str] = Counter()
    failures: list[str] = []

    def late(*_: Any) -> None:
        raise HangError(f"more than {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        each = DRONES if kind == "actions" else 1
        case = KINDS[kind](draw, folder)
        case()  # what is loaded on first use is loaded before the watch begins
        platform.processor()  # asks a process, once
        watch(folder)
        for number in range(cases // each):
            signal.setitimer(signal.ITIMER_REAL, SECONDS)
            try:
                counts["taken" if case() else "refused"] += each
            except (Exception, EscapedError, HangError, SystemExit):
                counts["failed"] += each
                failures.append(f"case {number}: {traceback.format_exc()[-1500:]}")
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    return {"kind": kind, "cases": sum(counts.values()), **counts, "failures": failures[:20]}


def in_a_process(kind: str, share: float, seed: int) -> dict[str, Any]:
    """Attack in a process of its own; what dies there, or hangs where no signal reaches it, has failed."""
    attacking = Forked(_print_attack, kind, round(share * CASES[kind]), seed, cwd=ROOT)
    record = {"benchmark": "fuzz", "kind": kind, "cases": 0, "taken": 0, "refused": 0, "failed": 1}
    try:
        done = attacking.communicate(HOUR)
        return record | json.loads(done.stdout.splitlines()[-1])
    except (subprocess.TimeoutExpired, IndexError, ValueError) as error:
        said = getattr(error, "stderr", None) or done.stderr
        return record | {"failures": [f"{error!r}: {said[-1500:]}"]}


def _print_attack(kind: str, cases: int, seed: int) -> None:
    print(json.dumps({"failed": 0, **attack(kind, cases, seed)}))


def main() -> None:
    """Attack by every kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--share", type=float, default=1.0, help="of the cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    records = [in_a_process(kind, arguments.share, arguments.seed) | provenance() for kind in arguments.kinds]
    for record in records:
        print("{kind}: {cases} cases, {taken} taken, {refused} refused, {failed} failed".format(**record))
        print("\n".join(record["failures"]))
    if arguments.json:
        arguments.json.write_text(json.dumps(records, indent=1) + "\n")
    if any(record["failed"] for record in records):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
