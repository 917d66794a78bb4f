"""Runs that collect on Ray: trained with a worker killed on the way, saved, gone on with, by workers and without."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from dreamer_racing.experience.ray_rollouts import RayRollouts, WorkerError
from dreamer_racing.training.directory import latest_checkpoint
from tests.running_recipes import TINY, open_session, recipe, recipe_module, rows

SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.steps=64",
    "loss.ppo.minibatch=32", "logger.every=32", "env.start_on_line=0", "schedule.start_on_line.to=null",
    "workers.patience=120",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_run_outlives_a_worker_and_goes_on_with_workers_or_without(
    ray_cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latent_ppo, resumed = recipe_module("latent_ppo"), [f"resume={tmp_path}", f"run_dir={tmp_path}"]
    config, session = open_session(
        *SETTINGS, "collector=ray", f"run_dir={tmp_path}", "total_env_steps=256", name="latent_ppo"
    )
    log, seen = session.log_episodes, []

    def losing_a_worker(rollout):
        seen.append(session.env_steps)
        if len(seen) == 4:  # of 4 worlds · 8 steps
            os.kill(session.collected.processes[0][1], signal.SIGKILL)
        return log(rollout)

    monkeypatch.setattr(session, "log_episodes", losing_a_worker)
    latent_ppo.train(config, session)
    session.close()
    replay = session.parts["replay"]
    assert session.env.batch_size == (1,) and replay.num_streams == 4, "the worlds are the workers'"
    assert session.collected.lost == 1
    assert session.env_steps == 9 * 32, "the round under way at the end is learned from, too"
    steps = replay.records(0)["is_init"].numel() - int(replay.records(0)["is_init"].sum())
    assert steps == 9 * 8, "each env_step of a world is a record of its stream, once"
    assert session.counters["updates"] == int((9 * 32 - 100) * config.model.replay_ratio / 64)

    again = ["collector=ray", "num_workers=1", *resumed]
    config, session = open_session(*SETTINGS, *again, "total_env_steps=1000", name="latent_ppo")
    wait = RayRollouts._wait

    def lose_the_fourteenth(self: RayRollouts, asked: list) -> bool:
        if self.rounds == 13:  # counted on from the nine before
            raise WorkerError("lost")
        return wait(self, asked)

    monkeypatch.setattr(RayRollouts, "_wait", lose_the_fourteenth)
    with pytest.raises(WorkerError):
        latent_ppo.train(config, session)
    session.close()
    assert latest_checkpoint(tmp_path).name.endswith(str(13 * 32)), "what was delivered is saved"
    assert 0 < float(rows(tmp_path)[-2]["collect/weights_age"]) <= 64

    done = recipe("latent_ppo", f"resume={tmp_path}", "collector=local", "total_env_steps=448", cwd=tmp_path.parent)
    assert done.returncode == 0, done.stderr
    assert "workers: none (collector=local); left out: num_workers=1, workers.patience=120.0\n" in done.stdout
    assert "collector=local (was ray)" in done.stdout
    assert f"at 416 env_steps, {session.counters['updates']:,} updates" in done.stdout, "all that was learned"
    assert latest_checkpoint(tmp_path).name.endswith("448")
