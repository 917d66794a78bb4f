"""A run that was killed and resumed equals one that was not, bit for bit: on a CPU, with one thread."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest

from dreamer_racing.training.directory import latest_checkpoint
from tests.robustness.faults import difference, state_of
from tests.running_recipes import UNDRAWN, recipe, rows

SETTINGS = [
    "model=debug", "model.batch_size=2", "model.batch_length=8", "model.replay_ratio=4", "env.num_envs=4",
    "env.episode_steps=40", "env.start_on_line=0.5", "env.control_rate=25", "prefill=64", "replay.capacity=400",
    "replay.recent_share=0.5",
    "evaluation.every=200", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=256",
    "total_env_steps=480", "logger.every=120", "logger=csv", "device=cpu",
    "curriculum.threshold=-100", "curriculum.cooldown=3",
]  # fmt: skip

RACES = ("env.episode_steps", "env.start_on_line", "env.control_rate", "curriculum")
"""Settings of those that are for races."""

BASELINE = [
    "env.from_pixels=false", "network.units=16", "env.num_envs=4", "env.episode_steps=40", "evaluation.every=300",
    "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=512", "total_env_steps=640",
    "logger.every=200", "logger=csv",
    "device=cpu", "curriculum.threshold=-100", "curriculum.cooldown=3",
]  # fmt: skip
SMALL = {
    "ppo": ["rollout_steps=16", "ppo.epochs=2"],
    "sac": ["prefill=64", "replay.capacity=600", "sac.batch_size=16", "sac.replay_ratio=4"],
}
"""What makes a baseline's run short."""


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def train(directory: Path, *overrides: str, name: str = "dreamer_v3", status: int = 0, before: str = "") -> str:
    """Run a recipe to its end, or after some lines of Python to another exit status; return what it said."""
    done = recipe(name, *overrides, cwd=directory, timeout=300, before=UNDRAWN + before)
    assert done.returncode == status and "Traceback" not in done.stderr, done.stderr[-2000:]
    return done.stdout


def kill(run_dir: Path, killed: Path) -> None:
    """Leave of a finished run what is there if it is killed behind its first checkpoint."""
    shutil.copytree(run_dir, killed)
    shutil.rmtree(latest_checkpoint(killed))
    shutil.rmtree(killed / "best")
    (killed / "finished.json").unlink()


RACE = [
    "tuned=race", "evaluation.start_noise=0", "evaluation.stochastic=false", "loss.ppo.kl_target=1e-9",
    "schedule.wait_for_model=1.1", "schedule.wait_every=150", "model.mixed_precision=false",
    "schedule.start_on_line.by=run", "schedule.start_on_line.begin=0",
]  # fmt: skip
"""What races on a CPU."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tuned"),
    [("dreamer_v3", ["tuned=none"]), ("latent_ppo", [*RACE, "loss.ppo.steps=128", "model=debug"])],
    ids=["none", "race"],
)
def test_a_resumed_run_equals_an_uninterrupted_one(name: str, tuned: list[str], tmp_path: Path) -> None:
    train(tmp_path, *SETTINGS, *tuned, "track=circle", "env=faithful", "run_dir=whole", name=name)
    kill(tmp_path / "whole", tmp_path / "killed")
    before = state_of(tmp_path / "killed")
    train(tmp_path, "resume=killed", name=name)
    whole = state_of(tmp_path / "whole")
    (learner,) = (file for file in whole if "learner" in file)
    assert whole[learner]["updates"] - before[learner]["updates"] >= 40
    names = {file.split("/")[1].partition("-")[2] for file in whole}
    assert names == {
        "learner", "replay", "ratio", "counters", "env", "tracker", "collector", "curriculum", "schedule",
        "journal", "random_state", *(["lag"] if name == "latent_ppo" else []),
    }  # fmt: skip
    assert not difference(tmp_path / "whole", tmp_path / "killed")
    assert ("lag/ratio" in rows(tmp_path / "whole")[0]) is (name == "latent_ppo")


@pytest.mark.slow
def test_a_resumed_run_of_the_control_suite_is_evaluated_as_an_uninterrupted_one(tmp_path: Path) -> None:
    """Also its second evaluation: no world remembers how many there were before."""
    settings = [setting for setting in SETTINGS if not setting.startswith((*RACES, "evaluation.every"))]
    settings += ["env.episode_steps=40", "evaluation.every=240"]  # twice
    suite = ["tuned=none", "env=dmc", "task=cartpole_swingup", "env.from_pixels=false", "run_dir=whole"]
    train(tmp_path, *settings, *suite)
    kill(tmp_path / "whole", tmp_path / "killed")
    train(tmp_path, "resume=killed")
    assert not difference(tmp_path / "whole", tmp_path / "killed")


SAVED_BY_THE_CLOCK = """
import itertools, os, signal
from dreamer_racing.training import session
rollouts = itertools.count(1)
def due(self):
    rollout = next(rollouts)
    if rollout == {killed}:
        os.kill(os.getpid(), signal.SIGKILL)
    return rollout == {saved}
session.Interval.due = due
"""
"""Saves behind a rollout as `checkpoint.minutes` does, and is killed behind a later one."""
TERMINATED = """
import os, signal
from dreamer_racing.training.session import Session
make = Session.updates
def updates(self, due):
    for number in make(self, due):
        if self.env_steps == {env_steps} and number == {updates} - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        yield number
Session.updates = updates
"""
"""Gets SIGTERM during one of the updates that are due after a rollout."""
COLLECTED = """
import os, signal
from dreamer_racing.training.session import Session
log = Session.log_episodes
def stopped(self, rollout):
    if self.env_steps == {env_steps}:
        os.kill(os.getpid(), signal.SIGTERM)
    return log(self, rollout)
Session.log_episodes = stopped
"""
"""Gets SIGTERM once a rollout is collected, before anything is learned from it."""
STOPS = {
    "latent_ppo": (
        [
            *SETTINGS, *RACE, "loss.ppo.steps=200", "evaluation.every=250", "checkpoint.every=416", "logger.every=104",
            "total_env_steps=480", "model.replay_ratio=2",
        ],
        [TERMINATED.format(env_steps=416, updates=3)],  # with updates, a row and a checkpoint left to make
    ),
    "sac": ([*BASELINE, *SMALL["sac"]], [TERMINATED.format(env_steps=512, updates=1)]),
    "ppo": ([*BASELINE, *SMALL["ppo"]], [COLLECTED.format(env_steps=512), COLLECTED.format(env_steps=576)]),
}  # fmt: skip
"""By recipe: settings, and at what it is terminated after it was killed."""


@pytest.mark.slow
@pytest.mark.parametrize("name", STOPS)
def test_a_run_writes_the_same_rows_wherever_it_is_stopped(name: str, tmp_path: Path) -> None:
    settings, stops = STOPS[name]
    settings = [*settings, "track=circle", "env=faithful"]
    train(tmp_path, *settings, "run_dir=whole", name=name)
    per_rollout = {"latent_ppo": 32, "sac": 4, "ppo": 64}[name]
    by_the_clock = SAVED_BY_THE_CLOCK.format(saved=256 // per_rollout, killed=384 // per_rollout)
    train(tmp_path, *settings, "run_dir=other", name=name, status=-signal.SIGKILL, before=by_the_clock)
    assert latest_checkpoint(tmp_path / "other").name.endswith("256")
    assert int(rows(tmp_path / "other")[-1]["env_steps"]) > 256, "more rows than the checkpoint knows of"
    for stop in stops:
        train(tmp_path, "resume=other", name=name, status=128 + signal.SIGTERM, before=stop)
    train(tmp_path, "resume=other", name=name)
    assert not difference(tmp_path / "whole", tmp_path / "other")
