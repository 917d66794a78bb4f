"""A run's directory: its files, its lock, its journal."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from dreamer_racing.training import directory
from dreamer_racing.training.directory import RunDirectory, RunLock, complete_checkpoints, fresh_directory, replace_text
from dreamer_racing.training.metrics import Journal
from dreamer_racing.training.progress import Interval, Periods


def test_the_best_of_a_run_knows_the_run_and_a_run_that_is_called_best_is_its_own(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    run.best.path.mkdir(parents=True)
    assert run.best.run == run.best  # no run is around it
    run.config.touch()
    assert run.best.run == run == run.run
    assert run.evaluation_file == tmp_path / "run" / "evaluation" / "evaluation.json"


def test_every_start_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = RunDirectory(tmp_path)
    assert run.read_starts() == []
    run.note_start(0, ["track=circle"], "abc")
    run.note_start(4000, ["track=circle", "loss.discount=0.98"], None)
    first, second = run.read_starts()
    assert (first["env_steps"], first["overrides"], first["commit"]) == (0, ["track=circle"], "abc")
    assert (second["env_steps"], second["overrides"][-1], second["commit"]) == (4000, "loss.discount=0.98", None)
    with run.starts.open("a") as file:
        file.write('{damaged}\n{"env_steps": 80')  # killed there
    assert len(run.read_starts()) == 2 and caplog.text.count("is damaged") == 1
    run.note_start(80, [], "def")  # on a line of its own
    assert run.read_starts()[-1]["commit"] == "def"


def test_a_run_is_finished_where_it_says_so(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    assert run.finished_env_steps() == 0
    run.mark_finished(1200)
    assert run.finished_env_steps() == 1200
    for damage in ("", "{", "[]", '{"env_steps": null}', "{}"):
        run.finished.write_text(damage)
        assert run.finished_env_steps() == 0, damage


def test_the_latest_evaluation_is_that_of_the_deterministic_policy(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    assert run.latest_evaluation() is None
    run.evaluations.mkdir()
    for name in ("999999999", "1000000064", "1000000064_stochastic", "notes"):
        (run.evaluations / f"{name}.json").touch()
    assert run.latest_evaluation() == "1000000064"


def test_evaluations_after_the_resumed_env_steps_move(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = RunDirectory(tmp_path)
    for folder, ending in ((run.evaluations, "_stochastic_trajectory.csv"), (run.plots, ".png"), (run.videos, ".mp4")):
        folder.mkdir()
        for name in ("000000100", "000000200", "1000000064", "notes"):
            (folder / f"{name}{ending}").write_text(name)
    run.set_aside_after(100)
    assert sorted(file.name for file in run.plots.iterdir()) == ["000000100.png", "notes.png"]
    aside = tmp_path / "evaluations.replaced"
    assert (aside / "000000200_stochastic_trajectory.csv").read_text() == "000000200" and len(
        list(aside.iterdir())
    ) == 2
    assert "200, 1,000,000,064 env_steps" in caplog.text
    caplog.clear()
    run.set_aside_after(100)
    assert not caplog.text


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_file_is_replaced_whole_or_not_at_all(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "config.yaml"
    replace_text(path, "old")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(directory.os, call, killed)
        with pytest.raises(KeyboardInterrupt):
            replace_text(path, "new")
    assert path.read_text() == "old"
    replace_text(path, "new")
    assert path.read_text() == "new" and [file.name for file in tmp_path.iterdir()] == ["config.yaml"]


def test_the_best_of_a_run_before_there_is_one_says_what_to_do(tmp_path: Path) -> None:
    RunDirectory(tmp_path).config.touch()
    with pytest.raises(FileNotFoundError, match=rf"evaluation writes it.* or give {re.escape(str(tmp_path))} for"):
        complete_checkpoints(tmp_path / "best")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        complete_checkpoints(tmp_path / "better")


# One process at a time in a run directory.


def test_a_directory_in_use_is_refused_until_it_is_released(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    with pytest.raises(ValueError, match=rf"run_dir={tmp_path} is in use by a live run \(process {os.getpid()} on "):
        RunLock(tmp_path)
    lock.release()
    RunLock(tmp_path).release()


def test_replays_of_processes_that_are_no_more_are_deleted(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    for process in ("process-0", "process-1", "process-12"):
        (tmp_path / "replay" / process).mkdir(parents=True)
    run.claim().release()
    assert [path.name for path in (tmp_path / "replay").iterdir()] == ["process-0"]


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    code = f"""if True:
        from dreamer_racing.training.directory import RunLock
        lock = RunLock({str(tmp_path)!r})
        print("held", flush=True)
        input()"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with pytest.raises(ValueError, match=f"process {process.pid} "):
            RunLock(tmp_path)
        process.kill()
        process.wait()
    RunLock(tmp_path).release()


@pytest.mark.parametrize("written", ["never", "before", "after"])
def test_an_abandoned_folder_goes_unless_it_was_there_or_was_written_to(written: str, tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path / "run")
    if written == "before":
        directory.path.mkdir()
    lock = directory.claim()
    if written == "after":
        directory.config.touch()
    lock.abandon()
    assert directory.path.exists() is (written != "never")
    directory.claim().release()  # the next one gets it


def test_a_folder_that_cannot_be_removed_is_unlocked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = RunDirectory(tmp_path / "run")
    lock = directory.claim()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", Mock(side_effect=OSError("busy")))
        lock.abandon()
    directory.claim().release()


# When something is due, and that a resumed run finds the same.


def test_something_is_due_once_a_period() -> None:
    periods = Periods(log=100, never=0)
    assert [steps for steps in range(0, 450, 30) if periods.due("log", steps)] == [120, 210, 300, 420]
    assert not periods.due("never", 10_000) and not periods.due("never", 10_000, last=True)


def test_at_the_end_what_has_been_since_the_latest_is_due() -> None:
    periods = Periods(log=100)
    assert periods.due("log", 100, last=True) and not periods.due("log", 100, last=True)
    assert not periods.due("log", 130) and periods.due("log", 130, last=True)


def test_what_was_due_when_a_run_was_saved_is_due_when_it_goes_on() -> None:
    saved, resumed = (Periods(log=100, save=100) for _ in range(2))
    assert saved.due("log", 130)
    Journal(resumed.latest).load_state_dict(Journal(saved.latest).state_dict())
    assert not resumed.due("log", 130) and resumed.due("save", 130)


@pytest.mark.parametrize(
    ("minutes", "first", "expected"),
    [(0, 0, []), (10, 0, [10, 20]), (0, 2, [2]), (1, 2, list(range(1, 25))), (10, 2, [2, 12, 22])],
)
def test_the_first_time_of_an_interval_may_come_sooner(
    minutes: float, first: float, expected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("dreamer_racing.training.progress.time.monotonic", lambda: now[0])
    interval, due = Interval(minutes, first), []
    for minute in range(1, 25):
        now[0] = 60.0 * minute
        due += [minute] if interval.due() else []
    assert due == expected


def test_a_first_one_comes_before_the_periods_once_and_costs_none_of_them():
    periods = Periods({"evaluate": 30}, evaluate=100, log=100)
    places = (10, 29, 31, 60, 99, 105, 150, 210)
    assert [place for place in places if periods.due("evaluate", place)] == [31, 105, 210]
    assert [place for place in places if periods.due("log", place)] == [105, 210]
    assert not Periods({"evaluate": 30}, evaluate=0).due("evaluate", 40)


def test_an_earlier_evaluation_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert fresh_directory(tmp_path / "evaluation", "evaluation.json").name == "evaluation"
    assert not caplog.text
    for number in (1, 2):
        holding = tmp_path / ("evaluation" if number == 1 else f"evaluation_{number}")
        (holding / "evaluation.json").write_text("{}")
        assert fresh_directory(tmp_path / "evaluation", "evaluation.json").name == f"evaluation_{number + 1}"
        assert f"evaluation_{number + 1}" in caplog.messages[-1]
    (tmp_path / "evaluation_3" / "plots").mkdir()  # of one that was killed
    assert fresh_directory(tmp_path / "evaluation", "evaluation.json").name == "evaluation_4"
    (tmp_path / "evaluation" / "evaluation.json").unlink()
    (tmp_path / "evaluation" / "plots").mkdir()
    assert fresh_directory(tmp_path / "evaluation", "evaluation.json").name == "evaluation_5"  # another has begun in _4
    assert "holds files, but no evaluation.json" in caplog.messages[-1]
    assert fresh_directory(f"{tmp_path}/evaluation/", "evaluation.json") == tmp_path / "evaluation_6"
