"""`benchmarks/gpu.py` without a GPU: its stages run, what fails stops nothing, and what was done is not done again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.running_recipes import ROOT, module_of

SCRIPT = ROOT / "benchmarks" / "gpu.py"
gpu = module_of("benchmarks", "gpu")


@pytest.mark.slow
def test_a_stage_runs_on_a_cpu_and_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The shortest; all of them run by `python benchmarks/gpu.py --device cpu --tiny --json FILE`."""
    command = [str(SCRIPT), "--device", "cpu", "--tiny", "--stages", "probe", "--json", str(tmp_path / "results.jsonl")]
    command += ["--caches", str(tmp_path / "caches")]
    said = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=True).stdout
    records = gpu.read(tmp_path / "results.jsonl")
    assert [(record["name"], record["state"]) for record in records] == [("machine", "done")], said
    assert records[0]["tiny"] and records[0]["copy_gb_per_s"] > 0.0
    monkeypatch.setattr(sys, "argv", command)
    gpu.main()
    assert capsys.readouterr().out == "", "all was done"
    assert gpu.read(tmp_path / "results.jsonl") == records
    assert gpu.identity(records[0]) != gpu.identity(records[0] | {"device": "cuda", "tiny": False})


@pytest.mark.slow
def test_jobs_of_updates_measure_what_they_promise(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Their commands, in this process."""
    monkeypatch.syspath_prepend(SCRIPT.parent)
    found = {}
    for stage in ("learner", "speed"):
        for name, _, command in gpu.STAGES[stage]("cpu", True, tmp_path):
            monkeypatch.setattr(sys, "argv", command)
            gpu.main()
            found[name] = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["captured"]["loss_after"] < found["captured"]["loss_before"]
    kernels = found["kernels of debug eager 2x4"]
    assert kernels["launched"] > 100 and sum(kernels["kernels_ms"].values()) <= kernels["ms"]
    for name in ("debug eager 2x4", "debug eager 2x4 without few kernels"):
        assert found[name]["ms"] > 0.0


def test_what_fails_or_takes_too_long_says_so(tmp_path: Path) -> None:
    failing = gpu.Job("speed", "one", 60.0, ["-c", "raise SystemExit('no kernel image is available')"])
    assert gpu.attempt(failing, 60.0, tmp_path) == {"state": "failed", "why": "no kernel image is available"}
    endless = gpu.Job("speed", "two", 60.0, ["-c", "import time; time.sleep(60)"])
    assert gpu.attempt(endless, 0.2, tmp_path) == {"state": "too long", "why": "more than 0 s"}
    assert "no kernel image is available" in (tmp_path / "failed.log").read_text()


def test_a_failed_job_stops_no_other_and_is_tried_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    commands = {"a": ["-c", "raise SystemExit('bad')"], "b": ["-c", "print('well')"]}
    monkeypatch.setattr(gpu, "STAGES", {"probe": lambda *_: ((name, 60.0, each) for name, each in commands.items())})
    results = tmp_path / "results.jsonl"
    results.write_text('{"cut sho')
    options = ["gpu.py", "--json", str(results), "--device", "cpu", "--caches", str(tmp_path)]
    states = []
    for begin in (["-c", "raise SystemExit('bad')"], ["-c", "print('better')"]):
        commands["a"] = begin
        monkeypatch.setattr(sys, "argv", options)
        gpu.main()
        states.append([(record["name"], record["state"]) for record in gpu.read(results)])
    assert states[0] == [("a", "failed"), ("b", "done")]
    assert states[1] == [*states[0], ("a", "done")]


def test_no_job_begins_when_the_budget_is_spent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    results = tmp_path / "results.jsonl"
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--json", str(results), "--device", "cpu", "--budget", "1"])
    gpu.main()
    assert "budget of 1 s is spent before probe machine" in capsys.readouterr().out
    assert not results.exists()


def test_the_table_says_what_was_not_run(tmp_path: Path) -> None:
    page, results = tmp_path / "page.md", tmp_path / "results.jsonl"
    page.write_text(f"before\n{gpu.BEGIN}\nold\n{gpu.END}\nafter\n")
    record = {
        "stage": "speed",
        "name": "size12m graph 64x16",
        "state": "done",
        "ms": 12.34,
        "device": "cuda",
        "tiny": False,
        "gpu": "NVIDIA H200",
        "commit": "abc1234",
    }
    records = [
        record | {"name": "size12m eager 64x16", "state": "failed", "why": "out of memory"},
        record,
        record | {"name": "paper_large graph 64x16", "tiny": True},
        record | {"name": "paper_small graph 64x16", "device": "cpu"},
    ]
    results.write_text("".join(json.dumps(each) + "\n" for each in records))
    gpu.write_page(results, page)
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "Measured on NVIDIA H200 at abc1234.\n" in text
    assert "| speed | `size12m graph 64x16` | 12.3 ms |" in text
    assert "| speed | `size12m eager 64x16` | failed: out of memory |" in text
    assert "paper_large" not in text and "paper_small" not in text, "a GPU's numbers come from a GPU"
    others = sum(1 for _ in gpu.speed_jobs("cuda", False, Path())) - 2
    assert f"| speed | {others} other jobs | not run |" in text
    assert "| train | 1 job | not run |" in text and "| train | `kidney`" not in text


def test_the_tests_that_are_named_are_those_that_need_a_gpu() -> None:
    marked = {
        str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("test_*.py") if "mark.gpu" in path.read_text()
    }
    assert marked - {str(Path(__file__).relative_to(ROOT))} == set(gpu.GPU_TESTS)
