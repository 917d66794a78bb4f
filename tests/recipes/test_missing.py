"""A recipe that is started by a Python without the project's packages."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.running_recipes import ROOT


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.py")), ids=lambda path: path.stem)
def test_every_recipe_says_how_to_run_it(tmp_path: Path, path: Path) -> None:
    command = [sys.executable, "-S", "-E", str(path)]  # no packages
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "has no dreamer_racing" in done.stderr and f"{ROOT}/dev python {path}" in done.stderr
