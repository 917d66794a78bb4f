"""How tests run recipes, and look into what they leave."""

from __future__ import annotations

import csv
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import hydra
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "recipes" / "config"


def recipe(
    name: str, *overrides: str, cwd: Path, timeout: float = 240, before: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run a recipe as a user does, or after some lines of Python."""
    path = str(ROOT / "recipes" / f"{name}.py")
    start = f"import runpy, sys\nsys.path.insert(0, {str(Path(path).parent)!r})\n{before}\nsys.argv[0] = {path!r}\n"
    program = ["-c", f"{start}runpy.run_path({path!r}, run_name='__main__')"] if before else [path]
    command = [sys.executable, *program, *overrides]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False)


def rows(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def recipe_module(name: str) -> ModuleType:
    """A module of the recipes' folder, which is no package."""
    sys.path.insert(0, str(ROOT / "recipes"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def compose(recipe_name: str, *overrides: str) -> OmegaConf:
    recipe_module("composing.schema").register()
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        return hydra.compose(recipe_name, overrides=list(overrides))
