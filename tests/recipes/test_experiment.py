"""The experiment runner: which command a run needs next, and an experiment of all algorithms from start to end."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from dreamer_racing.training.directory import RunDirectory, RunLock, latest_checkpoint
from tests.running_recipes import ROOT, compose, recipe, recipe_module, rows, started


def settings(directory: Path, *overrides: str) -> DictConfig:
    return compose("experiment", f"directory={directory}", *overrides)


def next_command(directory: Path, *overrides: str) -> list[str] | None:
    """What the runner would do, told from the recipe on."""
    import hydra

    experiment = recipe_module("experiment")
    config = settings(directory, *overrides)
    with hydra.initialize_config_dir(str(ROOT / "recipes" / "config"), version_base="1.3"):
        command = experiment.next_command(config, [f"directory={directory}", *overrides])
    return None if command is None else [Path(command[1]).name, *command[2:]]


def leave_run(directory: Path, env_steps: int, overrides: list[str], finished: bool = True) -> Path:
    """Leave what a run leaves that got so far: a checkpoint without parts, its overrides, the mark of its end."""
    from torchrl.checkpoint import Checkpoint

    path = directory / "checkpoints" / f"checkpoint-{env_steps:012d}"
    path.parent.mkdir(parents=True)
    Checkpoint().save(path, metadata={"env_steps": env_steps})
    OmegaConf.save(OmegaConf.create([f"run_dir={directory}", *overrides]), directory / "overrides.yaml")
    if finished:
        RunDirectory(directory).mark_finished(env_steps)
    return directory


CHOSEN = ["name=first", "algorithm=sac", "track=circle", "seed=3", "budget=cpu", "variant=state", "env.num_envs=8"]
RUN = "first/sac_circle_state_seed3"
OVERRIDES = ["track=circle", "seed=3", "budget=cpu", "env.num_envs=8", "env.from_pixels=false"]


def test_a_run_starts_with_what_was_given_and_what_its_variant_adds(tmp_path: Path) -> None:
    assert next_command(tmp_path, *CHOSEN) == ["sac.py", f"run_dir={tmp_path / RUN}", *OVERRIDES]


def test_a_variant_of_the_command_line_is_not_handed_to_the_recipe(tmp_path: Path) -> None:
    chosen = [word for word in CHOSEN if not word.startswith("variant=")]
    command = next_command(tmp_path, *chosen, "+variants.slow=['env.num_envs=4']", "variant=slow")
    assert command is not None and command[-1] == "env.num_envs=4" and not any("variants" in word for word in command)


def test_failures_of_an_earlier_command_are_forgotten(tmp_path: Path) -> None:
    report = recipe_module("composing.callbacks")
    note = tmp_path / report.FAILURES / "ppo_circle_slip_seed0.txt"
    note.parent.mkdir()
    note.write_text("variant=slip: must be one of default")
    report.DrawFigures().on_multirun_start(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
    assert not note.exists()


@pytest.mark.parametrize("content", [b"{", b"a: b", b"\xff\xfe\x00", b"!!python/name:os.system", b"- 'x=['"])
def test_damaged_overrides_are_refused_in_words(tmp_path: Path, content: bytes) -> None:
    run_dir = leave_run(tmp_path / RUN, 999_999, OVERRIDES, finished=False)
    (run_dir / "overrides.yaml").write_bytes(content)
    with pytest.raises(ValueError, match=r"overrides\.yaml is damaged|The override x=\[ has no value"):
        next_command(tmp_path, *CHOSEN)


@pytest.mark.parametrize("env_steps", [999_999, 1_000_000], ids=["on the way", "in its last evaluation"])
def test_an_unfinished_run_is_resumed_and_a_finished_one_skipped_unless_more_is_asked_for(
    env_steps: int, tmp_path: Path
) -> None:
    spelt = [*OVERRIDES[:-1], "env.from_pixels=False"]
    run_dir = leave_run(tmp_path / RUN, env_steps, spelt, finished=False)
    assert next_command(tmp_path, *CHOSEN) == ["sac.py", f"resume={run_dir}", "total_env_steps=1000000"]
    RunDirectory(run_dir).mark_finished(1_000_000)
    assert next_command(tmp_path, *CHOSEN) is None
    assert next_command(tmp_path, *CHOSEN, "total_env_steps=900000") is None
    more = next_command(tmp_path, *CHOSEN, "total_env_steps=3000000")
    assert more == ["sac.py", f"resume={run_dir}", "total_env_steps=3000000"]


def test_a_run_goes_on_for_as_long_as_its_recipe_chose(tmp_path: Path) -> None:
    """tuned=auto became tuned=race at the run's beginning, which has a length of its own."""
    length = OmegaConf.load(ROOT / "recipes" / "config" / "tuned" / "race.yaml").total_env_steps
    assert length > settings(tmp_path).total_env_steps
    chosen = ["name=first", "algorithm=dreamer_v3", "track=circle", "seed=3", "budget=none", "variant=default"]
    command = next_command(tmp_path, *chosen)
    assert command is not None
    run_dir = leave_run(
        Path(command[1].removeprefix("run_dir=")), length - 1, [*command[2:], "tuned=race"], finished=False
    )
    assert next_command(tmp_path, *chosen) == ["dreamer_v3.py", f"resume={run_dir}", f"total_env_steps={length}"]
    RunDirectory(run_dir).mark_finished(length)
    assert next_command(tmp_path, *chosen) is None


def test_a_run_with_other_settings_is_not_continued(tmp_path: Path) -> None:
    leave_run(tmp_path / RUN, 1000, OVERRIDES)
    with pytest.raises(ValueError, match=r"other settings \(there, then requested\): env\.num_envs: 8 and 16\."):
        next_command(tmp_path, *CHOSEN[:-1], "env.num_envs=16")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("algorithm=tdmpc", "algorithm=tdmpc: must be one of dreamer_v3, latent_ppo, ppo, sac"),
        ("variant=mad", "variant=mad: must be one of"),
        ("run_dir=runs/x", "run_dir=runs/x is for one run: name a folder for all by directory= and name="),
    ],
)
def test_what_no_run_can_have_is_refused(override: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        next_command(tmp_path, override)


FORKED = """
import os, runpy, signal, subprocess, sys
import hydra.core.global_hydra
class Forked:
    def __init__(self, command, stdout, stderr, start_new_session):
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid:
            return
        status = 1
        try:
            os.setsid()
            os.dup2(stdout.fileno(), 1)
            os.dup2(stderr.fileno(), 2)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL)
            hydra.core.global_hydra.GlobalHydra.instance().clear()
            sys.argv = command[1:]
            runpy.run_path(command[1], run_name="__main__")
            status = 0
        except SystemExit as ended:
            status = ended.code or 0
        except BaseException as error:
            sys.excepthook(type(error), error, error.__traceback__)
        finally:
            sys.stdout.flush()
            os._exit(status)
    def __enter__(self):
        return self
    def __exit__(self, *error):
        pass
    def send_signal(self, number):
        os.kill(self.pid, number)
    def wait(self):
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
popen = subprocess.Popen
subprocess.Popen = lambda command, **given: (Forked if "start_new_session" in given else popen)(command, **given)
"""
"""Whole runs, but of processes that have imported what the experiment's has, where starting Python is not the point."""
SHORT = [
    "budget=smoke", "track=circle", "device=cpu", "env.episode_steps=40", "total_env_steps=640", "logger.every=320",
    "evaluation.every=640", "evaluation.episodes=1", "evaluation.video_steps=10", "checkpoint.every=0",
]  # fmt: skip


@pytest.mark.slow
def test_all_algorithms_run_once_and_only_once(tmp_path: Path) -> None:
    algorithms = tuple(recipe_module("composing.schema").RECIPES)
    command = ["--multirun", *SHORT, "name=smoke", f"algorithm={','.join(algorithms)}", "seed=0", "env.image_size=48"]
    first = recipe("experiment", *command, cwd=tmp_path, timeout=600, before=FORKED)
    second = recipe("experiment", *command, "~hydra.callbacks.figures", cwd=tmp_path, timeout=600, before=FORKED)
    assert first.returncode == 0 and second.returncode == 0, first.stderr + second.stderr
    for algorithm in algorithms:
        run_dir = tmp_path / "runs" / "smoke" / f"{algorithm}_circle_default_seed0"
        assert f"{run_dir}: started, budget=smoke" in first.stdout and f"{run_dir}: done" in first.stdout
        assert f"{run_dir}: finished, skipped" in second.stdout
        table = rows(run_dir)
        assert int(table[-1]["env_steps"]) >= 640
        for column in ("loss", "episode/return", "evaluation/success_rate", "curriculum/body_rate_weight", "cpu_clock"):
            assert any(row[column] for row in table), f"{algorithm}: {column}"
        assert list((run_dir / "videos").glob("*.mp4")) and list((run_dir / "plots").glob("*.png"))
        assert OmegaConf.load(run_dir / "config.yaml").algorithm == algorithm
    figures = {path.name for path in (tmp_path / "runs" / "smoke" / "figures").iterdir()}
    assert figures >= {"learning_curves.png", "trajectories.png", "comparison.md", "comparison.png"}
    assert "imagined_dreamer_v3_circle_default_seed0.png" in figures


STATES = ["--multirun", *SHORT, "name=few", "algorithm=ppo", "variant=state"]


@pytest.mark.slow
def test_a_run_that_fails_does_not_stop_the_others_nor_the_figures(tmp_path: Path) -> None:
    runs = tmp_path / "runs" / "few"
    for seed in (0, 1):
        (runs / f"ppo_circle_state_seed{seed}").mkdir(parents=True)
    (runs / "ppo_circle_state_seed0" / "checkpoints").write_text("in the way")
    lock = RunLock(runs / "ppo_circle_state_seed1")
    done = recipe("experiment", *STATES, "seed=0,1,2", cwd=tmp_path, before=FORKED)
    lock.release()
    output = done.stdout + done.stderr
    assert done.returncode == 1, output
    assert "failed: ppo_circle_state_seed0: ppo ended with status 2" in output
    assert "failed: ppo_circle_state_seed1:" in output and "in use by a live run" in output
    assert not (runs / "ppo_circle_state_seed1" / "log.txt").exists(), "a live run's log is its own"
    assert f"{runs / 'ppo_circle_state_seed2'}: done" in output
    assert (runs / "figures" / "learning_curves.png").exists()


@pytest.mark.slow
def test_a_signal_ends_the_experiment_and_the_next_start_goes_on(tmp_path: Path) -> None:
    runs = tmp_path / "runs" / "few"
    length = ["seed=0,1", "evaluation.every=0"]
    metrics, lines = runs / "ppo_circle_state_seed0" / "metrics.csv", 1
    for number, before in ((signal.SIGTERM, ""), (signal.SIGINT, FORKED)):
        launcher = started("experiment", *STATES, *length, "total_env_steps=100000000", cwd=tmp_path, before=before)
        deadline = time.monotonic() + 200
        while not (metrics.exists() and len(metrics.read_text().splitlines()) > lines):
            assert launcher.process.is_alive() and time.monotonic() < deadline
            time.sleep(0.2)
        launcher.send_signal(number)
        done = launcher.communicate(timeout=120)
        output = done.stdout + done.stderr
        assert done.returncode == 128 + number, output
        assert "interrupted" in output and "seed1" not in output and "done" not in output
        assert ("seed0: resumed" in output) == (number == signal.SIGINT), output
        lines = len(metrics.read_text().splitlines())
    reached = int(latest_checkpoint(runs / "ppo_circle_state_seed0").name.rpartition("-")[2])
    last = [f"total_env_steps={reached + 500}", "seed=0"]
    done = recipe("experiment", *STATES, *length, *last, cwd=tmp_path, before=FORKED)
    output = done.stdout + done.stderr
    assert done.returncode == 0 and "seed0: resumed" in output and "seed0: done" in output, output
