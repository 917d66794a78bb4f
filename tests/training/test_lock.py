"""One process at a time in a run directory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.parametrize("written", [[], ["config.yaml"]])
def test_what_is_abandoned_leaves_no_folder_unless_something_was_written_to_it(
    written: list[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    lock = RunLock(run)
    for name in written:
        (run / name).touch()
    lock.abandon()
    assert [path.name for path in tmp_path.rglob("*") if path.name != ".lock"] == ["run", *written] * bool(written)
    run.mkdir(exist_ok=True)
    RunLock(run).release()  # the next one gets it
