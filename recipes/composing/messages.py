"""Messages of a recipe that does not start: missing packages, errors, Ctrl-C. Needs only the standard library."""

from __future__ import annotations  # so that an older Python reaches the messages, too

import importlib.util
import os
import signal
import sys
import time
from pathlib import Path
from types import TracebackType

INTERRUPTED = "interrupted"
HEAD_START = 10.0  # s that other processes leave the first to print an error; longer than torchrun takes to end them
FOR_HELP = ("dreamer_racing", "gymnasium", "yaml")
NEEDED = (*FOR_HELP, "hydra", "torch", "mujoco")  # if one is missing, this is not the project's environment
ROOT = Path(__file__).resolve().parents[2]


def is_follower_rank() -> bool:
    """Return whether this is one of several processes that `torchrun` started, but not the first."""
    return int(os.environ.get("WORLD_SIZE") or 1) > 1 and os.environ.get("RANK") != "0"


def say_error(error: object) -> None:
    """Print on stderr why nothing was started; other processes than the first wait, until its end ends them too."""
    if is_follower_rank():
        time.sleep(HEAD_START)
    print(f"error: {error}", file=sys.stderr, flush=True)


def end_quietly(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print one word instead of a traceback for Ctrl-C during imports, and end by that signal; a `sys.excepthook`.

    Left to the interpreter, the exit status would be 1 if an exit handler calls `exec`, as dataclasses do.
    """
    if issubclass(kind, KeyboardInterrupt):
        print(INTERRUPTED, file=sys.stderr, flush=True)
        sys.stdout.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    else:
        sys.__excepthook__(kind, error, trace)


def refuse_without_packages() -> None:
    """End with status 1 if this Python does not have the project's packages, and say how to run the recipe."""
    needed = FOR_HELP if {"--help", "-h"} & set(sys.argv[1:]) else NEEDED
    missing = [name for name in needed if importlib.util.find_spec(name) is None]
    how = "Install it in this Python: pip install dreamer_racing."
    if (ROOT / "dev").is_file():
        how = (
            f"Run {ROOT / 'dev'} python {Path(sys.argv[0]).absolute()}: it uses the project's environment, which the "
            f"first start creates. Or install the project in your own: pip install -e {ROOT} (docs/installation.md)."
        )
    if missing:
        raise SystemExit(f"error: {sys.executable} has no {', '.join(missing)}. {how}")
