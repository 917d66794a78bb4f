"""What programs say, where a terminal or a pipe does not take every letter, or nobody reads any more."""

from __future__ import annotations

import codecs
import io
import os
import stat
import sys
from contextlib import suppress

PLAINER = {
    "–": "-", "−": "-", "→": "->", "←": "<-", "…": "...", "×": "x", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-",
    "²": "2", "³": "3", "₁": "1", "₂": "2", "μ": "u", "σ": "sigma", "λ": "lambda", "Δ": "delta", "•": "*", "█": "#",
}  # fmt: skip
"""Letters of this project's texts that not every encoding has."""


def take_any_terminal() -> None:
    """Let standard output and error write what their encoding has no letters for in plainer ones, or as `?`.

    Otherwise a print under such a locale (LANG=de_DE.ISO-8859-1, PYTHONIOENCODING=ascii) ends the program.
    """
    codecs.register_error("plainer", _plainer)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # of a stream that is read, too, and cannot be sought in
                stream.reconfigure(errors="plainer")


def say(text: str) -> None:
    """Write a line to standard output, at once; a disk that is full or a reader that left is no reason to end."""
    with suppress(OSError):
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def leave_terminal() -> None:
    """Let what is still written to a terminal go nowhere: one that is gone fails every write to it."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):  # `isatty` denies it of one that is gone
                os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _plainer(error: UnicodeError) -> tuple[str, int]:
    """Replace letters that cannot be encoded, as an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(PLAINER.get(letter, "?") for letter in error.object[error.start : error.end]), error.end
