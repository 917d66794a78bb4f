"""Ctrl-C where nothing is there yet that could be saved: a line instead of a traceback."""

import os
import signal
import sys
from types import TracebackType

INTERRUPTED = "interrupted"


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
