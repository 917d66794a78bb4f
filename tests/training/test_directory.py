"""What lies where in a run directory, and the history that it keeps."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dreamer_racing.training import directory
from dreamer_racing.training.directory import RunDirectory, complete_checkpoints, replace_text


def test_a_run_is_found_from_its_checkpoints_and_from_those_of_its_best(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    assert RunDirectory.of(run.checkpoints / "checkpoint-000000000100") == run
    assert RunDirectory.of(run.best.checkpoints / "checkpoint-000000000100") == run.best
    assert run.best.config == tmp_path / "best" / "config.yaml"


def test_the_best_of_a_run_knows_the_run_and_a_run_that_is_called_best_is_its_own(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / "run")
    run.best.path.mkdir(parents=True)
    assert run.best.run == run.best  # no run is around it
    run.config.touch()
    assert run.best.run == run == run.run
    assert run.evaluation_file == tmp_path / "run" / "evaluation" / "evaluation.json"


def test_every_start_is_kept(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    assert run.read_starts() == []
    run.note_start(0, ["track=circle"], "abc")
    run.note_start(4000, ["track=circle", "loss.discount=0.98"], None)
    first, second = run.read_starts()
    assert (first["env_steps"], first["overrides"], first["commit"]) == (0, ["track=circle"], "abc")
    assert (second["env_steps"], second["overrides"][-1], second["commit"]) == (4000, "loss.discount=0.98", None)
    with run.starts.open("a") as file:
        file.write('{"env_steps": 80')  # killed there
    assert len(run.read_starts()) == 2


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


def test_evaluations_of_after_where_a_run_goes_on_step_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
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


def test_a_damaged_line_of_the_history_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = RunDirectory(tmp_path)
    run.note_start(0, [], None)
    with run.starts.open("a") as file:
        file.write("{damaged}\n")
    run.note_start(8, [], None)
    assert [start["env_steps"] for start in run.read_starts()] == [0, 8] and "is damaged" in caplog.text


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_file_is_as_it_was_or_as_it_is_to_be(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(FileNotFoundError, match=rf"first evaluation makes it.* or give {re.escape(str(tmp_path))} for"):
        complete_checkpoints(tmp_path / "best")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        complete_checkpoints(tmp_path / "better")
