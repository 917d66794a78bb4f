"""Packages that are not there: how to run a recipe, in place of a traceback. The standard library alone."""

import importlib.util
import sys
from pathlib import Path

FOR_HELP = ("dreamer_racing", "gymnasium", "yaml")
NEEDED = (*FOR_HELP, "hydra", "torch", "mujoco")
"""Imported by all recipes; where one is missing, this is not the project's environment."""
ROOT = Path(__file__).resolve().parents[2]


def refuse_without_packages() -> None:
    """End with status 1 if this Python does not have the project's packages, and say how to run the recipe.

    Raises:
        SystemExit: one is missing.
    """
    needed = FOR_HELP if {"--help", "-h"} & set(sys.argv[1:]) else NEEDED
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    if missing:
        raise SystemExit(f"error: {sys.executable} has no {', '.join(missing)}. {how_to_run(sys.argv[0])}")


def how_to_run(script: str) -> str:
    """Say which command starts a script of this clone with all its packages."""
    if not (ROOT / "dev").is_file():
        return "Install it in this Python: pip install dreamer_racing."
    return (
        f"{ROOT / 'dev'} python {Path(script).absolute()} runs it in the project's environment, which the first start "
        f"makes; in one of your own, pip install -e {ROOT} comes first (docs/installation.md)."
    )
