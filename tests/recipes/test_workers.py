"""Runs of several processes: workers on Ray, and torchrun."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from dreamer_racing import parallel
from dreamer_racing.experience.ray_rollouts import RayRollouts, WorkerError
from dreamer_racing.experience.replay_place import ReplayPlace
from dreamer_racing.training.directory import latest_checkpoint
from tests.running_recipes import ROOT, TINY, completed, compose, open_session, recipe_module, rows

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

    def lose_the_fifth(self: RayRollouts, asked: list) -> bool:
        if self.rounds == 13:
            raise WorkerError("lost")
        return wait(self, asked)

    monkeypatch.setattr(RayRollouts, "_wait", lose_the_fifth)
    with pytest.raises(WorkerError):
        latent_ppo.train(config, session)
    session.close()
    assert session.collected.rounds == 13, "counted on from the nine before"
    assert latest_checkpoint(tmp_path).name.endswith(str(13 * 32)), "what was delivered is saved"
    ages = [float(row["collect/weights_age"]) for row in rows(tmp_path)[9:] if row["collect/weights_age"]]
    assert ages and all(0 < age <= 64 for age in ages)

    done = completed("latent_ppo", f"resume={tmp_path}", "collector=local", "total_env_steps=480", cwd=tmp_path.parent)
    assert "workers: none (collector=local); ignored: num_workers=1, workers.patience=120.0\n" in done.stdout
    assert "collector=local (was ray)" in done.stdout
    assert f"at 416 env_steps, {session.counters['updates']:,} updates" in done.stdout, "all that was learned"
    assert latest_checkpoint(tmp_path).name.endswith("480")


# Runs of several processes, as `torchrun` starts them: trained, ended by a signal, resumed by one; what is refused.


PARALLEL = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "prefill=256",
    "loss.ppo.steps=128", "loss.ppo.minibatch=64", "logger.every=64", "env.start_on_line=0",
    "schedule.start_on_line.to=null",
]  # fmt: skip


def torchrun(processes: int, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}", *arguments]


def wait_for_updates(run_dir: Path, process: subprocess.Popen[str], seconds: float = 240.0) -> None:
    """Wait until the actor has been improved."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and process.poll() is None:
        if (run_dir / "metrics.csv").exists() and any(row.get("ppo/kl") for row in rows(run_dir)):
            return
        time.sleep(0.1)
    process.kill()
    raise AssertionError(process.communicate()[0])


@pytest.mark.slow
def test_two_processes_are_stopped_by_a_signal_and_one_goes_on(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    start = torchrun(2, str(ROOT / "recipes" / "latent_ppo.py"), *PARALLEL, "total_env_steps=1000000", "run_dir=run")
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        start, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        wait_for_updates(run_dir, process)
        process.send_signal(signal.SIGTERM)
        said = process.communicate(timeout=60)[0]
    (saved,) = (run_dir / "checkpoints").iterdir()
    env_steps = int(saved.name.rpartition("-")[2])
    assert f"SIGTERM at {env_steps:,} of 1,000,000 env_steps: saved" in said, said
    for words in ("processes: 2, each with 2 worlds and 2 windows", "run directory:", "SIGTERM: saving"):
        assert said.count(words) == 1, said  # one process speaks
    assert said.count("Traceback") == 1 and "SignalException" in said, "torchrun's own alone"
    manifest = json.loads((saved / "manifest.json").read_text())
    assert manifest["metadata"]["processes"] == 2 and (saved / "process-1" / "manifest.json").exists()
    own = json.loads((saved / "process-1" / "manifest.json").read_text())["components"]
    assert "journal" in manifest["components"] and not {"journal", "learner", "counters"} & own.keys()
    assert OmegaConf.load(run_dir / "config.yaml").env.num_envs == 4, "the configuration is of all"

    done = completed("latent_ppo", "resume=run", f"total_env_steps={env_steps + 64}", cwd=tmp_path)
    assert "saved by another number of processes (2 there, 1 here)" in done.stdout
    assert f"resumed run at {env_steps:,} env_steps" in done.stdout
    assert int(rows(run_dir)[-1]["env_steps"]) == env_steps + 64
    newest = max((run_dir / "checkpoints").iterdir())
    counters = json.loads(next(newest.glob("components/*-counters/value.json")).read_text())
    records = 4 * 16  # of an update, by all processes
    assert counters["updates"] == int((env_steps + 64 - 256) * 5 / records) and not (newest / "process-1").exists()


def share(monkeypatch: pytest.MonkeyPatch, *overrides: str, rank: int = 0, processes: int = 2):
    """The share of one of several processes in a run."""
    monkeypatch.setattr(parallel._here, "processes", processes)
    monkeypatch.setattr(parallel._here, "rank", rank)
    monkeypatch.setenv("LOCAL_RANK", str(rank))
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
    imagines = "model.cuda_graph=true" in overrides
    name, settings = (
        ("dreamer_v3", [one for one in PARALLEL if "ppo" not in one]) if imagines else ("latent_ppo", PARALLEL)
    )
    config = compose(name, *settings, *overrides)
    for name, value in OmegaConf.load(ROOT / "recipes/config/model/debug.yaml").items():
        if OmegaConf.is_missing(config.model, name):
            config.model[name] = value
    return recipe_module("composing.workers").share_of(OmegaConf.to_object(config))


def test_shares_add_up_to_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = [share(monkeypatch, "seed=3", rank=rank) for rank in range(2)]
    assert [own.env.num_envs for own in shares] == [2, 2] and [own.model.batch_size for own in shares] == [2, 2]
    assert [own.loss.ppo.steps for own in shares] == [64, 64] and [own.loss.ppo.minibatch for own in shares] == [32, 32]
    assert [own.replay.capacity for own in shares] == [500, 500], "so that each world has as many records as ever"
    assert [own.replay.held_out for own in shares] == [1, 0]
    assert [own.seed for own in shares] == [3, 1_000_003]


def test_replays_of_all_processes_must_fit_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("dreamer_racing.machine.available_memory", lambda device: 3_000_000_000)
    on_cpu = ReplayPlace(500, 1_000_000_000, "cpu", None)
    on_cpu.prepare()
    monkeypatch.setattr(parallel._here, "processes", 4)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    with pytest.raises(ValueError, match=r"replay.capacity=2,000 needs 4.0 GB when full, and cpu has 3.0 GB left"):
        on_cpu.prepare()
    on_cpu._replace(device="cuda").prepare()  # each has a device of its own
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    on_cpu.prepare()  # the others are on another machine


@pytest.mark.parametrize(
    ("overrides", "processes", "words"),
    [
        (["model.batch_size=5"], 2, ["model.batch_size=5", "2 processes", "model.batch_size=6"]),
        ([], 3, ["env.num_envs=4", "3 processes", "env.num_envs=6", "--nproc-per-node"]),
        (["loss.ppo.minibatch=63"], 2, ["loss.ppo.minibatch=63", "loss.ppo.minibatch=64"]),
        (["replay.held_out=2"], 2, ["replay.held_out=2", "has only 2 of env.num_envs=4"]),
        (["device=cuda"], 2, ["device=cuda", "each of the 2 processes", "has 1", "--nproc-per-node=1"]),
        (["device=cuda:1"], 2, ["device=cuda:1", "device=cuda each gets its own"]),
        (["model.cuda_graph=true"], 2, ["model.cuda_graph=true", "dreamer_v3 exchanges", "recipes/latent_ppo.py"]),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_be_shared_is_refused(
    overrides: list[str], processes: int, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    with pytest.raises(ValueError, match=".") as refused:
        share(monkeypatch, *overrides, processes=processes)
    assert all(word in str(refused.value) for word in words), refused.value


def test_recipes_that_train_in_one_process_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    config = OmegaConf.to_object(compose("sac", "network=small", "env.num_envs=4"))
    with pytest.raises(ValueError, match=r"WORLD_SIZE=2: algorithm=sac trains in one process"):
        config.check()
