"""One process at a time in a run directory."""

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.lock import RunLock


def test_a_directory_in_use_is_refused_until_it_is_released(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    with pytest.raises(ValueError, match=rf"run_dir={tmp_path} is in use by a live run \(process {os.getpid()} on "):
        RunLock(tmp_path)
    lock.release()
    RunLock(tmp_path).release()


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    code = f"""if True:
        from dreamer_racing.training.lock import RunLock
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


def test_an_abandoned_folder_goes_if_it_was_made_for_the_lock(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path / "run")
    directory.claim().abandon()
    assert not directory.path.exists()


@pytest.mark.parametrize("written", ["before", "after"])
def test_an_abandoned_folder_stays_if_it_was_there_or_was_written_to(written: str, tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path / "run")
    if written == "before":
        directory.path.mkdir()
    lock = directory.claim()
    if written == "after":
        directory.config.touch()
    lock.abandon()
    assert directory.path.exists()
    directory.claim().release()  # the next one gets it


def test_what_cannot_be_taken_away_stays_and_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = RunDirectory(tmp_path / "run")
    lock = directory.claim()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", Mock(side_effect=OSError("busy")))
        lock.abandon()
    directory.claim().release()
