"""What a recipe says on stderr when it does not begin: errors, once for all processes, and Ctrl-C."""

import os
import signal
import sys
import time
from types import TracebackType

INTERRUPTED = "interrupted"
HEAD_START = 10.0  # s that the first of several processes has to say an error; longer than it takes to end the others


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
