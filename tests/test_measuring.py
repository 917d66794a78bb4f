"""What benchmarks write beside their numbers, and what they measure."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from dreamer_racing import machine
from tests.running_recipes import module_of


def test_records_name_the_commit_that_measuring_began_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measuring = module_of("benchmarks", "measuring")
    begun = machine.provenance()["commit"]
    monkeypatch.setattr(machine, "git_commit", lambda folder: "later")
    assert machine.provenance()["commit"] == "later" != begun
    measuring.write_json([{"speed": 1.0}, {"speed": 2.0}], str(tmp_path / "sub" / "records.json"))
    records = json.loads((tmp_path / "sub" / "records.json").read_text())
    assert [(record["speed"], record["commit"]) for record in records] == [(1.0, begun), (2.0, begun)]


def test_what_is_cloned_stays_the_same_while_the_repository_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first_minutes = module_of("benchmarks", "first_minutes")
    source = tmp_path / "source"
    monkeypatch.setattr(first_minutes, "ROOT", source)
    environment = {**os.environ, "HOME": str(tmp_path), "GIT_CONFIG_NOSYSTEM": "1"}

    def git(*arguments: str, cwd: Path = source) -> str:
        who = ("-c", "user.name=x", "-c", "user.email=x@localhost")
        return subprocess.check_output(["git", *who, *arguments], cwd=cwd, env=environment, text=True).strip()

    git("init", "-q", str(source), cwd=tmp_path)
    commits = []
    for text in ("one", "two"):
        (source / "file").write_text(text)
        git("add", "file")
        git("commit", "-q", "-m", text)
        commits.append(git("rev-parse", "HEAD"))
    for commit, text in zip(commits, ("one", "two"), strict=True):
        first_minutes.clone_at(commit, tmp_path / text, environment)
        assert git("rev-parse", "HEAD", cwd=tmp_path / text) == commit
        assert (tmp_path / text / "file").read_text() == text


def test_a_variable_to_keep_that_is_not_set_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["first_minutes.py", "--keep", "PATH", "NOT_SET_ANYWHERE"])
    with pytest.raises(SystemExit, match="2"):
        module_of("benchmarks", "first_minutes").main()
    assert "--keep NOT_SET_ANYWHERE: not set" in capsys.readouterr().err
