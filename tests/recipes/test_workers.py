"""Runs that collect on Ray: trained with a worker killed on the way, saved, gone on with, by workers and without."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from dreamer_racing.experience.ray_rollouts import WorkerError
from dreamer_racing.training.directory import latest_checkpoint
from dreamer_racing.training.run import graceful_exit, train
from tests.running_recipes import TINY, compose, recipe, recipe_module, rows

SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.flown=64",
    "loss.ppo.minibatch=32", "logger.every=32", "env.start_on_line=0", "schedule.start_on_line.to=null",
    "workers.patience=120",
]  # fmt: skip


def make_run(*overrides: str):
    """Compose and build a run in this process, begun or continued, as the recipe does."""
    dreamer = recipe_module("dreamer_v3")
    resumed = next((value.partition("=")[2] for value in overrides if value.startswith("resume=")), None)
    given = [*SETTINGS, *overrides, *([f"run_dir={resumed}"] if resumed else [])]
    return dreamer.build(OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", *given))), given)


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_run_outlives_a_worker_and_goes_on_with_workers_or_without(
    ray_cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = f"run_dir={tmp_path}"
    run = make_run(folder, "collector=ray")
    assert run.env.batch_size == (1,) and run.replay.num_streams == 4, "the worlds are the workers'"
    with graceful_exit() as stop:
        for number in range(8):  # of 4 worlds · 8 steps
            rollout = next(run.rollouts)
            run.take_in(rollout)
            if number == 3:
                os.kill(run.rollouts.processes[0][1], signal.SIGKILL)
            run.learn(rollout, stop)
    run.save()
    run.close()
    assert run.rollouts.lost == 1
    assert run.counters["env_steps"] == 9 * 32, "the round under way was taken in before it was saved"
    steps = run.replay.records(0)["is_init"].numel() - int(run.replay.records(0)["is_init"].sum())
    assert steps == 9 * 8, "each env_step of a world is a record of its stream, once"
    assert run.counters["updates"] == int((8 * 32 - 100) * run.config.model.replay_ratio / 64)

    again = make_run(f"resume={tmp_path}", "collector=ray", "num_workers=1", "total_env_steps=384")
    assert again.rollouts.rounds == 9 and again.counters == run.counters
    train(again)
    assert latest_checkpoint(tmp_path).name.endswith(str(384 + 32))  # with the round that was under way
    assert 0 < float(rows(tmp_path)[-2]["collect/weights_age"]) <= 64

    wait = again.rollouts._wait

    def lose_the_next_but_one(asked: list) -> bool:
        if again.rollouts.rounds == 14:
            raise WorkerError("lost")
        return wait(asked)

    monkeypatch.setattr(again.rollouts, "_wait", lose_the_next_but_one)
    again.config.total_env_steps = 1000
    with pytest.raises(WorkerError):
        train(again)
    again.close()
    assert latest_checkpoint(tmp_path).name.endswith(str(384 + 2 * 32)), "what was delivered is saved"

    done = recipe("dreamer_v3", f"resume={tmp_path}", "collector=local", "total_env_steps=480", cwd=tmp_path.parent)
    assert done.returncode == 0, done.stderr
    assert "workers: none (collector=local); left out: num_workers=1, workers.patience=120.0\n" in done.stdout
    assert "collector=local (was ray)" in done.stdout
    assert f"at 448 env_steps, {again.counters['updates']:,} updates" in done.stdout, "all that was learned"
    assert latest_checkpoint(tmp_path).name.endswith("480")
