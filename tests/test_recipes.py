"""The recipes, run as a user runs them: every configuration composes, a run leaves what it promises and goes on."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "recipes" / "config"
SMALL = [
    "track=circle", "model=debug", "env.num_envs=4", "prefill=400", "total_env_steps=800", "replay.capacity=4000",
    "evaluation.every=400", "evaluation.episodes=2", "evaluation.video_steps=60", "checkpoint.every=400",
    "logger.every=200",
]  # fmt: skip


def recipe(name: str, *overrides: str, cwd: Path, timeout: float = 240) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "recipes" / f"{name}.py"), *overrides]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)


def rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished debug run."""
    directory = tmp_path_factory.mktemp("runs") / "first run"
    done = recipe("dreamer_v3", *SMALL, f"run_dir='{directory}'", cwd=directory.parent)
    assert done.returncode == 0, done.stderr
    assert "device: cpu (device=auto)" in done.stdout and "renderer: " in done.stdout and "GB when full" in done.stdout
    return directory


def compose(recipe_name: str, *overrides: str) -> OmegaConf:
    sys.path.insert(0, str(ROOT / "recipes"))
    try:
        from schema import register
    finally:
        sys.path.pop(0)
    register()
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return hydra.compose(recipe_name, overrides=list(overrides))


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*/*.yaml")), ids=lambda path: f"{path.parent.name}={path.stem}")
def test_every_group_composes(path: Path) -> None:
    config = compose("dreamer_v3", f"{path.parent.name}={path.stem}")
    assert OmegaConf.select(config, path.parent.name) is not None


def test_every_model_config_names_a_known_size() -> None:
    from dreamer_racing.modules import SIZES

    named = {path.stem: OmegaConf.load(path)["size"] for path in (CONFIG / "model").glob("*.yaml")}
    assert named.pop("auto") == "auto"
    assert named.keys() == set(SIZES) and all(name == size for name, size in named.items())


def test_a_run_leaves_what_it_promises(run_dir: Path) -> None:
    table = rows(run_dir)
    assert [int(row["env_steps"]) for row in table] == sorted(int(row["env_steps"]) for row in table)
    last = table[-1]
    assert int(last["env_steps"]) >= 800
    for column in ("episode/return", "episode/gates_passed", "loss_image", "evaluation/gates_per_episode",
                   "time/collect", "rate/env_steps", "curriculum/body_rate_weight"):  # fmt: skip
        assert any(row[column] for row in table), column
    assert list((run_dir / "videos").glob("*.mp4")) and list((run_dir / "plots").glob("*.png"))
    assert list((run_dir / "tensorboard").rglob("events*"))
    assert OmegaConf.load(run_dir / "config.yaml").model.batch_size == 4


def test_resume_continues_where_the_run_stopped(run_dir: Path) -> None:
    before = rows(run_dir)
    done = recipe("dreamer_v3", f"resume='{run_dir}'", "total_env_steps=1000", cwd=run_dir.parent)
    assert done.returncode == 0, done.stderr
    assert "resumed" in done.stdout
    after = rows(run_dir)
    assert [row["env_steps"] for row in after[: len(before)]] == [row["env_steps"] for row in before]
    assert int(after[-1]["env_steps"]) >= 1000
    config = OmegaConf.load(run_dir / "config.yaml")
    assert config.track == "circle" and config.model.size == "debug" and config.total_env_steps == 1000


def test_evaluate_reports_both_policies(run_dir: Path) -> None:
    done = recipe("evaluate", f"checkpoint='{run_dir}'", "episodes=3", "num_envs=2", cwd=run_dir.parent)
    assert done.returncode == 0, done.stderr
    report = json.loads((run_dir / "evaluation" / "evaluation.json").read_text())
    for policy in ("deterministic", "stochastic"):
        assert policy in done.stdout
        assert len(report[policy]["episodes"]) == 3
        for key in ("success_rate", "gates_per_episode", "lap_time_best", "lap_time_mean", "speed_max",
                    "gate_offset_mean", "crashes"):  # fmt: skip
            assert key in report[policy]
        assert (run_dir / "evaluation" / "videos" / f"{policy}.mp4").stat().st_size > 0


def test_checkpoint_of_another_size_is_refused(run_dir: Path) -> None:
    done = recipe("dreamer_v3", f"resume='{run_dir}'", "model=cpu_small", cwd=run_dir.parent)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "debug" in done.stderr and "cpu_small" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_exits_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "recipes" / "dreamer_v3.py"), *SMALL, "total_env_steps=1000000",
               "evaluation.every=0", "checkpoint.every=1000000", "run_dir=run"]  # fmt: skip
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as process:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            if (tmp_path / "run" / "metrics.csv").exists() and rows(tmp_path / "run"):
                break
            time.sleep(0.2)
        process.send_signal(number)
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert number.name in output
    assert list((tmp_path / "run" / "checkpoints").glob("checkpoint-*"))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["total_env_steps=abc"], ["total_env_steps", "abc"]),
        (["track=monza"], ["monza", "kidney"]),
        (["run_dir=/dev/null/run"], ["/dev/null/run"]),
        (["env.preset=hard"], ["hard", "easy", "faithful"]),
        (["env.renderer=directx"], ["directx", "egl"]),
        (["device=cuda:7"], ["cuda:7", "cpu"]),
        (["loss.actor=magic"], ["magic", "reinforce"]),
        (["resume=/nowhere"], ["/nowhere"]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_bad_input_gets_a_plain_error(overrides: list[str], words: list[str], tmp_path: Path) -> None:
    done = recipe("dreamer_v3", "model=debug", *overrides, cwd=tmp_path)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert all(word in done.stderr for word in words), done.stderr
    assert len(done.stderr.strip().splitlines()) <= 6
