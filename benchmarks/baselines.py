"""PPO and SAC all in: env steps a second of a whole run, and where its time goes.

python benchmarks/baselines.py --json results/baselines.json

The time inside the worlds (physics, race rules, images), inside the networks' forward passes, the backward pass and the
optimiser is what the algorithms are; the rest is what TorchRL, TensorDict and this project add around it.
"""

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import hydra
import torch
from measuring import print_table, write_json
from omegaconf import OmegaConf

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

import ppo
import sac
from composing.command_line import CONFIG_DIR

from dreamer_racing.envs.worlds import RaceWorlds
from dreamer_racing.learners.networks import ObservationNetwork
from dreamer_racing.training.signals import GracefulExit

RECIPES = {"ppo": ppo, "sac": sac}
CASES = (
    ("ppo", "env.from_pixels=false"),
    ("sac", "env.from_pixels=false"),
    ("ppo", "env.from_pixels=true"),
    ("sac", "env.from_pixels=true"),
)
MEASURED: tuple[tuple[str, Any, str], ...] = (
    ("simulation", RaceWorlds, "step"),
    ("simulation", RaceWorlds, "reset"),
    ("simulation", RaceWorlds, "vector"),
    ("rendering", RaceWorlds, "render"),
    ("networks", ObservationNetwork, "forward"),
    ("networks", torch.Tensor, "backward"),
    ("networks", torch.optim.Adam, "step"),
)
"""What is timed: its share, class and method. None of them calls another."""


def main() -> None:
    """Measure every case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each case")
    parser.add_argument("--overrides", nargs="*", default=[], help="of the recipes, e.g. device=cuda env.num_envs=256")
    parser.add_argument("--cases", nargs="*", type=int, default=range(len(CASES)), help="indices; default all")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = [measure(*CASES[index], arguments.seconds, arguments.overrides) for index in arguments.cases]
    columns = ("algorithm", "observation", "num_envs", "env_steps_per_s", "simulation", "rendering", "networks", "rest")
    print_table(records, columns)
    write_json(records, arguments.json)


def measure(algorithm: str, observation: str, seconds: float, overrides: list[str]) -> dict[str, Any]:
    """Train for so many seconds, after a warm-up of one tenth of them; return one record."""
    with tempfile.TemporaryDirectory() as directory:
        given = [observation, "track=circle", "logger=csv", f"run_dir={directory}", "total_env_steps=1000000000"]
        given += ["prefill=1000"] if algorithm == "sac" else []
        with hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
            config = RECIPES[algorithm].resolve(hydra.compose(algorithm, [*given, *overrides]))
        run = RECIPES[algorithm].build(OmegaConf.to_object(config), [])
        try:
            train(run, seconds / 10)
            before, shares = run.counters["env_steps"], Stopwatch()
            with shares:
                elapsed = train(run, seconds)
        finally:
            run.close()
    return {
        "benchmark": "baselines", "algorithm": algorithm, "observation": observation.partition("=")[2],
        "num_envs": config.env.num_envs, "layers": config.network.layers, "units": config.network.units,
        "seconds": elapsed, "env_steps_per_s": (run.counters["env_steps"] - before) / elapsed,
        **{name: shares.seconds[name] / elapsed for name in ("simulation", "rendering", "networks")},
        "rest": 1.0 - sum(shares.seconds.values()) / elapsed,
    }  # fmt: skip


def train(run: Any, seconds: float) -> float:
    """Collect and learn as a recipe does; return the seconds that it took."""
    start = time.perf_counter()
    stop = GracefulExit()
    while time.perf_counter() - start < seconds:
        rollout = next(run.rollouts)
        run.take_in(rollout)
        run.learn(rollout, stop)
    synchronize(run.learner.device)
    return time.perf_counter() - start


def synchronize(device: torch.device) -> None:
    """Wait for a device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Stopwatch:
    """Adds up the seconds inside the methods of ``MEASURED``; on a CUDA device those of launching only."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._patches = [
            patch.object(owner, name, self._timed(share, getattr(owner, name))) for share, owner, name in MEASURED
        ]

    def _timed(self, share: str, method: Callable) -> Callable:
        def timed(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*arguments, **named)
            finally:
                self.seconds[share] += time.perf_counter() - start

        return timed

    def __enter__(self) -> None:
        for each in self._patches:
            each.start()

    def __exit__(self, *exception: object) -> None:
        for each in self._patches:
            each.stop()


if __name__ == "__main__":
    main()
