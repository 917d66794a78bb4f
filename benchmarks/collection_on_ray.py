"""Collection by workers on Ray against collection in one process: throughput, overhead and staleness.

    python benchmarks/collection_on_ray.py --json results/collection_on_ray.json

Every way collects as `recipes/dreamer_v3.py track=circle tuned=race` does, and nothing is learned meanwhile, in turns:
in this process with all its cores, then by so many workers with one core each on a Ray cluster on this machine.
`env_steps_per_s` is the median of `--rounds`; `least` and `most` are those of a round; `times` is the multiple of the
single process. `overhead` is the share of wall-clock time in which no worker flew: rollouts on their way, and requests.
`weights_age` is how many env_steps the oldest weights were old at the end of what was flown with them, at most, and
`stated` what workers.weight_interval promises. Keep the machine idle meanwhile; more workers than cores gain nothing.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from measuring import print_table, write_json
from omegaconf import OmegaConf

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

import dreamer_v3
from composing.command_line import CONFIG_DIR
from composing.learners import make_learner
from composing.schema import CollectorKind, DreamerConfig
from composing.workers import make_own_env, make_rollouts

from dreamer_racing.experience.ray_rollouts import RayRollouts
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.machine import available_cpus, keep_freed_memory
from dreamer_racing.modules import Interface

COLUMNS = ("way", "env_steps_per_s", "least", "most", "times", "overhead", "weights_age", "stated")
WARM_UP = 3  # rollouts


def main() -> None:
    """Measure every way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json")
    parser.add_argument("overrides", nargs="*", help="further settings of the recipe")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    os.environ["PYTHONPATH"] = os.pathsep.join((sys.path[-1], os.environ.get("PYTHONPATH", "")))  # of workers, too
    ways = {"one process": list[str]()}
    for workers in arguments.workers:
        ways[f"{workers} workers"] = ["collector=ray", f"num_workers={workers}"]
    rounds: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    for _ in range(arguments.rounds):
        for way, overrides in ways.items():
            rounds[way].append(measure(composed([*overrides, *arguments.overrides]), arguments.seconds))
    records: list[dict[str, Any]] = []
    for way, measured in rounds.items():
        speeds = [each["env_steps_per_s"] for each in measured]
        median = statistics.median(speeds)
        first = records[0]["env_steps_per_s"] if records else median
        record = {"env_steps_per_s": median, "least": min(speeds), "most": max(speeds), "times": median / first}
        record |= {"overhead": statistics.median(each["overhead"] for each in measured)}
        record |= {name: max(each[name] for each in measured) for name in ("weights_age", "stated", "num_envs")}
        records.append({"benchmark": "collection_on_ray", "way": way, "cores": available_cpus(), **record})
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def composed(overrides: Sequence[str]) -> DreamerConfig:
    """The recipe's configuration."""
    given = ["track=circle", "device=cpu", "tuned=race", "run_dir=unused", *overrides]
    with hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        config = dreamer_v3.resolve(hydra.compose("dreamer_v3", overrides=given))
    made = OmegaConf.to_object(config)
    assert isinstance(made, DreamerConfig)
    return made


def measure(config: DreamerConfig, seconds: float) -> dict[str, float]:
    """Collect for so long."""
    env = make_own_env(config)
    learner = cast(DreamerLearner, make_learner(config, Interface.of(env), torch.device(config.device)))
    collector, ahead = make_rollouts(config, env, learner)
    rollouts = iter(collector) if ahead is None else ahead
    for _ in range(WARM_UP):
        next(rollouts)
    frames, flown, age, rounds = config.env.num_envs * config.rollout_steps, 0.0, 0, 0
    start = time.perf_counter()
    while (taken := time.perf_counter() - start) < seconds:
        next(rollouts)
        rounds += 1
        if isinstance(ahead, RayRollouts):
            flown, age = flown + ahead.seconds, max(age, ahead.weights_age)
    by_workers = config.collector is CollectorKind.ray
    if ahead is not None:
        ahead.close()
    else:
        collector.shutdown()
    env.close(raise_if_closed=False)
    return {
        "env_steps_per_s": rounds * frames / taken,
        "overhead": max(0.0, 1.0 - flown / taken) if by_workers else 0.0,
        "weights_age": age if by_workers else frames,
        "stated": config.workers.weight_interval or frames,
        "num_envs": config.env.num_envs,
    }


if __name__ == "__main__":
    main()
