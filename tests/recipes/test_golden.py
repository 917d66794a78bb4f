"""Short runs whose numbers are stored: what is reorganised must leave them as they are.

Each run trains ``model=debug`` on one thread for some 100 updates, and ends with the weights and the metrics that
``golden.json`` has. Floating point differs between processors and library versions, and what flies amplifies that, so
two things are compared:

- where the machine computes as the one that stored them did (`fingerprint`), the digest of all weights and every number
  of ``metrics.csv``, without tolerance;
- everywhere, what is counted, without tolerance, and the losses of the first row, within ``TOLERANCE``: ten times what
  torch's plain kernels (``ATEN_CPU_CAPABILITY=default``) differ from those for AVX2 there. The images are left out of
  that comparison where another OpenGL draws other frames.

After a change that is meant to change numbers, store them anew, and say in the commit why they changed:

    OMP_NUM_THREADS=1 python -m tests.recipes.test_golden
"""

from __future__ import annotations

import csv
import functools
import hashlib
import json
import platform
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from torch import Tensor, nn

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.training.checkpoint import load_state
from tests.running_recipes import UNDRAWN, recipe

STORED = Path(__file__).with_name("golden.json")
CLOCKS = ("time/", "rate/", "wall_clock", "cpu_clock")
"""Columns that a clock writes."""
COUNTED = ("env_steps", "ppo/epochs", "schedule/discount", "schedule/entropy_scale")
"""Columns that no rounding changes."""
FIRST_ROW = ("loss_reward", "loss_continue", "reward_error", "loss_dynamics", "loss_representation", "kl", "loss")
"""Columns whose first row is compared on every machine."""
TOLERANCE = 0.05
"""Relative difference that rounding alone may make there."""

COMMON = [
    "device=cpu", "track=circle", "model=debug", "model.batch_size=4", "model.batch_length=8", "model.replay_ratio=3",
    "model.mixed_precision=false", "env.num_envs=4", "env.image_size=32", "env.episode_steps=40",
    "env.control_rate=25", "prefill=160", "replay.capacity=800", "replay.held_out=1", "logger=csv", "logger.every=400",
    "evaluation.every=0", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=0",
    "total_env_steps=1200",
]  # fmt: skip
SCHEDULES = [
    "loss.ppo.steps=160", "loss.ppo.minibatch=64", "loss.ppo.kl_target=0.0005", "schedule.kl_target.to=0.0003",
    "schedule.kl_target.by=run", "schedule.world_model_rate.by=run", "schedule.max_std.by=run",
    "schedule.max_std.begin=0",
]  # fmt: skip
"""What moves everything that a schedule moves, and the learning rate of the actor by its divergence."""
ALGORITHMS = {"race": "latent_ppo", "images": "latent_ppo", "none": "dreamer_v3", "dynamics": "dreamer_v3"}
RUNS = {
    "race": ["tuned=race", *SCHEDULES, "schedule.wait_for_model=1.02", "schedule.wait_every=200"],
    "images": ["tuned=images", *SCHEDULES, "model.replay_ratio=3"],
    "none": ["tuned=none"],
    "dynamics": ["tuned=none", "loss.actor=dynamics", "model.imagination_starts=16", "model.average_rate=0.01"],
}


def train(name: str, folder: Path) -> dict[str, Any]:
    """Train one of the runs in a folder; return what is stored of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        settings = [*COMMON, *RUNS[name], f"run_dir={name}"]
        done = recipe(ALGORITHMS[name], *settings, cwd=folder, timeout=900, before=UNDRAWN)
    assert done.returncode == 0, done.stderr[-2000:]
    state, metadata = load_state(folder / name, "learner")
    with (folder / name / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {key: [row[key] for row in rows] for key in rows[0] if not key.startswith(CLOCKS)}
    return {
        "updates": state["updates"],
        "env_steps": metadata["env_steps"],
        "weights": digest(state),
        "metrics": columns,
    }


def digest(state: dict[str, Any]) -> str:
    """Return a digest of all weights in a learner's state, whatever they are called."""
    weights = (value.contiguous().numpy().tobytes() for value in weights_in(state))
    return hashlib.sha256(b"".join(sorted(hashlib.sha256(value).digest() for value in weights))).hexdigest()


def weights_in(state: Any, name: str = "") -> Iterator[Tensor]:
    """Find the weights and biases in a state, and not what optimisers keep of them."""
    if isinstance(state, Tensor):
        if re.search(r"(weight|bias|raw_std)$", name):
            yield state
    elif isinstance(state, dict):
        for key, value in state.items():
            if "optimizer" not in str(key):
                yield from weights_in(value, str(key))


def rounding() -> str:
    """Return a digest of plain layers' outputs and gradients: processors of one model may add in another order."""
    threads, before = torch.get_num_threads(), torch.get_rng_state()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    parts = []
    for channels, width in ((8, 64), (16, 200), (64, 511)):
        layers = nn.Sequential(
            nn.Conv2d(3, channels, 4, stride=2, padding=1), nn.SiLU(), nn.Conv2d(channels, channels, 3), nn.Flatten(),
            nn.LazyLinear(width), nn.LayerNorm(width), nn.Tanh(), nn.Linear(width, 3 * width),
        )  # fmt: skip
        output = layers(torch.rand(32, 3, 32, 32)).softmax(-1).square().sum()
        output.backward()
        parts += [output.detach(), *(parameter.grad for parameter in layers.parameters())]
    torch.set_num_threads(threads)
    torch.set_rng_state(before)
    return hashlib.sha256(b"".join(part.contiguous().numpy().tobytes() for part in parts)).hexdigest()[:16]


@functools.cache
def fingerprint() -> dict[str, str]:
    """Say what rounding depends on: versions, the processor, and how OpenGL draws a frame."""
    processor = Path("/proc/cpuinfo")
    lines = processor.read_text().splitlines() if processor.exists() else []
    facts = dict(line.split("\t", 1) for line in lines[: lines.index("")] if "\t" in line) if "" in lines else {}
    cpu = [facts.get(name, "?").strip(" :\t") for name in ("vendor_id", "cpu family", "model")]
    env = DroneRacingEnv(track="circle", num_envs=1, seed=0)
    frame = env.reset()["pixels"].numpy().tobytes()
    env.close()
    return {
        "torch": torch.__version__,
        "mujoco": mujoco.__version__,
        "kernels": torch.backends.cpu.get_cpu_capability(),
        "processor": " ".join((platform.machine(), *cpu)),
        "rounding": rounding(),
        "frame": hashlib.sha256(frame).hexdigest()[:16],
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_the_numbers_are_those_that_are_stored(name: str, tmp_path: Path) -> None:
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    found, expected, here = train(name, tmp_path), stored["runs"][name], fingerprint()
    assert found["metrics"].keys() == expected["metrics"].keys()
    for key in ("updates", "env_steps"):
        assert found[key] == expected[key]
    for column in set(COUNTED) & found["metrics"].keys():
        assert found["metrics"][column] == expected["metrics"][column], column
    if here["frame"] == stored["machine"]["frame"]:
        for column in FIRST_ROW:
            first, wanted = (float(run["metrics"][column][0]) for run in (found, expected))
            assert first == pytest.approx(wanted, rel=TOLERANCE), column
    if here == stored["machine"]:
        assert found["metrics"] == expected["metrics"]
        assert found["weights"] == expected["weights"]


def store() -> None:
    """Train all runs, and write what the test compares with."""
    with tempfile.TemporaryDirectory() as folder:
        runs = {name: train(name, Path(folder)) for name in RUNS}
    stored = {"machine": fingerprint(), "runs": runs}
    lists = re.compile(r"\[\s+([^][]*?)\s+\]")  # a column of a table is a line
    text = lists.sub(lambda found: f"[{' '.join(found[1].split())}]", json.dumps(stored, indent=1))
    STORED.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    import os

    os.environ.setdefault("MUJOCO_GL", "egl")
    store()
