"""Benchmark of environment steps per second, of the worlds alone and through TorchRL.

    python benchmarks/simulation.py --json results/simulation.json         # this machine's CPU
    python benchmarks/simulation.py --device cuda --json results/simulation_cuda.json
    python benchmarks/simulation.py --page results/simulation*.json     # no measuring: writes docs/benchmarks.md

Every row is measured in a separate process. `images` is `none` (state only, `vector`), a renderer of the CPU backend,
`warp_cuda` (physics on CPU, images on CUDA) or `cuda` (all on CUDA). `steps/s` are control steps summed over N worlds:

* `worlds`: `RaceWorlds` in plain tensors with random actions: step, observe, reset where an episode ended;
* `collector`: a TorchRL `Collector` with a random policy;
* `agent`: as `worlds`, with the networks and the recurrent state of a DreamerV3 policy of `--actor` size;
* `actor`: a `Collector` with that policy.

They are measured alternately, five times. The best is reported, because other load only slows a measurement down.
`lost` is the share of the worlds' speed that the collector loses; `actor_lost` the same for `agent` and `actor`. On CPU
the milliseconds of a collected step are split into physics, race rules, rendering and TorchRL (specs, TensorDicts,
resets, storing).
`memory` is the process's peak resident memory, or the GPU memory in use, GiB.
"""

import argparse
import json
import resource
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from measuring import fill_page, make_parser, now, report
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.rendering import RENDERERS, WARP_CUDA
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.machine import keep_freed_memory
from dreamer_racing.modules import DreamerPolicy, Interface

PARTS = ("physics", "race", "render")
MODES = ("worlds", "collector", "agent", "actor")
MILLISECONDS = tuple(f"{part}_ms" for part in (*PARTS, "torchrl"))
COLUMNS = ("images", "num_envs", *MODES, "lost", "actor_lost", *MILLISECONDS, "memory_gib")
ROLLOUT = 16  # control steps per batch
TURNS = 5
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"
BEGIN, END = "<!-- benchmarks/simulation.py writes this -->", "<!-- end -->"
NAMES = {
    "none": "none", "egl": "EGL (Mesa, in software)", "osmesa": "OSMesa", "warp": "ray caster, no OpenGL library",
    WARP_CUDA: "physics on CPU, ray caster on CUDA", "cuda": "all on CUDA",
}  # fmt: skip


def main() -> None:
    """Measure every requested combination, or write the page's table."""
    parser = make_parser(__doc__)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--track", default="kidney")
    parser.add_argument("--preset", default="easy")
    parser.add_argument(
        "--images", nargs="*", help=f"any of {' '.join(('none', *RENDERERS, WARP_CUDA, 'cuda'))}; default: the device's"
    )
    parser.add_argument("--looks", default="nominal", help="nominal | randomised")
    parser.add_argument("--image-size", type=int, default=64, help="pixels")
    parser.add_argument("--num-envs", nargs="*", type=int, help="N to try")
    parser.add_argument("--actor", help="size of the DreamerV3 policy; default: cpu_small, on cuda size12m")
    parser.add_argument("--seconds", type=float, help="minimum time of a measurement; default: 1.5, on cuda 0.5")
    parser.add_argument(
        "--page", nargs="*", metavar="JSON", help="write the table of docs/benchmarks.md from these results"
    )
    arguments = parser.parse_args()
    arguments.seconds = arguments.seconds or (0.5 if arguments.device == "cuda" else 1.5)
    if arguments.page is not None:
        write_page(arguments.page)
        return
    records = []
    for job, *details in jobs(arguments):
        # a separate process, because PyOpenGL is bound to one platform for the life of a process
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            try:
                records.append(process.submit(job, *details).result())
            except (RendererUnavailableError, ImportError) as error:
                print(f"{details[0]}: not available ({error})")
    report(records, COLUMNS, arguments.json)


def jobs(arguments: argparse.Namespace) -> Iterator[tuple[Any, ...]]:
    """Yield the function and the arguments of every requested measurement."""
    on_cuda = arguments.device == "cuda"
    actor = arguments.actor or ("size12m" if on_cuda else "cpu_small")
    # On CUDA the defaults take a minute or two of GPU time; WARP_CUDA and others only on request.
    for images in arguments.images or (("none", "cuda") if on_cuda else ("none", *RENDERERS)):
        state, pixels = ((4096,), (256, 1024, 4096)) if on_cuda else ((32, 512, 2048), (32, 64, 256))
        for num_envs in arguments.num_envs or (state if images == "none" else pixels):
            device = "cpu" if images == WARP_CUDA else arguments.device
            looks = "nominal" if images == "none" else arguments.looks
            settings = {"preset": arguments.preset, "device": device, "looks": looks}
            yield measure, images, num_envs, arguments.track, settings, actor, arguments.seconds, arguments.image_size


def measure(
    images: str,
    num_envs: int,
    track: str,
    settings: dict[str, Any],
    actor: str,
    seconds: float,
    image_size: int = 64,
) -> dict[str, Any]:
    """Return one record."""
    torch.set_num_threads(1)
    if settings.get("device", "cpu") == "cpu":
        keep_freed_memory()  # as the recipes do
    env = DroneRacingEnv(
        track,
        num_envs,
        from_pixels=images != "none",
        renderer="auto" if images in ("none", "cuda") else images,
        camera=Camera(width=image_size, height=image_size),
        privileged=False,
        seed=0,
        **settings,
    )
    batch = ROLLOUT * num_envs
    options = {
        "frames_per_batch": batch,
        "total_frames": -1,
        "track_traj_ids": False,
        "no_cuda_sync": True,
        "device": env.device,  # otherwise the collector clears and restores the data's device at every step
    }
    collector = Collector(env, RandomPolicy(env.action_spec), **options)
    rollouts = iter(collector)
    policy = make_policy(env, actor)
    remembering = with_memory(env, policy.make_primer())
    actor_rollouts = iter(Collector(remembering, policy, **options))
    modes: dict[str, Callable[[], Any]] = {
        "worlds": flying(env, lambda _: env.action_spec.rand()),
        "collector": lambda: next(rollouts),
        "agent": flying(env, acting(policy, remembering.reset())),
        "actor": lambda: next(actor_rollouts),
    }
    speeds: defaultdict[str, list[float]] = defaultdict(list)
    for _ in range(TURNS):
        for mode, job in modes.items():
            speeds[mode].append(speed(job, batch, seconds, env.device))
    split = parts_of(env, lambda: next(rollouts), seconds) if env.device.type == "cpu" else {}
    rates = {mode: max(values) for mode, values in speeds.items()}
    return {
        "benchmark": "simulation", "track": track, **settings, "images": images, "num_envs": num_envs,
        "image_size": image_size, "actor_size": actor, **rates,
        "lost": 1 - rates["collector"] / rates["worlds"],
        "actor_lost": 1 - rates["actor"] / rates["agent"], **split, "memory_gib": peak_gib(env.device),
    }  # fmt: skip


def flying(env: DroneRacingEnv, act: Callable[[dict[str, Tensor]], Tensor]) -> Callable[[], None]:
    """Return a function that flies the worlds in plain tensors: act, step, observe, reset where an episode ended."""
    worlds = env.worlds
    key, observe = ("pixels", worlds.render) if env.from_pixels else ("vector", worlds.vector)
    worlds.reset()
    seen = {key: observe(), "is_init": torch.ones(worlds.num_envs, dtype=torch.bool, device=env.device)}

    def fly() -> None:
        for _ in range(ROLLOUT):
            outcome = worlds.step(act(seen))
            seen[key] = observe()
            ended = seen["is_init"] = outcome.terminated | outcome.truncated
            if ended.any():
                worlds.reset(ended)
                if env.from_pixels:
                    seen[key][ended] = worlds.render(ended)
                else:
                    seen[key] = observe()

    return fly


def make_policy(env: DroneRacingEnv, size: str) -> DreamerPolicy:
    """Make the policy of an untrained agent."""
    return DreamerV3.make(size, Interface.of(env), device=str(env.device)).policy()


def acting(policy: DreamerPolicy, beginning: TensorDictBase) -> Callable[[dict[str, Tensor]], Tensor]:
    """Return a function that acts in plain tensors, with the policy's networks and a given initial recurrent state."""
    memory = {key: beginning.get(key) for key in ("belief", "state", "previous_action")}

    def act(seen: dict[str, Tensor]) -> Tensor:
        action, memory["belief"], memory["state"] = policy.act({**seen, **memory})
        memory["previous_action"] = action
        return action

    return act


def speed(job: Callable[[], Any], steps: int, seconds: float, device: torch.device) -> float:
    """Return the steps per second of a job of ``steps`` steps, repeated for some seconds after one warm-up run."""
    job()
    done, start = 0, now(device)
    while (elapsed := now(device) - start) < seconds:
        job()
        done += steps
    return done / elapsed


def parts_of(env: DroneRacingEnv, job: Callable[[], Any], seconds: float) -> dict[str, float]:
    """Return the time of each part of a collected step on CPU, ms."""
    spent: defaultdict[str, float] = defaultdict(float)
    with watched(env, spent):
        steps, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            job()
            steps += ROLLOUT
    spent["torchrl"] = elapsed - sum(spent.values())
    return {f"{part}_ms": 1e3 * spent[part] / steps for part in (*PARTS, "torchrl")}


@contextmanager
def watched(env: DroneRacingEnv, spent: dict[str, float]) -> Iterator[None]:
    """Add the time spent in the parts of an environment to ``spent`` within the context."""
    simulator, race = env.worlds.simulator, env.worlds.race

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent[part] += time.perf_counter() - start

        return call

    methods = (
        (simulator, "step", "physics"),
        (simulator, "reset", "physics"),
        (simulator, "render", "render"),
        (race, "step", "race"),
        (race, "begin", "race"),
        (env.worlds._starts, "sample", "race"),
    )
    for owner, name, part in methods:
        setattr(owner, name, timed(part, getattr(owner, name)))
    try:
        yield
    finally:
        for owner, name, _ in methods:
            delattr(owner, name)


def peak_gib(device: torch.device) -> float:
    """Return the peak resident memory of this process, or a CUDA device's memory in use (including warp's), GiB."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return (total - free) / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


# --- docs/benchmarks.md ---


def write_page(paths: list[str]) -> None:
    """Replace the page's table by stored results, with the fastest N for each kind of images."""
    records = [record for path in paths for record in json.loads(Path(path).read_text())]
    best: dict[tuple[str, ...], dict[str, Any]] = {}
    for record in records:
        if "device" not in record:
            continue  # a peer
        key = (record["images"], record["device"], record["machine"])
        if key not in best or record["collector"] > best[key]["collector"]:
            best[key] = record
    lines = [
        "| images | drones | steps/s | worlds alone | with actor | physics | race rules | render | TorchRL |",
        "|" + "---|" * 9,
    ]
    for (images, device, _), record in best.items():
        parts = " | ".join(
            f"{record[f'{part}_ms']:.1f}" if f"{part}_ms" in record else "" for part in (*PARTS, "torchrl")
        )
        speeds = f"**{record['collector']:,.0f}** | {record['worlds']:,.0f} | {record['actor']:,.0f}"
        name = NAMES.get(images, images) + (", CUDA" if images == "none" and device == "cuda" else "")
        lines.append(f"| {name} | {record['num_envs']} | {speeds} | {parts} |")
    fill_page(PAGE, BEGIN, END, lines)


if __name__ == "__main__":
    main()
