"""Ctrl-C where nothing is there yet that could be saved: a line instead of a traceback."""

import sys
from types import TracebackType

INTERRUPTED = "interrupted"


def end_quietly(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Say what ends the interpreter, as `sys.excepthook`: for Ctrl-C, while modules are loaded, a word is enough."""
    if issubclass(kind, KeyboardInterrupt):
        print(INTERRUPTED, file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
