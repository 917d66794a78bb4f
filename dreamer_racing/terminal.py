"""Output to terminals and pipes that cannot encode every character, or whose reader has gone."""

from __future__ import annotations

import codecs
import io
import logging
import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

PLAINER = {
    "–": "-", "−": "-", "→": "->", "←": "<-", "…": "...", "×": "x", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-",
    "²": "2", "³": "3", "₁": "1", "₂": "2", "μ": "u", "σ": "sigma", "λ": "lambda", "Δ": "delta", "•": "*", "█": "#",
}  # fmt: skip
"""ASCII replacements of the special characters in this project's texts."""


def take_any_terminal() -> None:
    """Make standard output and error replace characters that they cannot encode by plainer ones, or by `?`.

    Otherwise a print under such a locale (LANG=de_DE.ISO-8859-1, PYTHONIOENCODING=ascii) ends the program.
    """
    codecs.register_error("plainer", _plainer)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            with suppress(OSError):  # raised by streams that are also readable and cannot seek
                stream.reconfigure(errors="plainer")


def start_logging() -> None:
    """Print the package's log messages on stdout, one line each."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stdout, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.INFO)
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def follow_quietly() -> None:
    """Print nothing but warnings and errors, on stderr, in a process other than the first, which prints the rest."""
    sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - until the process ends
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.WARNING)


def say(text: str) -> None:
    """Write a line to standard output and flush it; a full disk or a closed pipe is ignored."""
    with suppress(OSError):
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def leave_terminal() -> None:
    """Redirect standard streams that are terminals to the null device: writes to a closed terminal fail."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(descriptor).st_mode):  # `isatty` is false for a closed terminal
                os.dup2(nowhere, descriptor)
    os.close(nowhere)


def _plainer(error: UnicodeError) -> tuple[str, int]:
    """Replace characters that cannot be encoded; an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(PLAINER.get(letter, "?") for letter in error.object[error.start : error.end]), error.end
