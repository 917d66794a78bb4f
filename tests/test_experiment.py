"""The experiment runner: which command a run needs next, and an experiment of all algorithms from start to end."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from tests.running_recipes import ROOT, compose, recipe_module, rows


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


def leave_run(directory: Path, env_steps: int, overrides: list[str]) -> Path:
    """Leave what a run leaves that got so far: a checkpoint without parts, and its overrides."""
    from torchrl.checkpoint import Checkpoint

    path = directory / "checkpoints" / f"checkpoint-{env_steps:012d}"
    path.parent.mkdir(parents=True)
    Checkpoint().save(path, metadata={"env_steps": env_steps})
    OmegaConf.save(OmegaConf.create([f"run_dir={directory}", *overrides]), directory / "overrides.yaml")
    return directory


CHOSEN = ["name=first", "algorithm=sac", "track=circle", "seed=3", "budget=cpu", "variant=state", "env.num_envs=8"]
RUN = "first/sac_circle_state_seed3"
OVERRIDES = ["track=circle", "seed=3", "budget=cpu", "env.num_envs=8", "env.from_pixels=false"]


def test_a_run_starts_with_what_was_given_and_what_its_variant_adds(tmp_path: Path) -> None:
    assert next_command(tmp_path, *CHOSEN) == ["sac.py", f"run_dir={tmp_path / RUN}", *OVERRIDES]


def test_an_unfinished_run_is_resumed_and_a_finished_one_skipped(tmp_path: Path) -> None:
    run_dir = leave_run(tmp_path / RUN, 999_999, OVERRIDES)
    assert next_command(tmp_path, *CHOSEN) == ["sac.py", f"resume={run_dir}", "total_env_steps=1000000"]
    assert next_command(tmp_path, *CHOSEN, "total_env_steps=900000") is None


def test_a_finished_run_goes_on_when_more_is_asked_for(tmp_path: Path) -> None:
    run_dir = leave_run(tmp_path / RUN, 1_000_000, OVERRIDES)
    assert next_command(tmp_path, *CHOSEN) is None
    more = next_command(tmp_path, *CHOSEN, "total_env_steps=3000000")
    assert more == ["sac.py", f"resume={run_dir}", "total_env_steps=3000000"]


def test_a_run_with_other_settings_is_not_continued(tmp_path: Path) -> None:
    leave_run(tmp_path / RUN, 1000, OVERRIDES)
    with pytest.raises(ValueError, match=r"holds a run with other settings.*: env\.num_envs=16, env\.num_envs=8\."):
        next_command(tmp_path, *CHOSEN[:-1], "env.num_envs=16")


@pytest.mark.parametrize(
    ("override", "words"),
    [("algorithm=tdmpc", "algorithm=tdmpc: there are dreamer_v3, ppo, sac"), ("variant=mad", "variant=mad: there are")],
)
def test_unknown_names_are_refused(override: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        next_command(tmp_path, override)


@pytest.mark.slow
def test_all_algorithms_run_once_and_only_once(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "recipes" / "experiment.py"), "--multirun", "budget=smoke", "name=smoke",
               "algorithm=dreamer_v3,ppo,sac", "track=circle", "seed=0", "device=cpu"]  # fmt: skip
    first, second = (
        subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
        for _ in range(2)
    )
    assert first.returncode == 0 and second.returncode == 0, first.stderr + second.stderr
    for algorithm in ("dreamer_v3", "ppo", "sac"):
        run_dir = tmp_path / "runs" / "smoke" / f"{algorithm}_circle_default_seed0"
        assert f"{run_dir}: started" in first.stdout and f"{run_dir}: done" in first.stdout
        assert f"{run_dir}: finished, skipped" in second.stdout
        table = rows(run_dir)
        assert int(table[-1]["env_steps"]) >= 1200
        for column in (
            "loss",
            "episode/return",
            "evaluation/success_rate",
            "curriculum/body_rate_weight",
            "wall_clock",
        ):
            assert any(row[column] for row in table), f"{algorithm}: {column}"
        assert list((run_dir / "videos").glob("*.mp4")) and list((run_dir / "plots").glob("*.png"))
        assert OmegaConf.load(run_dir / "config.yaml").algorithm == algorithm
    figures = {path.name for path in (tmp_path / "runs" / "smoke" / "figures").iterdir()}
    assert figures >= {"learning_curves.png", "trajectories.png", "comparison.md", "comparison.png"}
    assert "imagined_dreamer_v3_circle_default_seed0.png" in figures
