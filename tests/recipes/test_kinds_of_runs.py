"""Runs of every kind, as a user starts them: without images, in the Control Suite, ended by a signal ..."""

from __future__ import annotations

import json
import math
import signal
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.modules import Interface
from dreamer_racing.training.checkpoint import newest_sound
from dreamer_racing.training.directory import RunDirectory, env_steps_of, latest_checkpoint
from tests.running_recipes import (
    AT_THE_END,
    TINY,
    UNDRAWN,
    build,
    completed,
    compose,
    recipe,
    recipe_module,
    refused,
    rows,
    started,
)

SLOW_DISK = """
import pathlib, time
import dreamer_racing.training.checkpoint as checkpoint
def save(*_):
    pathlib.Path("saving slowly").touch()
    time.sleep(100)
checkpoint.RunCheckpoints.save = save
"""


@pytest.mark.parametrize(
    ("number", "times"),
    [(signal.SIGINT, 1), (signal.SIGHUP, 1), (signal.SIGTERM, 2)],  # one SIGTERM: test_resume.py
    ids=["INT", "HUP", "TERM twice"],
)
def test_a_signal_saves_and_exits_cleanly_and_a_second_one_does_not_save(
    number: signal.Signals, times: int, tmp_path: Path
) -> None:
    settings = [*TINY, "env.from_pixels=false", "total_env_steps=1000000", "logger.every=64"]
    run = started("dreamer_v3", *settings, "run_dir=run", cwd=tmp_path, before=SLOW_DISK if times == 2 else "")
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and run.process.is_alive():
        if (tmp_path / "run" / "metrics.csv").exists() and rows(tmp_path / "run"):
            break
        time.sleep(0.2)
    assert run.process.is_alive() and rows(tmp_path / "run"), run.communicate(timeout=1)
    run.send_signal(number)
    if times == 2:
        while not (tmp_path / "saving slowly").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        assert run.process.is_alive(), run.communicate(timeout=1)
        run.send_signal(number)
    done = run.communicate(timeout=120)
    output = done.stdout + done.stderr
    assert done.returncode == 128 + number, output
    assert f"{number.name}: saving; a second signal discards" in output and "Traceback" not in output
    saved = list((tmp_path / "run" / "checkpoints").glob("checkpoint-*"))
    if times == 1:
        assert "of 1,000,000 env_steps" in output and saved
    else:
        assert "abandoned: there is no checkpoint yet" in output and not saved


FULL_DISK = """
import dreamer_racing.training.publishing as publishing
sync, calls = publishing._sync_tree, []
def full(path):
    calls.append(path)
    if len(calls) <= {times}:
        raise OSError(28, "No space left on device")
    sync(path)
publishing._sync_tree = full
"""


def test_a_run_outlives_a_full_disk(tmp_path: Path) -> None:
    """The best and the checkpoint at 128 cannot be written; those at 224 can."""
    overrides = ["evaluation.every=100", "checkpoint.every=100", "run_dir=run"]
    done = completed("dreamer_v3", *TINY, *overrides, cwd=tmp_path, before=UNDRAWN + FULL_DISK.format(times=2))
    assert done.stdout.count("NOT SAVED") == 2 and "No space left" in done.stdout
    assert "The run continues, and tries again" in done.stdout and "GB free" in done.stdout
    assert latest_checkpoint(tmp_path / "run").name == "checkpoint-000000000224"


def test_a_run_that_cannot_be_saved_at_its_end_says_so(tmp_path: Path) -> None:
    before = UNDRAWN + FULL_DISK.format(times=99)
    said = refused("dreamer_v3", *TINY, "run_dir=run", status=1, cwd=tmp_path, before=before)
    assert "could not be written" in said and "There is no checkpoint yet." in said


FULL_FROM_412 = """
import resource, signal
from dreamer_racing.training.session import Session
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
log = Session.log_episodes
def filling(self, rollout):
    full = 412 <= self.env_steps < {until}
    resource.setrlimit(resource.RLIMIT_FSIZE, (100 if full else resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return log(self, rollout)
Session.log_episodes = filling
"""
"""No file can grow beyond 100 bytes from 412 env_steps on, until there is room again."""
WITH_FILMS = [
    *(setting for setting in TINY if setting != "logger=csv"), "model.replay_ratio=1", "total_env_steps=600",
    "evaluation.every=200", "checkpoint.every=200",
]  # fmt: skip


@pytest.mark.parametrize("until", [550, 10_000], ids=["for a while", "to the end"])
def test_a_run_outlives_a_disk_that_takes_nothing_at_all(until: int, tmp_path: Path) -> None:
    """Rows, evaluations, plots, films, TensorBoard, the best and checkpoints; what can be made up for is."""
    before = FULL_FROM_412.format(until=until)
    done = recipe("dreamer_v3", *WITH_FILMS, "run_dir=run", cwd=tmp_path, before=before)
    run_dir = tmp_path / "run"
    assert "Traceback" not in done.stderr, done.stderr
    for what in ("metrics", "checkpoint", "evaluations, plots and videos"):
        assert f"NOT SAVED: {what}: " in done.stdout, done.stdout
    if until == 10_000:
        assert done.returncode == 1 and "error: " in done.stderr, done.stderr
        assert "last good checkpoint" in done.stderr and not (run_dir / "finished.json").exists()
        assert env_steps_of(newest_sound(run_dir)) < 412
        done = recipe("dreamer_v3", "resume=run", cwd=tmp_path, before=UNDRAWN)
    assert done.returncode == 0, done.stderr
    table = rows(run_dir)
    steps = [int(row["env_steps"]) for row in table]
    assert {step // 100 for step in steps} >= {4, 5, 6} and steps == sorted(set(steps)), "no row is missing"
    assert [row["env_steps"] for row in table if row["evaluation/return_mean"]] == ["224", "416", "608"]
    assert env_steps_of(newest_sound(run_dir)) == 608 and (run_dir / "finished.json").exists()


def test_a_disk_that_may_not_be_enough_is_said_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three replays are there at the peak, with checkpoint.keep=2; what a run's own checkpoints take is free for it."""
    composed = recipe_module("dreamer_v3").resolve(compose("dreamer_v3", f"run_dir={tmp_path}", "checkpoint.keep=2"))
    needed = partial(OmegaConf.to_object(composed).checkpoint.disk_needed, 1000, RunDirectory(tmp_path))
    free = SimpleNamespace(free=3000)
    monkeypatch.setattr("shutil.disk_usage", lambda path: free)
    assert "MAY NOT BE ENOUGH" not in needed()
    free.free = 2999
    assert "MAY NOT BE ENOUGH, lower checkpoint.keep= or replay.capacity=" in needed()
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "one").write_bytes(b"x")
    assert "MAY NOT BE ENOUGH" not in needed()
    build(*TINY, f"run_dir={tmp_path / 'run'}")
    assert "0.0 GB free: MAY NOT BE ENOUGH" in capsys.readouterr().out


@pytest.mark.slow
def test_a_run_in_the_control_suite(tmp_path: Path) -> None:
    try:
        ControlSuiteEnv("cartpole_swingup", 1).close()
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    settings = [setting for setting in TINY if not setting.startswith(("track=", "env."))]
    settings += ["env=dmc", "task=cartpole_swingup", "env.episode_steps=40", AT_THE_END]
    completed("dreamer_v3", *settings, "run_dir=run", cwd=tmp_path)
    table = rows(tmp_path / "run")
    assert any(row["episode/return"] for row in table), "an episode has 40 records"
    for column in ("evaluation/return_mean", "loss_image", "held_out/image_error"):
        assert any(row[column] for row in table), column
    assert not any(name.startswith("curriculum/") or "gates" in name for name in table[0])
    assert list((tmp_path / "run" / "videos").glob("*.mp4"))
    for other in ("evaluate", "export"):
        said = refused(other, "checkpoint=run", cwd=tmp_path)
        assert "cartpole_swingup" in said and "race" in said
    refused("dreamer_v3", "resume=run", "task=walker_walk", cwd=tmp_path)


@pytest.mark.slow
def test_a_run_without_images(tmp_path: Path) -> None:
    often = ("checkpoint.minutes=1e-6", "checkpoint.keep=9")
    completed("dreamer_v3", *TINY, "env.from_pixels=false", AT_THE_END, *often, "run_dir=run", cwd=tmp_path)
    run_dir = tmp_path / "run"
    assert len(list((run_dir / "checkpoints").glob("checkpoint-*"))) > 2
    table = rows(run_dir)
    for column in ("loss_vector", "evaluation/gates_per_episode", "evaluation/success_rate"):
        assert any(row[column] for row in table), column
    assert "loss_image" not in table[0]
    assert list((run_dir / "plots").glob("*.png")) and list((run_dir / "evaluations").glob("*.json"))
    completed("evaluate", "checkpoint=run", "episodes=2", "num_envs=2", cwd=tmp_path, before=UNDRAWN)
    assert len(json.loads((run_dir / "evaluation" / "evaluation.json").read_text())["stochastic"]["episodes"]) == 2
    said = refused("dreamer_v3", "resume=run", "env.from_pixels=true", "total_env_steps=9000", cwd=tmp_path)
    assert "was trained with env.from_pixels=false, which cannot change to true" in said


POISON = """
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
step, steps = DroneRacingEnv._step, []

def poisoned(env, tensordict):
    steps.append(0)
    data = step(env, tensordict)
    return data if len(steps) < 45 else data.set("reward_base", data["reward_base"] + float("inf"))

DroneRacingEnv._step = poisoned
"""


@pytest.mark.slow
@pytest.mark.parametrize("every", [100, 0], ids=["checkpoint", "no checkpoint"])
def test_a_loss_that_is_not_finite_ends_the_run(every: int, tmp_path: Path) -> None:
    settings = [*TINY, "env.from_pixels=false", f"checkpoint.every={every}", "total_env_steps=2000"]
    done = recipe("dreamer_v3", *settings, "run_dir=run", cwd=tmp_path, before=POISON)
    assert done.returncode == 1, done.stderr
    run_dir, message = tmp_path / "run", done.stderr[done.stderr.index("error:") :].strip()
    assert "is not finite" in message and "nonfinite_batch.pt" in message and "model.learning_rate" in message
    assert "Traceback" not in message and "\n" not in message
    batch = torch.load(run_dir / "nonfinite_batch.pt", weights_only=True)
    assert batch["reward"].shape == (2, 16, 1) and math.inf in batch["reward"]
    if not every:
        assert "there is no checkpoint yet" in message
        return
    kept = latest_checkpoint(run_dir)
    assert kept.name in message
    for path in kept.rglob("*learner*/**/*.pt"):
        weights = torch.load(path, weights_only=True)["agent"]
        assert all(value.isfinite().all() for value in weights.values()), "what was saved is not the last good state"
    assert int(kept.name.rpartition("-")[2]) >= 100


def test_control_rate_line_starts_and_noise_reach_training_and_evaluation(tmp_path: Path) -> None:
    options = ["env.control_rate=25", "env.start_on_line=0.5", "env.miss_radius=2", "evaluation.start_noise=1"]
    options.append("evaluation.episodes=3")
    resolved = recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *TINY, *options, "env.episode_steps=null"))
    assert resolved.env.episode_steps == 500
    config, arena = OmegaConf.to_object(resolved), recipe_module("composing.building")
    env = arena.make_env(config)
    assert (env.worlds.parameters.control_dt, env.worlds.race.episode_steps) == (0.04, 500)
    assert (env.worlds._starts._on_line, env.worlds.race._sweep._miss_radius) == (0.5, 2)
    learner = recipe_module("composing.building").make_learner(config, Interface.of(env), "cpu")
    env.close()
    report = arena.make_evaluator(config, tmp_path, learner)
    assert report._course.base.worlds.parameters.control_dt == 0.04
    assert report._course.base.worlds.race._sweep._miss_radius == 0
    assert report._course.base.worlds.num_envs == 3, "all begin at once, so that every agent meets the same starts"
    assert len({episode.reward_sum for episode in report.evaluate(deterministic=True).episodes}) == 3
    report.close()
