"""Benchmark of collection by Ray workers against collection in one process: throughput, overhead and staleness.

    python benchmarks/collection_on_ray.py --json results/collection_on_ray.json

Every way collects as `recipes/latent_ppo.py track=circle tuned=race` does, without learning. The ways alternate: this
process with all its cores; one process with one thread and as many worlds as one worker; several such processes at
once, independent of each other, which shows the machine's limit; and as many workers with one thread each on a local
Ray cluster. `env_steps_per_s` is the median over `--rounds`, `least` and `most` the extremes; `times` is the multiple
of the single process. `overhead` is the share of wall-clock time in which no worker flew (transfer of rollouts, and
requests). `weights_age` is the largest age of the weights, in env_steps, at the end of a rollout collected with them;
`stated` is the limit by workers.weight_interval. Keep the machine idle meanwhile; do not use more workers than cores.
"""

import os
import statistics
import sys
import time
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, cast

import hydra
import torch
from measuring import make_parser, report
from omegaconf import OmegaConf

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

import latent_ppo
from composing.building import make_env, make_learner
from composing.options import CONFIG_DIR
from composing.schema import CollectorKind, WorldModelRunConfig
from composing.workers import make_own_env, make_rollouts

from dreamer_racing.experience.ray_rollouts import RayRollouts
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.machine import available_cpus, keep_freed_memory
from dreamer_racing.modules import Interface

COLUMNS = ("way", "worlds", "env_steps_per_s", "least", "most", "times", "overhead", "weights_age", "stated")
WARM_UP = 3  # rollouts
TOGETHER = 120.0  # s, timeout of the barrier
together: Any = None
"""Barrier of the processes that collect at the same time; set in each process."""


class Way(NamedTuple):
    """A way of collection.

    Attributes:
        name: Name in the table.
        worlds: Number of worlds of each process or worker.
        processes: Number of independent processes with one thread each; 0 for workers, or for this process with all
            its cores (unless ``OMP_NUM_THREADS`` is set).
        workers: Number of Ray workers.
    """

    name: str
    worlds: int
    processes: int = 0
    workers: int = 0


def main() -> None:
    """Measure every way."""
    parser = make_parser(__doc__)
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("overrides", nargs="*", help="further settings of the recipe")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    os.environ["PYTHONPATH"] = os.pathsep.join((sys.path[-1], os.environ.get("PYTHONPATH", "")))  # also for workers
    num_envs = composed(arguments.overrides).env.num_envs
    if odd := [count for count in arguments.workers if count < 1 or num_envs % count]:
        parser.error(f"--workers {odd[0]} cannot share env.num_envs={num_envs} evenly.")
    ways = ways_of(num_envs, arguments.workers)
    rounds: dict[Way, list[dict[str, float]]] = {way: [] for way in ways}
    for _ in range(arguments.rounds):
        for way in ways:
            rounds[way].append(measure(way, arguments.overrides, arguments.seconds))
    records: list[dict[str, Any]] = []
    for way, measured in rounds.items():
        speeds = [each["env_steps_per_s"] for each in measured]
        median = statistics.median(speeds)
        first = records[0]["env_steps_per_s"] if records else median
        record = {"env_steps_per_s": median, "least": min(speeds), "most": max(speeds), "times": median / first}
        record |= {"overhead": statistics.median(each["overhead"] for each in measured)}
        record |= {name: max(each[name] for each in measured) for name in ("weights_age", "stated", "rollout_steps")}
        names = {"way": way.name, **{name: getattr(way, name) for name in ("worlds", "processes", "workers")}}
        records.append({"benchmark": "collection_on_ray", **names, "cores": available_cpus(), **record})
    report(records, COLUMNS, arguments.json)


def ways_of(num_envs: int, workers: Sequence[int]) -> list[Way]:
    """Return the ways to compare for some numbers of workers that share ``num_envs`` worlds."""
    shares = {count: num_envs // count for count in workers}
    return [
        Way("one process", num_envs),
        *(Way(f"one thread, {worlds} worlds", worlds, processes=1) for worlds in shares.values()),
        *(Way(f"{count} processes", worlds, processes=count) for count, worlds in shares.items() if count > 1),
        *(Way(f"{count} worker{'s' * (count > 1)}", worlds, workers=count) for count, worlds in shares.items()),
    ]


def composed(overrides: Sequence[str]) -> WorldModelRunConfig:
    """Return the recipe's configuration."""
    given = ["track=circle", "device=cpu", "tuned=race", "run_dir=unused", *overrides]
    with hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        config = latent_ppo.resolve(hydra.compose("latent_ppo", overrides=given))
    made = OmegaConf.to_object(config)
    assert isinstance(made, WorldModelRunConfig)
    return made


def measure(way: Way, overrides: Sequence[str], seconds: float) -> dict[str, float]:
    """Collect in one way for some seconds."""
    if way.workers:
        cpus = min(1.0, available_cpus() / way.workers)
        on_ray = ["collector=ray", f"num_workers={way.workers}", f"workers.cpus={cpus}"]
        return collect(composed([*overrides, *on_ray]), seconds)
    config = composed([*overrides, f"env.num_envs={way.worlds}"])
    if not way.processes:
        return collect(config, seconds)
    context = get_context("spawn")
    with context.Pool(way.processes, begin_together, (context.Barrier(way.processes),)) as pool:
        each = pool.starmap(collect, [(config, seconds, True)] * way.processes, chunksize=1)
    return {**each[0], "env_steps_per_s": sum(one["env_steps_per_s"] for one in each)}


def begin_together(barrier: Any) -> None:
    """Initialise a process: one thread, and the barrier."""
    global together
    together = barrier
    torch.set_num_threads(1)
    keep_freed_memory()


def collect(config: WorldModelRunConfig, seconds: float, alone: bool = False) -> dict[str, float]:
    """Collect as the recipe does, with or without workers; if ``alone``, with one thread and after the barrier."""
    env = make_env(config, num_threads=1) if alone else make_own_env(config)
    learner = cast(WorldModelLearner, make_learner(config, Interface.of(env), torch.device(config.device)))
    rollouts = make_rollouts(config, env, learner)
    for _ in range(WARM_UP):
        next(rollouts)
    if alone:
        together.wait(timeout=TOGETHER)
    flown, age, rounds, taken = 0.0, 0, 0, 0.0
    start = time.perf_counter()
    while taken < seconds:
        next(rollouts)
        rounds, taken = rounds + 1, time.perf_counter() - start
        if isinstance(rollouts, RayRollouts):
            flown, age = flown + rollouts.seconds, max(age, rollouts.weights_age)
    rollouts.close()
    rollouts.collector.shutdown()
    env.close(raise_if_closed=False)
    frames, on_ray = config.env.num_envs * config.rollout_steps, config.collector is CollectorKind.ray
    return {
        "env_steps_per_s": rounds * frames / taken,
        "overhead": max(0.0, 1.0 - flown / taken) if on_ray else 0.0,
        "weights_age": age if on_ray else frames,  # in one process, weights are those of the last update
        "stated": config.weight_interval if on_ray else frames,
        "rollout_steps": config.rollout_steps,
    }


if __name__ == "__main__":
    main()
