"""`benchmarks/actor_latency.py`: sizes with initial weights are exported, timed, and fly in the loop like any other."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest

from dreamer_racing.hil.flyer import ActorFlyer
from tests.forked import program
from tests.running_recipes import ROOT, recipe_module


@pytest.mark.slow
def test_a_size_is_exported_timed_and_taken_by_the_loop(tmp_path):
    script, folder = ROOT / "benchmarks" / "actor_latency.py", tmp_path / "exports"
    options = ["--sizes", "debug", "--actors", "circle", "--steps", "20", "--keep", str(folder)]
    ended = program(script, *options, "--json", str(tmp_path / "latency.json"), cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    records = json.loads((tmp_path / "latency.json").read_text())
    assert [record["actor"] for record in records] == ["circle", "debug"]
    for record in records:
        assert 0.0 < record["p50_ms"] <= record["p99_ms"] <= record["max_ms"] and record["threads"] == 1
    assert ActorFlyer(folder / "debug").rate == 50.0
    hil = recipe_module("hil")
    config = hil.HilConfig(actor=str(folder / "debug"), run_dir=str(tmp_path / "run"), record=False, pose_port=9127)
    with ExitStack() as opened:
        assert hil.prepare(config, opened).chain.safety.armed is False
