"""A small share of the attacks on every run of the suite; `faults.py` and `fuzz.py` say how to run them whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.robustness import faults, fuzz
from tests.running_recipes import UNDRAWN, recipe


@pytest.mark.slow
@pytest.mark.parametrize("kind", fuzz.CASES)
def test_input_that_nobody_means_is_taken_or_refused(kind: str) -> None:
    record = fuzz.in_a_process(kind, share=0.00625, seed=0)
    assert record["cases"] and not record["failed"], "\n".join(record["failures"])


@pytest.mark.slow
def test_a_run_does_not_care_what_time_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kills, signals, damage and full disks have tests of their own in tests/recipes and tests/training."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    short = ["evaluation.every=200", "total_env_steps=400"]  # a checkpoint and an evaluation on the way
    for name, clock in (("whole", ""), ("still", faults.STILL), ("backwards", faults.BACKWARDS)):
        run = [*faults.SETTINGS, *short, f"run_dir={name}"]
        done = recipe(faults.RECIPE.stem, *run, cwd=tmp_path, before=UNDRAWN + clock)
        assert not faults.trouble(done.returncode, done.stderr), name
        assert not faults.difference(tmp_path / "whole", tmp_path / name), name
