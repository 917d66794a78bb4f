"""Environment steps per second through a TorchRL Collector with a random policy, and where the time goes.

    python benchmarks/simulation.py --json results/simulation.json
    python benchmarks/simulation.py --renderers warp --num-envs 32 64      # what a machine without OpenGL gets

Columns: `steps/s` are control steps summed over the N environments. The others split the time of one batched step:
`physics_ms` (controller, motors, MuJoCo), `race_ms` (gates, rewards, start poses), `render_ms`, and `torchrl_ms`, all
the rest (specs, TensorDicts, resets, the collector).
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import torch
from measuring import print_table, write_json
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy

from dreamer_racing.envs.simulator.rendering import RendererUnavailableError
from dreamer_racing.envs.torchrl_env import DroneRacingEnv

PARTS = ("physics", "race", "render", "torchrl")


def main() -> None:
    """Measure every combination asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--track", default="kidney")
    parser.add_argument("--preset", default="easy")
    parser.add_argument("--renderers", nargs="*", default=["none", "egl", "osmesa", "warp"])
    parser.add_argument(
        "--num-envs", nargs="*", type=int, help="N to try; default: 64 128 256, without pixels 512 1024"
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="least time of a measurement")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records: list[dict[str, Any]] = []
    for renderer in arguments.renderers:
        for num_envs in arguments.num_envs or ([512, 1024, 2048] if renderer == "none" else [64, 128, 256]):
            # a process of its own: PyOpenGL is bound to one platform for the life of a process
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                job = process.submit(measure, arguments.track, arguments.preset, renderer, num_envs, arguments.seconds)
                try:
                    records.append(job.result())
                except RendererUnavailableError as error:
                    print(f"{renderer}: not here ({error})")
                    break
    print_table(records, ("renderer", "num_envs", "steps/s", *(f"{part}_ms" for part in PARTS)))
    write_json(records, arguments.json)


def measure(track: str, preset: str, renderer: str, num_envs: int, seconds: float) -> dict[str, Any]:
    """Collect for some seconds; return one record."""
    torch.set_num_threads(1)
    env = DroneRacingEnv(
        track, num_envs, preset=preset, from_pixels=renderer != "none", renderer=renderer, privileged=False, seed=0
    )
    spent: defaultdict[str, float] = defaultdict(float)
    watch(env, spent)
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=16 * num_envs, total_frames=-1)
    rollouts = iter(collector)
    next(rollouts)
    spent.clear()
    steps, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        next(rollouts)
        steps += 16
    collector.shutdown()
    spent["torchrl"] = elapsed - sum(spent.values())
    per_step = {f"{part}_ms": 1e3 * spent[part] / steps for part in PARTS}
    return {
        "benchmark": "simulation", "track": track, "preset": preset, "renderer": renderer, "num_envs": num_envs,
        "steps/s": num_envs * steps / elapsed, **per_step,
    }  # fmt: skip


def watch(env: DroneRacingEnv, spent: dict[str, float]) -> None:
    """Count the time spent in the parts of an environment."""
    simulator, race = env.worlds.simulator, env.worlds.race

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                spent[part] += time.perf_counter() - start

        return call

    for owner, name, part in (
        (simulator, "step", "physics"),
        (simulator, "reset", "physics"),
        (simulator, "render", "render"),
        (race, "step", "race"),
        (race, "begin", "race"),
        (env.worlds._starts, "sample", "race"),
    ):
        setattr(owner, name, timed(part, getattr(owner, name)))


if __name__ == "__main__":
    main()
