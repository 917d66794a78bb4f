"""Processes that begin with what takes a recipe most of its first seconds, imported once for all of them.

Tests run recipes in them.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import reduction
from pathlib import Path
from typing import Any

import torch

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
# Not dm_control, nor OpenGL: what they draw with they choose by the environment that they are imported in.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "dreamer_racing.envs.race.pilot", "hydra", "matplotlib.pyplot", "scipy.ndimage", "scipy.stats",
        "torch.utils.tensorboard", "torchrl.collectors", "torchrl.data", "torchrl.envs", "torchrl.record",
        "torchrl.trainers.algorithms", "warp", "dreamer_racing.figures.loggers", "dreamer_racing.figures.report",
        "dreamer_racing.learners.latent_ppo", "dreamer_racing.training.session",
    ]
)  # fmt: skip


class Forked:
    """A process that calls a function, with streams of its own.

    Args:
        function: called with the arguments; both can be pickled.
        arguments: given to it.
        cwd: where it works.
        environment: its variables, beside those of this process.
    """

    def __init__(
        self, function: Callable[..., None], *arguments: Any, cwd: Path, environment: Mapping[str, str] | None = None
    ) -> None:
        pipes = [os.pipe() for _ in range(2)]
        streams = [reduction.DupFd(write) for _, write in pipes]
        variables = {**os.environ, **(environment or {})}
        self.process = SERVER.Process(target=_begin, args=(streams, cwd, variables, function, arguments))
        self.process.start()
        self._readers = ThreadPoolExecutor(len(pipes))
        self._said: list[Future[str]] = []
        for read, write in pipes:
            os.close(write)
            self._said.append(self._readers.submit(_read, read))

    def send_signal(self, number: int) -> None:
        """Send a signal to the process."""
        assert self.process.pid is not None
        os.kill(self.process.pid, number)

    def communicate(self, timeout: float) -> subprocess.CompletedProcess[str]:
        """Wait for its end; return exit status and what it said.

        Raises:
            subprocess.TimeoutExpired: it took longer, and was killed.
        """
        self.process.join(timeout)
        if late := self.process.exitcode is None:
            self.process.kill()
            self.process.join()
        output, errors = (text.result() for text in self._said)
        self._readers.shutdown()
        if late:
            raise subprocess.TimeoutExpired(self.process.name, timeout, output, errors)
        assert self.process.exitcode is not None
        return subprocess.CompletedProcess(self.process.name, self.process.exitcode, output, errors)


def _begin(
    streams: list[Any],
    cwd: Path,
    environment: dict[str, str],
    function: Callable[..., None],
    arguments: tuple[Any, ...],
) -> None:
    for stream, number in zip(streams, (1, 2), strict=True):
        os.dup2(stream.detach(), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    # The server has counted threads already, by its own environment; by another number of them sums round differently
    torch.set_num_threads(int(environment.get("OMP_NUM_THREADS", len(os.sched_getaffinity(0)))))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells have what they start in the background ignore it
    try:
        function(*arguments)
    finally:
        atexit._run_exitfuncs()  # which a process of multiprocessing leaves out


def _read(pipe: int) -> str:
    with open(pipe) as stream:
        return stream.read()


def recipe(
    name: str, *overrides: str, cwd: Path, timeout: float = 240, before: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run a recipe in a process of its own, after some lines of Python if need be."""
    return started(name, *overrides, cwd=cwd, before=before).communicate(timeout)


def started(name: str, *overrides: str, cwd: Path, before: str = "") -> Forked:
    """Start a recipe, as `recipe` does."""
    return Forked(_run, str(RECIPES / f"{name}.py"), overrides, before, cwd=cwd)


def program(path: Path, *arguments: str, cwd: Path, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Run any file of Python, as `recipe` does."""
    return Forked(_run, str(path), arguments, "", cwd=cwd).communicate(timeout)


def _run(path: str, overrides: tuple[str, ...], before: str) -> None:
    """Be the recipe, as `python PATH OVERRIDE...` would be."""
    sys.argv = [path, *overrides]
    sys.path.insert(0, str(Path(path).parent))
    exec(before, {})
    runpy.run_path(path, run_name="__main__")
