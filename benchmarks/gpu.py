"""GPU benchmark in stages, most useful first and each with a time limit, so that a short run yields partial results.

    python benchmarks/gpu.py --json results/gpu/benchmark.jsonl --budget 1800          # all stages, in this order
    python benchmarks/gpu.py --json results/gpu/benchmark.jsonl --stages probe env     # some
    python benchmarks/gpu.py --device cpu --tiny --json tiny.jsonl           # whether all of it runs, without a GPU
    python benchmarks/gpu.py --page results/gpu/benchmark.jsonl  # no measuring: writes docs/benchmarks.md

Every job of a stage is a separate process with a limit in seconds; its result is appended to the file at once as a line
of JSON. If a job fails or exceeds its limit, its line says so, its output goes to `failed.log` in the folder
`--caches`, which also holds compiled kernels, and the next job begins. If started again with the same file, finished
jobs are skipped, and the training run resumes.

`probe`: versions, speed of a matrix product (8192³ in bfloat16) and of a copy. `env`: steps of the worlds, eager and as
a CUDA graph, which must give the same results. `learner`: a captured update learns; held-out metrics, a checkpoint
and an evaluation after the capture; the replay. `tests`: those marked `gpu`, and a short run that is resumed. `speed`:
updates of each size, eager and captured, with long and short windows; the most expensive kernels of a captured one.
`train`: Kidney by imagination, `tuned=gpu`, until the budget is spent.
"""

import argparse
import copy
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from learner import Setting, filled_replay, make_learner
from measuring import as_text, fill_page, make_parser, matmul_speed, seconds
from torch.profiler import DeviceType, ProfilerActivity, profile

from dreamer_racing.envs.simulator.warp_device import load_warp
from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.held_out import SEEN, held_out_metrics
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.machine import provenance

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "benchmarks.md"
BEGIN, END = "<!-- benchmarks/gpu.py writes this -->", "<!-- end of benchmarks/gpu.py -->"
GPU_TESTS = (
    "tests/learners/test_cuda_graph.py",
    "tests/envs/simulator/test_mujoco_warp.py",
    "tests/envs/test_camera_rate.py",
    "tests/envs/test_own.py",
    "tests/envs/race/test_gates.py",
    "tests/experience/test_replay.py",
)
SIZES = ("paper_large", "size12m", "paper_small", "cpu_small")
SHORTEST = 15.0  # s of the budget that must remain for a job to begin


class Job(NamedTuple):
    """One job of a stage.

    Attributes:
        stage: Name of the stage.
        name: Name of the job in the results.
        limit: Time limit, s.
        command: Arguments of the Python interpreter.
    """

    stage: str
    name: str
    limit: float
    command: list[str]


def main() -> None:
    """Run the requested jobs, run one measurement of a job, or write the page."""
    parser = make_parser(__doc__)
    parser.add_argument("--stages", nargs="*", default=list(STAGES), choices=STAGES)
    parser.add_argument("--jobs", nargs="*", help="names of the jobs to run; default: all jobs of the stages")
    parser.add_argument("--budget", type=float, default=1800.0, help="total time, s")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--tiny", action="store_true", help="smallest settings, to test the script: measures nothing")
    parser.add_argument("--caches", default=".gpu_caches", help="folder of compiled kernels, and of the training run")
    parser.add_argument("--page", metavar="JSONL", help="write the table of docs/benchmarks.md from these results")
    parser.add_argument("--measure", help=argparse.SUPPRESS)  # used by the jobs' processes
    arguments = parser.parse_args()
    if arguments.measure:
        name, *details = arguments.measure.split(",")
        print(json.dumps(MEASURES[name](arguments.device, arguments.tiny, *details)))
        return
    if arguments.page:
        write_page(Path(arguments.page), PAGE)
        return
    if not arguments.json:
        parser.error("--json FILE is required: the results are written there.")
    run(arguments)


def run(arguments: argparse.Namespace) -> None:
    """Run the requested jobs that are not done yet, one after another, until the budget is spent."""
    results, ends = Path(arguments.json), time.monotonic() + arguments.budget
    where = {**provenance(), "device": arguments.device, "tiny": arguments.tiny}
    done = {identity(record) for record in read(results) if record["state"] == "done"}
    for job in jobs(arguments):
        left = ends - time.monotonic()
        if identity({"stage": job.stage, "name": job.name, **where}) in done:
            continue
        if left < SHORTEST:
            print(f"the budget of {arguments.budget:.0f} s is spent before {job.stage} {job.name}")
            return
        started = time.monotonic()
        outcome = attempt(job, min(job.limit, left), Path(arguments.caches))
        record = {"benchmark": "gpu", "stage": job.stage, "name": job.name, **outcome}
        record |= {"seconds": round(time.monotonic() - started, 1), **where}
        append(results, record)
        print(f"{job.stage} {job.name}: {outcome['state']}, {record['seconds']} s {outcome.get('why', '')}", flush=True)


def identity(record: dict[str, Any]) -> tuple[str, str, str, bool]:
    """Return the key of a record's job; results on another device or with ``--tiny`` are separate."""
    return record["stage"], record["name"], record["device"], record["tiny"]


def jobs(arguments: argparse.Namespace) -> Iterator[Job]:
    """Yield the jobs of the requested stages, in order."""
    runs = Path(arguments.caches).absolute() / f"runs_{arguments.device}{'_tiny' if arguments.tiny else ''}"
    for stage in STAGES:
        if stage in arguments.stages:
            for name, limit, command in STAGES[stage](arguments.device, arguments.tiny, runs):
                if not arguments.jobs or name in arguments.jobs:
                    yield Job(stage, name, limit, command)


def attempt(job: Job, limit: float, caches: Path) -> dict[str, Any]:
    """Run a job for at most ``limit`` seconds; return its state and its result or the reason of failure."""
    environment = {
        **os.environ,
        "WARP_CACHE_PATH": str((caches / "warp").absolute()),
        "TORCHINDUCTOR_CACHE_DIR": str((caches / "inductor").absolute()),
    }
    try:
        process = subprocess.run(
            [sys.executable, *job.command], cwd=ROOT, env=environment, timeout=limit, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired as late:
        keep_output(caches, job, late.stdout, late.stderr)
        why = f"more than {limit:.0f} s{'; the next start continues it' if job.stage == 'train' else ''}"
        return {"state": "too long", "why": why}
    lines = process.stdout.strip().splitlines()
    if process.returncode:
        keep_output(caches, job, process.stdout, process.stderr)
        said = (process.stderr or process.stdout).strip().splitlines()
        return {"state": "failed", "why": said[-1] if said else f"status {process.returncode}"}
    if "--measure" in job.command:
        return {"state": "done", **json.loads(lines[-1])}
    return {"state": "done", "said": lines[-1] if lines else ""}


def keep_output(caches: Path, job: Job, *outputs: str | bytes | None) -> None:
    """Append a job's output to the log of failed jobs; after a timeout, the output is bytes or None."""
    caches.mkdir(parents=True, exist_ok=True)
    texts = [each.decode(errors="replace") if isinstance(each, bytes) else each or "" for each in outputs]
    with (caches / "failed.log").open("a", encoding="utf-8") as log:
        log.write("\n".join([f"--- {job.stage} {job.name}: {' '.join(job.command)}", *texts, ""]))


def read(results: Path) -> list[dict[str, Any]]:
    """Return the records in a results file, without an incomplete last line."""
    records = []
    for line in results.read_text(encoding="utf-8").splitlines() if results.exists() else ():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records


def append(results: Path, record: dict[str, Any]) -> None:
    """Append a record as a new line, even if the last line of the file is incomplete."""
    results.parent.mkdir(parents=True, exist_ok=True)
    cut = results.exists() and not results.read_bytes().endswith(b"\n") and results.stat().st_size > 0
    with results.open("a", encoding="utf-8") as file:
        file.write(("\n" if cut else "") + json.dumps(record) + "\n")


# --- stages: name, limit in seconds and command of each job ---

Commands = Iterator[tuple[str, float, list[str]]]


def measured(device: str, tiny: bool, *details: object) -> list[str]:
    """Return the command of a measurement in this file."""
    small = ["--tiny"] if tiny else []
    return [__file__, "--device", device, *small, "--measure", ",".join(map(str, details))]


def probe_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield the job that examines the machine."""
    yield "machine", 300.0, measured(device, tiny, "probe")


def env_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield jobs for worlds of both presets, with and without images, and with randomised looks."""
    for number in (2,) if tiny else (256, 1024, 4096):
        for preset in ("easy", "faithful"):
            for images in ("pixels", "state"):
                if not tiny or (preset, images) != ("faithful", "pixels"):
                    yield f"{number} {preset} {images}", 240.0, measured(device, tiny, "env", number, preset, images)
    yield "looks", 240.0, measured(device, tiny, "env", 2 if tiny else 1024, "easy", "looks")


def learner_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield jobs for captured updates and what must work after the capture."""
    yield "captured", 180.0, measured(device, tiny, "learner", "debug")
    if not tiny:
        yield "captured paper_large", 300.0, measured(device, tiny, "learner", "paper_large")


def test_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield jobs for the GPU tests, by file because collecting all tests takes longer, and for a run and its resume."""
    if device != "cpu":
        for file in GPU_TESTS:
            yield file, 300.0, ["-m", "pytest", "-q", "-m", "gpu", file]
    yield "smoke", 600.0, measured(device, tiny, "smoke", runs / "smoke")


def speed_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield jobs for the speed of updates of all sizes, and for their kernels."""
    ways = ("eager",) if device == "cpu" else ("eager", "graph")
    plain = ("debug", "eager", "2x4") if tiny else ("size12m", "eager" if device == "cpu" else "graph", "64x16")
    yield f"{' '.join(plain)} without few kernels", 240.0, measured(device, tiny, "speed", *plain, "plain")
    for size in ("debug",) if tiny else SIZES:
        for way in ways:
            for batch in ("2x4",) if tiny else ("16x64", "64x16"):
                yield f"{size} {way} {batch}", 240.0, measured(device, tiny, "speed", size, way, batch)
    size, way, batch = ("debug", "eager", "2x4") if device == "cpu" else ("paper_large", "graph", "64x16")
    yield f"kernels of {size} {way} {batch}", 240.0, measured(device, tiny, "kernels", size, way, batch)


def train_jobs(device: str, tiny: bool, runs: Path) -> Commands:
    """Yield the job that trains on Kidney; a run that is cut off is resumed the next time."""
    run_dir = runs / "kidney"
    begin = ["tuned=gpu", "track=kidney", f"device={device}", f"run_dir={run_dir}", "checkpoint.minutes=3"]
    if tiny:
        begin += ["model=debug", "model.batch_size=4", "env.num_envs=4", "env.start_on_line=0", "budget=smoke"]
        begin += ["schedule.start_on_line.to=null", "total_env_steps=600", "evaluation.every=0"]
    begun = any((run_dir / "checkpoints").glob("checkpoint-*"))
    yield "kidney", 3600.0, ["recipes/dreamer_v3.py", *([f"resume={run_dir}"] if begun else begin)]


STAGES: dict[str, Callable[[str, bool, Path], Commands]] = {
    "probe": probe_jobs,
    "env": env_jobs,
    "learner": learner_jobs,
    "tests": test_jobs,
    "speed": speed_jobs,
    "train": train_jobs,
}
"""Stages in order of importance."""


# --- measurements, each in a separate process ---


def measure_probe(device: str, tiny: bool) -> dict[str, Any]:
    """Return versions, and the speed of matrix products and copies."""
    found: dict[str, Any] = {"torch": torch.__version__, "cuda": torch.version.cuda, "warp": load_warp().__version__}
    if device != "cpu":
        found |= {"gpu": torch.cuda.get_device_name(), "capability": torch.cuda.get_device_capability()}
    if not tiny:
        found["matmul_tflops"] = matmul_speed(device, torch.bfloat16) / 1e12
    source = torch.empty(2**20 if tiny else 2**30, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    fastest = min(seconds(lambda: target.copy_(source), device) for _ in range(6))
    return found | {"copy_gb_per_s": 2e-9 * source.numel() / fastest}


def measure_env(device: str, tiny: bool, number: str, preset: str, images: str) -> dict[str, Any]:
    """Time steps of the worlds; first check that captured steps give the same rewards as eager ones."""
    looks = "randomised" if images == "looks" else "nominal"
    worlds = RaceWorlds(
        "kidney", int(number), preset, from_pixels=images != "state", device=device, seed=0, looks=looks,
        backend="mujoco_warp",
    )  # fmt: skip
    worlds.reset()
    hover = torch.tensor([worlds.parameters.hover_action, 0.0, 0.0, 0.0], device=device)
    action = hover.expand(int(number), 4).contiguous()
    first = seconds(lambda: worlds.step(action), device)  # captures, on CUDA
    before = worlds.state_dict()
    eager = [worlds._fly(action).reward_base for _ in range(3)]
    worlds.load_state_dict(before)
    stepped = [worlds.step(action).reward_base for _ in range(3)]
    difference = max(float((one - other).abs().max()) for one, other in zip(eager, stepped, strict=True))
    if difference > 1e-4:
        raise RuntimeError(f"steps in a CUDA graph differ from those in eager mode: rewards by {difference}.")

    steps = 3 if tiny else 1000
    generator = torch.Generator(device).manual_seed(0)

    def fly() -> None:
        """Fly near the start with random actions, like an untrained policy; reset ended episodes, as in training."""
        for _ in range(steps):
            wild = 0.3 * torch.randn(action.shape, generator=generator, device=device)
            outcome = worlds.step(wild + hover)
            worlds.reset(outcome.terminated | outcome.truncated)
            if images != "state":
                worlds.render()

    taken = seconds(fly, device)
    return {"first_s": first, "difference": difference, "steps_per_s": steps * int(number) / taken, "steps": steps}


def measure_learner(device: str, tiny: bool, size: str) -> dict[str, Any]:
    """Check that captured updates learn, and that metrics, restoring and evaluation work after them."""
    config = LearnerConfig(cuda_graph=device != "cpu", learning_rate=1e-3, warmup_updates=0, mixed_precision=True)
    config.imagination_horizon = 3
    learner, other = (make_learner(size, "reconstruction", "reinforce", config, device=device) for _ in range(2))
    replay = filled_replay((2, 8), device, streams=2)
    updates = 5 if tiny else 60
    losses = [learner.update(replay.sample())["loss_image"] for _ in range(updates)]
    learner.check_finite()
    held_out = held_out_metrics(learner, filled_replay((2, SEEN + 3), device, streams=2).sample())
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, other):
        each.update(replay.sample())
        each.check_finite()
    course = Course(learner.evaluation_policy(), {"track": "circle", "device": device}, 2)
    flown = course.evaluate()
    course.close()
    first, last = (float(torch.stack(part).mean()) for part in (losses[:3], losses[-3:]))
    if not last < first:
        raise RuntimeError(f"captured updates do not learn: the image loss was {first} and is now {last}.")
    found = {"held_out_image_error": float(held_out["held_out/image_error"]), "flown_steps": flown.episode_length}
    return {"loss_before": first, "loss_after": last, **found}


def measure_smoke(device: str, tiny: bool, place: str) -> dict[str, Any]:
    """Train for a minute, and resume from the checkpoint; files of an earlier attempt are removed."""
    shutil.rmtree(place, ignore_errors=True)
    steps = 600 if tiny else 1200
    settings = ["budget=smoke", "track=circle", f"device={device}", f"run_dir={place}", "evaluation.every=0"]
    for overrides in ([*settings, f"total_env_steps={steps}"], [f"resume={place}", f"total_env_steps={steps + 200}"]):
        subprocess.run([sys.executable, "recipes/latent_ppo.py", *overrides], check=True, stdout=sys.stderr)
    return {"env_steps": steps + 200}


def measure_speed(device: str, tiny: bool, size: str, way: str, batch: str, kernels: str = "few") -> dict[str, Any]:
    """Time updates of a size, eager or captured."""
    update = update_of(device, tiny, size, way, batch, few_kernels=kernels == "few")
    first = seconds(update, device)
    times = [seconds(update, device) for _ in range(2 if tiny else 23)]
    return {"ms": 1e3 * statistics.median(times[-20:]), "first_s": first}


def measure_kernels(device: str, tiny: bool, size: str, way: str, batch: str) -> dict[str, Any]:
    """Profile updates; return the most expensive kernels, ms per update, and the number of launches per update."""
    update = update_of(device, tiny, size, way, batch)
    for _ in range(3):
        seconds(update, device)  # captures
    updates = 2 if tiny else 10
    kind, activity = (
        (DeviceType.CPU, ProfilerActivity.CPU) if device == "cpu" else (DeviceType.CUDA, ProfilerActivity.CUDA)
    )
    with profile(activities=[activity]) as profiled:
        for _ in range(updates):
            seconds(update, device)
    kernels = [event for event in profiled.key_averages() if event.device_type == kind]
    times = {
        event.key: (event.self_cpu_time_total if device == "cpu" else event.self_device_time_total) for event in kernels
    }
    most = sorted(times, key=times.__getitem__, reverse=True)[:15]
    return {
        "launched": sum(event.count for event in kernels) / updates,
        "kernels_ms": {key: round(1e-3 * times[key] / updates, 4) for key in most},
        "ms": 1e-3 * sum(times.values()) / updates,
    }


def update_of(device: str, tiny: bool, size: str, way: str, batch: str, few_kernels: bool = True) -> Callable[[], Any]:
    """Return a function that makes an update of a learner on one batch of the replay."""
    windows, length = map(int, batch.split("x"))
    setting = Setting(
        "reconstruction", "reinforce", True, 64, (windows, length), 3 if tiny else 16, device, 1, 20, few_kernels
    )
    learner = setting.learner(size, way)
    data = filled_replay((windows, length), device).sample()
    return lambda: learner.update(data)


MEASURES: dict[str, Callable[..., dict[str, Any]]] = {
    "probe": measure_probe,
    "env": measure_env,
    "learner": measure_learner,
    "smoke": measure_smoke,
    "speed": measure_speed,
    "kernels": measure_kernels,
}


# --- the page ---


def write_page(results: Path, page: Path) -> None:
    """Write the table of all GPU jobs into the page."""
    fill_page(page, BEGIN, END, table(read(results)))


def table(records: list[dict[str, Any]]) -> list[str]:
    """Return a table with a row per job, of its latest attempt on a GPU, and a row per stage with jobs not run."""
    latest = {(r["stage"], r["name"]): r for r in records if not r["tiny"] and r["device"] != "cpu"}
    places = sorted({f"{r.get('gpu')} at {r['commit']}" for r in latest.values()})
    lines = [f"Measured on {', '.join(places)}.", ""] if places else []
    lines += ["| stage | what | |", "|---|---|---|"]
    for stage, commands in STAGES.items():
        names = [name for name, _, _ in commands("cuda", False, Path())]
        run = [name for name in names if (stage, name) in latest]
        lines += [f"| {stage} | `{name}` | {in_words(latest[stage, name])} |" for name in run]
        if left := len(names) - len(run):
            lines.append(f"| {stage} | {left} {'other ' * bool(run)}{'job' if left == 1 else 'jobs'} | not run |")
    return lines


def in_words(record: dict[str, Any]) -> str:
    """Return the result of a job as text."""
    if record["state"] != "done":
        return f"{record['state']}: {record.get('why', '')}"
    shown = {"ms": "ms", "steps_per_s": "steps/s", "matmul_tflops": "TFLOP/s", "copy_gb_per_s": "GB/s"}
    numbers = [f"{as_text(record[key])} {unit}" for key, unit in shown.items() if key in record]
    return ", ".join(numbers) or f"done in {record['seconds']} s"


if __name__ == "__main__":
    main()
