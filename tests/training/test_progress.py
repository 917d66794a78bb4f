"""What a run says of itself in a log; `test_live_table.py` is what it shows in a terminal."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dreamer_racing.training.live_table import COLUMNS
from dreamer_racing.training.progress import Progress

METRICS = {"episode/return": 12.345, "episode/gates_passed": 3.0, "rate/updates": 5.5, "loss": 1.25}


def test_a_log_gets_whole_lines_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=1_000_000, env_steps=500_000, seconds=0.0) as progress:
        progress.show({"evaluation/success_rate": 0.5, "evaluation/lap_time_mean": 4.5})
        progress.advance(512_000, updates=0)
        progress.show(METRICS)
        progress.say("evaluation at 512,000 env_steps")
    said = capsys.readouterr()
    assert "\r" not in said.err + said.out
    first, second = said.err.splitlines()
    assert (
        "500,000 of 1,000,000 env_steps, 0/s, measuring how long it takes: evaluation: success 50%, lap (s) 4.50"
        in first
    )
    assert "512,000 of 1,000,000 env_steps" in second
    assert second.endswith(
        "it takes: return 12.35, gates 3.00, loss 1.25, updates/s 5.50; evaluation: success 50%, lap (s) 4.50"
    )
    assert said.out.endswith("evaluation at 512,000 env_steps\n")


def test_a_log_shows_what_a_terminal_does(capsys: pytest.CaptureFixture[str]) -> None:
    metrics = {name: 0.5 for shown in COLUMNS.values() for name in (shown.training, shown.evaluation) if name}
    Progress(total=10, seconds=0.0).show(metrics)
    trained, evaluated = capsys.readouterr().err.partition("it takes: ")[2].strip().split("; evaluation: ")
    assert [part.rpartition(" ")[0] for part in trained.split(", ")] == [w for w, s in COLUMNS.items() if s.training]
    assert [part.rpartition(" ")[0] for part in evaluated.split(", ")] == [
        w for w, s in COLUMNS.items() if s.evaluation
    ]


def test_lines_keep_their_distance(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress(total=10, seconds=3600.0)
    for step in range(10):
        progress.advance(step, updates=0)
        progress.show(METRICS)
    assert capsys.readouterr().err == ""


def test_what_is_not_saved_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    Progress(total=10, seconds=0.0).show(METRICS, unsaved={"checkpoint": 5, "metrics": 1000})
    assert "NOT SAVED checkpoint since 5; metrics since 1,000" in capsys.readouterr().err


def test_a_log_that_takes_no_more_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full").open("w")  # noqa: SIM115 -- its end fails, as everything does
    monkeypatch.setattr(sys, "stdout", full)
    with Progress(total=100) as progress:
        progress.say("evaluation")
    with pytest.raises(OSError, match="No space left"):
        full.close()


def test_of_several_processes_one_alone_speaks(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=10, seconds=0.0, shown=False) as progress:
        progress.show(METRICS)
        progress.evaluating(12, 60)
        progress.say("evaluation")
    assert capsys.readouterr() == ("", "")


def test_a_log_has_no_use_for_how_far_an_evaluation_is(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(total=100, seconds=0.0) as progress:
        progress.evaluating(12, 60)
    assert capsys.readouterr() == ("", "")
