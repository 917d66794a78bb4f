"""What every recipe does around its own work: plain errors for bad input, logging, run directories; no torch."""

import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf.errors import MissingMandatoryValue

from composing.messages import say_error
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError


@contextmanager
def plain_errors(applies: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Turn errors that a person can mend into one paragraph on stderr and exit status 2.

    Args:
        applies: whether it does by now; during set-up only, since the same error types inside training are defects,
            and keep their tracebacks.
    """
    try:
        yield
    except (MissingMandatoryValue, ValueError, OSError, RendererUnavailableError) as error:
        if not applies():
            raise
        missing = isinstance(error, MissingMandatoryValue)
        say_error(f"{getattr(error, 'full_key', '')}= is missing, and there is no default." if missing else error)
        raise SystemExit(2) from error


@contextmanager
def plain_disk_errors() -> Iterator[None]:
    """Turn what a full disk does to results into a line on stderr and exit status 1."""
    try:
        yield
    except OSError as error:
        print(f"error: {error}. What was written so far is no whole result.", file=sys.stderr)
        raise SystemExit(1) from error


def start_logging() -> None:
    """Show what the package chose and why, one line each."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stdout, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.INFO)
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def follow_quietly() -> None:
    """Leave it to the first of several processes to say what is the same in all; warnings and errors go to stderr."""
    sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - until the process ends
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.WARNING)


def new_run_dir(recipe: str, track: str) -> Path:
    """A fresh folder name below `runs/`."""
    return Path("runs") / f"{recipe}_{Path(track).stem}_{datetime.now():%Y%m%d-%H%M%S}"


def override_key(override: str) -> str:
    """The setting that an override is of."""
    return override.partition("=")[0].lstrip("+~")


def as_override(name: str, text: str | Path) -> str:
    """Write a setting that is a text so that hydra reads that text, whatever letters are in it."""
    plain, quoted = (f"{name}={word}" for word in (text, QuotedString(str(text), Quote.single).with_quotes()))
    return plain if hydra_takes(plain) and override_value(plain) == str(text) else quoted


def override_value(override: str) -> object:
    """What hydra reads in an override that it takes."""
    return OverridesParser.create().parse_override(override).value()


def hydra_takes(override: str) -> bool:
    """Whether hydra can read an override."""
    try:
        override_value(override)
    except HydraException:
        return False
    return True


def merge_overrides(saved: Iterable[str], given: Sequence[str]) -> list[str]:
    """Overrides of a run that is continued: those it was started with, replaced by the ones given now."""
    replaced = {override_key(override) for override in given}
    return [override for override in saved if override_key(override) not in replaced] + list(given)
