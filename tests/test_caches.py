"""Programs of a user whose home takes no files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from dreamer_racing import caches, doctor
from tests.running_recipes import ROOT


@pytest.fixture
def homeless(tmp_path: Path) -> dict[str, str]:
    """An environment without a home: below a file there is no folder, whoever asks, root too."""
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    kept = {name: value for name, value in os.environ.items() if name not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    return {**kept, "HOME": str(tmp_path / "file" / "home"), "TMPDIR": str(tmp_path / "temporary")}


@pytest.mark.slow
def test_a_race_is_flown_and_it_is_said_once_and_nothing_is_left(tmp_path: Path, homeless: dict[str, str]) -> None:
    program = "import dreamer_racing.envs as envs; envs.DroneRacingEnv('circle', 2, from_pixels=False).rollout(2)"
    done = subprocess.run(
        [sys.executable, "-c", program], env=homeless, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("takes no files (Not a directory)") == 1 and "WARP_CACHE_PATH=FOLDER" in done.stderr
    assert list((tmp_path / "temporary").glob("dreamer_racing_*")) == []


def test_the_doctor_says_so(tmp_path: Path, homeless: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "recipes" / "doctor.py")],
        env=homeless, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("caches")]
    assert "note" in line and "takes no files" in line
    assert "Matplotlib created" not in done.stderr


def test_the_doctor_tries_to_write_where_runs_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "why_not_writable", lambda folder: "Read-only file system")
    found = doctor.disk(1.0, tmp_path / "runs")
    assert found.state.name == "wrong" and f"{tmp_path} takes no files (Read-only file system)" in found.found


def test_without_any_folder_it_is_said_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> str:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(caches, "why_not_writable", lambda folder: "Permission denied")
    monkeypatch.setattr(caches.tempfile, "mkdtemp", full)
    with pytest.raises(caches.CacheError, match=r"Permission denied.*No usable temporary.*WARP_CACHE_PATH=FOLDER"):
        caches.ensure_caches.__wrapped__()


def test_a_user_without_a_home_does_not_write_to_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert caches.why_not_writable(Path("~/.cache/warp")) == "this user has no home"
    assert list(tmp_path.iterdir()) == []
