"""What benchmarks write beside their numbers, and what they measure."""

from __future__ import annotations

import json
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
