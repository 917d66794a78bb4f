"""A run that was killed and resumed equals one that was not, bit for bit: on a CPU, with one thread."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from dreamer_racing.training.checkpoint import CHECKSUMS
from dreamer_racing.training.directory import latest_checkpoint
from tests.running_recipes import recipe_module

ROOT = Path(__file__).parents[2]
SETTINGS = [
    "model=debug", "model.batch_size=2", "model.batch_length=8", "model.replay_ratio=4", "env.num_envs=4",
    "env.episode_steps=40", "env.start_on_line=0.5", "env.control_rate=25", "prefill=64", "replay.capacity=700",
    "replay.recent_share=0.5",
    "evaluation.every=500", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=800",
    "total_env_steps=1600", "logger.every=400", "logger=csv", "device=cpu",
    "curriculum.threshold=-100", "curriculum.cooldown=3",
]  # fmt: skip

RACES = ("env.episode_steps", "env.start_on_line", "env.control_rate", "curriculum")
"""Settings of those that are for races."""

BASELINE = [
    "env.from_pixels=false", "network.units=16", "env.num_envs=4", "env.episode_steps=40", "evaluation.every=500",
    "evaluation.episodes=1", "checkpoint.every=1024", "total_env_steps=2048", "logger.every=400", "logger=csv",
    "device=cpu", "curriculum.threshold=-100", "curriculum.cooldown=3",
]  # fmt: skip


SMALL = {
    "ppo": ["rollout_steps=16", "ppo.epochs=2"],
    "sac": ["prefill=64", "replay.capacity=1200", "sac.batch_size=16"],
}
"""What makes a baseline's run short, with 200 updates and more behind its first checkpoint."""


def train(directory: Path, *overrides: str, recipe: str = "dreamer_v3") -> None:
    command = [sys.executable, str(ROOT / "recipes" / f"{recipe}.py"), *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


def parts(run_dir: Path) -> dict[str, Any]:
    """Everything that a checkpoint holds, by file."""
    found: dict[str, Any] = {}
    for path in sorted(latest_checkpoint(run_dir).rglob("*")):
        name = str(path.relative_to(latest_checkpoint(run_dir)))
        if path.suffix == ".pt":
            found[name] = torch.load(path, weights_only=True)
        elif path.suffix in (".zst", ".json") and path.name not in ("manifest.json", CHECKSUMS):
            found[name] = path.read_bytes()
    return found


def learner_updates(checkpoint: dict[str, Any]) -> int:
    return next(value["updates"] for name, value in checkpoint.items() if "learner" in name)


def evaluations(run_dir: Path) -> list[dict[str, str]]:
    """What the evaluations of a run came to."""
    with (run_dir / "metrics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["evaluation/return_mean"]]
    return [{name: row[name] for name in row if name.startswith("evaluation")} for row in rows]


def assert_same(first: Any, second: Any, where: str) -> None:
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second), where
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_same(first[key], second[key], f"{where}/{key}")
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second), where
        for index, (left, right) in enumerate(zip(first, second, strict=True)):
            assert_same(left, right, f"{where}/{index}")
    else:
        assert first == second, where


def kill(run_dir: Path, killed: Path) -> None:
    """Leave of a finished run what is there if it is killed behind its first checkpoint."""
    shutil.copytree(run_dir, killed)
    shutil.rmtree(latest_checkpoint(killed))
    shutil.rmtree(killed / "best")
    (killed / "finished.json").unlink()


RACE = [
    "tuned=race", "evaluation.start_noise=0", "model.imagination_starts=8",
    "evaluation.stochastic=false", "loss.ppo.updates=7", "loss.ppo.flown=200", "loss.ppo.kl_target=1e-9",
    "schedule.wait_for_model=1.1", "schedule.wait_every=300", "model.mixed_precision=false",
]  # fmt: skip
"""What races on a CPU."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "tuned", [["tuned=none"], RACE, [*RACE, "loss.actor=ppo"]], ids=["none", "race", "race in imagination"]
)
def test_a_resumed_run_equals_an_uninterrupted_one(tuned: list[str], tmp_path: Path) -> None:
    train(tmp_path, *SETTINGS, *tuned, "track=circle", "env=faithful", "run_dir=whole")
    kill(tmp_path / "whole", tmp_path / "killed")
    before = parts(tmp_path / "killed")
    train(tmp_path, "resume=killed")
    whole, resumed = parts(tmp_path / "whole"), parts(tmp_path / "killed")
    assert learner_updates(whole) - learner_updates(before) >= 200
    names = {name.split("/")[1].partition("-")[2] for name in whole}
    assert names == {
        "learner", "replay", "counters", "env", "tracker", "collector", "curriculum", "lag", "passes", "random_state"
    }  # fmt: skip
    assert_same(whole, resumed, "checkpoint")


@pytest.mark.slow
def test_a_resumed_run_of_the_control_suite_is_evaluated_as_an_uninterrupted_one(tmp_path: Path) -> None:
    """Also its second evaluation: no world remembers how many there were before."""
    settings = [setting for setting in SETTINGS if not setting.startswith(RACES)]
    suite = ["tuned=none", "env=dmc", "task=cartpole_swingup", "env.from_pixels=false", "run_dir=whole"]
    train(tmp_path, *settings, *suite)
    kill(tmp_path / "whole", tmp_path / "killed")
    train(tmp_path, "resume=killed")
    assert_same(parts(tmp_path / "whole"), parts(tmp_path / "killed"), "checkpoint")
    assert len(found := evaluations(tmp_path / "whole")) == 4
    assert found == evaluations(tmp_path / "killed")


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [name for name in recipe_module("composing.schema").RECIPES if name != "dreamer_v3"])
def test_a_resumed_baseline_equals_an_uninterrupted_one(recipe: str, tmp_path: Path) -> None:
    train(tmp_path, *BASELINE, *SMALL[recipe], "track=circle", "env=faithful", "run_dir=whole", recipe=recipe)
    kill(tmp_path / "whole", tmp_path / "killed")
    before = parts(tmp_path / "killed")
    train(tmp_path, "resume=killed", recipe=recipe)
    whole, resumed = parts(tmp_path / "whole"), parts(tmp_path / "killed")
    assert learner_updates(whole) - learner_updates(before) >= 200
    assert_same(whole, resumed, "checkpoint")
    assert evaluations(tmp_path / "whole") == evaluations(tmp_path / "killed")
