"""What a recipe says when it does not begin: what packages it lacks, errors, and Ctrl-C; by the standard library."""

from __future__ import annotations  # an older Python gets to the words, too

import importlib.util
import os
import signal
import sys
import time
from pathlib import Path
from types import TracebackType

INTERRUPTED = "interrupted"
HEAD_START = 10.0  # s that the first of several processes has to say an error; longer than it takes to end the others
FOR_HELP = ("dreamer_racing", "gymnasium", "yaml")
NEEDED = (*FOR_HELP, "hydra", "torch", "mujoco")
"""Imported by all recipes; where one is missing, this is not the project's environment."""
ROOT = Path(__file__).resolve().parents[2]


def follows() -> bool:
    """Return whether `torchrun` started this process beside a first one."""
    return int(os.environ.get("WORLD_SIZE") or 1) > 1 and os.environ.get("RANK") != "0"


def say_error(error: object) -> None:
    """Say on stderr why nothing was begun.

    Of several processes that `torchrun` started, the first goes ahead: at its end the others are ended too, and so what
    is wrong for all of them is said once.
    """
    if follows():
        time.sleep(HEAD_START)
    print(f"error: {error}", file=sys.stderr, flush=True)


def end_quietly(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Say what ends the interpreter, as `sys.excepthook`: for Ctrl-C, while modules are loaded, a word is enough.

    The process then ends by that signal, as shells expect. Left to the interpreter, status 1 would come of it where
    a function that packages registered for the exit calls `exec`, as the making of a dataclass does.
    """
    if issubclass(kind, KeyboardInterrupt):
        print(INTERRUPTED, file=sys.stderr, flush=True)
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    else:
        sys.__excepthook__(kind, error, trace)


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
