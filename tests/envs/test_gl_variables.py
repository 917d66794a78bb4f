"""Variables that OpenGL's users read: none of them keeps a drone from flying, and the one in the way is named."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import dreamer_racing.envs
from dreamer_racing.envs import dm_control_gl
from dreamer_racing.envs.gl_variables import VARIABLES
from dreamer_racing.envs.simulator.opengl import loads
from tests.running_recipes import ROOT


def run(program: list[str], tmp_path: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    return subprocess.run(
        [sys.executable, *program], cwd=tmp_path, env={**kept, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("value", ["osmesa", "no_such_thing"])
def test_images_are_drawn_whatever_mujoco_gl_says(tmp_path: Path, value: str) -> None:
    if loads("libOSMesa.so.8") and value == "osmesa":
        pytest.skip("OSMesa is installed here")
    program = (
        "from dreamer_racing.envs import DroneRacingEnv; print(DroneRacingEnv('circle', 1).reset()['pixels'].shape)"
    )
    done = run(["-c", program], tmp_path, MUJOCO_GL=value)
    assert done.returncode == 0 and "64" in done.stdout, done.stderr
    assert done.stderr.count(f"MUJOCO_GL={value} is left out of account") == 1


@pytest.mark.parametrize(
    ("name", "value"), [("MUJOCO_GL", "no_such_thing"), ("PYOPENGL_PLATFORM", "glx"), ("MUJOCO_EGL_DEVICE_ID", "one")]
)
def test_the_doctor_names_the_variable_and_no_package_that_is_there(tmp_path: Path, name: str, value: str) -> None:
    if not loads("libEGL.so.1"):
        pytest.skip("EGL is not installed here")
    done = run([str(ROOT / "recipes" / "doctor.py")], tmp_path, **{name: value})
    assert f"unset {name}" in done.stdout and f"{name}={value}" in done.stdout
    assert "Traceback" not in done.stderr and "apt-get install libegl1" not in done.stdout


def test_dm_control_does_without_opengl_where_none_of_it_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(dm_control_gl, "imports_with_variable", lambda name: False)
    dm_control_gl.import_dm_control()
    assert os.environ["MUJOCO_GL"] == "disable"


def test_what_fails_while_a_module_is_loaded_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(ImportError, match="RaceWorlds cannot be imported: .*glGetError"):
        dreamer_racing.envs.RaceWorlds  # noqa: B018 - is imported
