"""How tests run recipes, and look into what they leave."""

from __future__ import annotations

import csv
import importlib
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Collection
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import hydra
from omegaconf import DictConfig, OmegaConf

from dreamer_racing.training.session import Session
from tests.forked import recipe, started  # noqa: F401 - the latter for tests, beside the rest

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "recipes" / "config"
EXPERIMENTS = ("ablation", "race_ablation")
"""Configurations of `recipes/experiment.py`, beside the one of its name."""

SMALL = [
    "track=circle", "model=debug", "env.num_envs=4", "env.episode_steps=40", "prefill=200", "total_env_steps=400",
    "replay.capacity=4000", "evaluation.every=200", "evaluation.episodes=2", "evaluation.video_steps=20",
    "checkpoint.every=200", "logger.every=100",
]  # fmt: skip
"""A short run that evaluates and saves on the way."""
TINY = [
    "track=circle", "model=debug", "model.batch_size=2", "env.num_envs=4", "env.episode_steps=40", "prefill=100",
    "total_env_steps=200", "replay.capacity=1000", "replay.held_out=1", "evaluation.every=0", "evaluation.episodes=1",
    "evaluation.video_steps=20", "checkpoint.every=0", "logger=csv", "logger.every=100", "device=cpu",
]  # fmt: skip
"""The shortest run there is."""
AT_THE_END = "evaluation.every=1000000"
UNDRAWN = """
from dreamer_racing.figures import report
report.plot_top_down = report.write_video = lambda *_, **__: None
"""
"""Goes before a run at whose pictures nothing looks: they take half of a short evaluation's time."""


def rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def recipe_module(name: str) -> ModuleType:
    """A module of the recipes' folder."""
    return module_of("recipes", name)


def module_of(folder: str, name: str) -> ModuleType:
    """A module of a folder of this repository that is no package."""
    sys.path.insert(0, str(ROOT / folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def compose(recipe_name: str, *overrides: str) -> DictConfig:
    recipe_module("experiment" if recipe_name in EXPERIMENTS else recipe_name)  # which has the schema
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return hydra.compose(recipe_name, overrides=list(overrides))


def run_config(*overrides: str, name: str = "dreamer_v3") -> Any:
    """The configuration of a run as its recipe resolves it."""
    return OmegaConf.to_object(recipe_module(name).resolve(compose(name, *overrides)))


def open_session(*overrides: str, name: str = "dreamer_v3") -> tuple[Any, Session]:
    """The configuration of a run, and a session for it."""
    config = run_config(*overrides, name=name)
    return config, recipe_module("composing.launching").open_session(config, list(overrides))


def prepared(*overrides: str, name: str = "dreamer_v3") -> Session:
    """The session of a run whose parts are all made or restored, and whose loop has not begun."""
    config, session = open_session(*overrides, name=name)
    session.rollouts = lambda: iter(())
    try:
        recipe_module(name).train(config, session)
    except BaseException:
        session.close()
        raise
    del session.rollouts
    return session


def completed(name: str, *overrides: str, **given: Any) -> subprocess.CompletedProcess[str]:
    """Run a recipe as `recipe` does, to its end without an error."""
    done = recipe(name, *overrides, **given)
    assert done.returncode == 0, done.stderr
    return done


def python(
    *arguments: str, cwd: Path | None = None, without: Collection[str] = (), timeout: float = 300, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run Python on this repository, with some variables of the environment set and others unset."""
    kept = {name: value for name, value in os.environ.items() if name not in without}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env={**kept, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True, text=True, timeout=timeout, check=False,
    )  # fmt: skip


def refused(name: str, *overrides: str, status: int = 2, **given: Any) -> str:
    """Run a recipe as `recipe` does, to an end in plain words; return them."""
    done = recipe(name, *overrides, **given)
    assert done.returncode == status and "Traceback" not in done.stderr, done.stderr
    return done.stderr


def build(*overrides: str, name: str = "dreamer_v3") -> None:
    """Resolve a configuration and make all parts of a run, as a recipe does, in this process."""
    with recipe_module("composing.entry").plain_errors():
        prepared("model=debug", "env.from_pixels=false", *overrides, name=name).close()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Process:
    """A recipe, or another program by its path, that runs, and what it has said so far."""

    def __init__(self, name: str, *overrides: str) -> None:
        path = Path(name) if name.endswith(".py") else ROOT / "recipes" / f"{name}.py"
        command = [sys.executable, str(path), *overrides]
        self.running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, bufsize=0)
        self.said = ""

    def listen(self, seconds: float) -> None:
        stdout = self.running.stdout
        assert stdout is not None
        if select.select([stdout], [], [], seconds)[0]:
            self.said += os.read(stdout.fileno(), 65536).decode()

    def wait_for(self, text: str, other: Process | None = None) -> None:
        """Wait until it has said that; fail if it takes too long, or the other one ends meanwhile."""
        deadline = time.monotonic() + 90
        while text not in self.said:
            assert time.monotonic() < deadline and self.running.poll() is None, self.said
            assert other is None or other.running.poll() is None, other.end()
            self.listen(0.2)

    def end(self) -> str:
        """Wait for its end; return all that it said."""
        deadline = time.monotonic() + 60
        while self.running.poll() is None and time.monotonic() < deadline:
            self.listen(0.2)
        while self.running.stdout is not None and (rest := self.running.stdout.read()):
            self.said += rest.decode()
        return self.said

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.running.kill()
        self.running.wait()
        if self.running.stdout is not None:
            self.running.stdout.close()
