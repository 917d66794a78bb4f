"""What several test files look through."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure

import dreamer_racing.envs  # noqa: F401 - before TorchRL, as in the package: OpenGL's variables are heeded here


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first, so that no worker is left with a long one at the end."""
    slow = {item.path for item in items if "slow" in item.keywords}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(autouse=True)
def same_numbers_every_time() -> None:
    """A test that draws random numbers without a seed of its own draws the same ones in every run of the suite."""
    random.seed(0)
    torch.default_generator.manual_seed(0)  # torch.manual_seed seeds devices, too, for which it notes a stack
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(0)


@pytest.fixture
def figures(monkeypatch):
    """Figures that were saved, with the canvas drawn."""
    saved = []
    savefig = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kw: (saved.append(self), savefig(self, *args, **kw)))
    return saved


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[None]:
    """A Ray cluster on this machine with two CPUs, however many it has; its workers find tests and recipes."""
    ray = pytest.importorskip("ray", reason="Ray, the extra `ray`, is not installed")
    root = Path(__file__).parents[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", os.pathsep.join(map(str, (root, root / "recipes", *sys.path))))
        ray.init(address="local", num_cpus=2, include_dashboard=False)
    yield
    ray.shutdown()
