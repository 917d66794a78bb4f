"""Resident memory over many steps of random actions: it must not grow.

python benchmarks/memory.py --steps 100000 --json results/memory.json
"""

import argparse
from pathlib import Path
from typing import Any

from measuring import print_table, write_json
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy

from dreamer_racing.envs.torchrl_env import DroneRacingEnv

SAMPLES = 10


def main() -> None:
    """Step a pixel environment and sample the resident set size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--track", default="kidney")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100_000, help="control steps summed over environments")
    parser.add_argument("--renderer", default="auto")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    env = DroneRacingEnv(arguments.track, arguments.num_envs, renderer=arguments.renderer, seed=0)
    frames = 16 * arguments.num_envs
    collector = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=frames, total_frames=-1)
    records: list[dict[str, Any]] = []
    env_steps, every = 0, arguments.steps // SAMPLES
    for rollout in collector:
        if env_steps // every != (env_steps + rollout.numel()) // every or not records:
            records.append({"benchmark": "memory", "env_steps": env_steps, "rss_mib": resident_mib()})
        env_steps += rollout.numel()
        if env_steps > arguments.steps:
            break
    records.append({"benchmark": "memory", "env_steps": env_steps, "rss_mib": resident_mib()})
    collector.shutdown()
    print_table(records, ("env_steps", "rss_mib"))
    write_json(records, arguments.json)


def resident_mib() -> float:
    """Resident set size of this process, MiB."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


if __name__ == "__main__":
    main()
