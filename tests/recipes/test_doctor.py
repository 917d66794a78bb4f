"""The doctor: what it finds, and what it says to do."""

from __future__ import annotations

import json
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from dreamer_racing import doctor
from dreamer_racing.experience.replay_place import replay_bytes
from dreamer_racing.modules import SIZES
from tests.running_recipes import compose, recipe, recipe_module, refused

Verdict = doctor.Verdict


def test_it_looks_at_everything_and_says_so(tmp_path: Path) -> None:
    done = recipe("doctor", "--json", cwd=tmp_path)
    found = {finding["what"]: finding for finding in json.loads(done.stdout)}
    assert {"python", "torch", "mujoco", "extras", "gpu", "cores", "threads", "memory", "disk", "egl"} <= found.keys()
    assert found["python"]["state"] == found["torch"]["state"] == "ok"
    assert done.returncode == int(any(finding["state"] == "WRONG" for finding in found.values())), done.stderr
    assert not list(tmp_path.iterdir())


def test_what_does_not_fit_is_wrong_and_ends_with_1(tmp_path: Path) -> None:
    done = recipe("doctor", "replay.capacity=1e10", cwd=tmp_path)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    (memory,) = (number for number, line in enumerate(lines) if line.startswith("memory"))
    assert "WRONG" in lines[memory] and "lower replay.capacity=" in lines[memory + 1]


def test_settings_are_checked(tmp_path: Path) -> None:
    assert "checkpoint.keep=0: must be at least 1" in refused("doctor", "checkpoint.keep=0", cwd=tmp_path)


def test_it_asks_for_what_a_default_run_takes() -> None:
    recipe_module("doctor")  # which has its own schema
    run, asked = compose("dreamer_v3", "tuned=race"), compose("doctor")
    assert (asked.replay.capacity, asked.checkpoint.keep) == (run.replay.capacity, run.checkpoint.keep)
    size = SIZES["cpu_small"]
    context = 2 * size.belief + 2 * size.latents * size.classes  # as LatentFormat packs probabilities
    assert pytest.approx(replay_bytes(1, numbers=21) + context, rel=0.03) == doctor.RECORD_BYTES


def test_missing_and_old_packages_are_named_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp as mujoco_warp requires it, the others as this project does."""
    before = {finding.what: finding for finding in doctor.packages()}
    versions, version_of = {"torch": "2.3.0", "tqdm": None, "warp-lang": "0.9"}, doctor.version_of
    monkeypatch.setattr(doctor, "version_of", lambda name: versions.get(name, version_of(name)))
    found = {finding.what: finding for finding in doctor.packages()}
    assert found["torch"].state is Verdict.wrong and found["torch"].remedy.startswith("pip install 'torch<2.14,>=2.11'")
    assert found["tqdm"][1:3] == (Verdict.wrong, "not installed")
    assert found["torchrl"].state is Verdict.fine
    assert before["warp-lang"] == doctor.Diagnosis("warp-lang", Verdict.fine, version("warp-lang"))
    assert found["warp-lang"][1:3] == (Verdict.wrong, "0.9")
    assert found["warp-lang"].remedy.startswith("pip install 'warp-lang>=")


def test_without_mujoco_warp_it_is_that_which_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def requires(package: str) -> list[str]:
        if package == "mujoco-warp":
            raise PackageNotFoundError(package)
        return ["mujoco-warp==1"]

    monkeypatch.setattr(doctor.importlib.metadata, "requires", requires)
    monkeypatch.setattr(doctor, "version_of", lambda name: None)
    assert [(finding.what, finding.state) for finding in doctor.packages()] == [
        ("mujoco-warp", Verdict.wrong), ("extras", Verdict.fine),
    ]  # fmt: skip


def test_a_torch_without_cuda_beside_a_gpu_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    answer = subprocess.CompletedProcess([], 0, stdout="NVIDIA H200, 570.1, 143771 MiB\n")
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: answer)
    monkeypatch.setattr(doctor, "cuda_of_torch", lambda: None)
    gpu, cuda = doctor.accelerator()
    assert gpu.found.startswith("NVIDIA H200") and cuda.state is Verdict.wrong and "whl" in cuda.remedy
    monkeypatch.setattr(doctor, "cuda_of_torch", lambda: "12.8")
    assert len(list(doctor.accelerator())) == 1


def test_the_cuda_of_torch_is_read_without_importing_it() -> None:
    import torch

    assert doctor.cuda_of_torch() == torch.version.cuda


@pytest.mark.parametrize("asked", ["512", "512,2"])
def test_more_threads_than_cores_are_wrong(asked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", asked)
    threads = next(finding for finding in doctor.cores() if finding.what == "threads")
    assert threads.state is Verdict.wrong and "more threads than cores" in threads.remedy


def test_without_opengl_the_ray_caster_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    program = "import sys; sys.exit('RendererUnavailableError: egl needs libEGL.so.1')"
    monkeypatch.setattr(doctor, "PROBE", program)
    monkeypatch.setattr(doctor, "loads", lambda library: False)
    *_, last = doctor.renderers({"egl": doctor._start_probe("egl")})
    assert last.what == "ray caster" and "apt-get install" in last.remedy
