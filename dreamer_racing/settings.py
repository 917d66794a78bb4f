"""Settings of a user: range checks of numbers, import of user code by name, and quoting for error messages."""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import math
import os
import sys
from collections.abc import Collection, Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")
ALLOWED = "allowed"


class Range(NamedTuple):
    """Interval of the allowed finite values of a setting; ``open_below`` excludes the lower end."""

    low: float
    high: float = math.inf
    open_below: bool = False

    def __contains__(self, value: Any) -> bool:
        if not is_number(value):
            return False
        above = self.low < value if self.open_below else self.low <= value
        return bool(above and value < math.inf and value <= self.high)

    def __str__(self) -> str:
        """Describe the range in words."""
        if self == FINITE:
            return "finite"
        below = f"{'above' if self.open_below else 'at least'} {_in_digits(self.low)}"
        return below if self.high == math.inf else f"{below} and at most {_in_digits(self.high)}"


def is_number(value: object) -> bool:
    """Return whether a value is a real number, of Python or NumPy; booleans are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _in_digits(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


FINITE = Range(-math.inf, open_below=True)
POSITIVE, NOT_NEGATIVE = Range(0, open_below=True), Range(0)
SHARE, POSITIVE_SHARE = Range(0, 1), Range(0, 1, open_below=True)
COUNT = Range(1)
SEED = Range(0, 2**32 - 1)
_WHOLE = (int, "int", int | None, "int | None")
"""Type annotations of fields that hold whole numbers."""


def setting(default: Any, allowed: Range) -> Any:
    """Return a dataclass field with a default and a range of allowed values; None is allowed if the type says so."""
    return dataclasses.field(default=default, metadata={ALLOWED: allowed})


def allowed_values(config: Any, name: str) -> Range | None:
    """Return the allowed range of a field of a dataclass or its instance; None if it has no range."""
    return next((field.metadata.get(ALLOWED) for field in dataclasses.fields(config) if field.name == name), None)


def check_settings(config: Any, prefix: str = "") -> None:
    """Check all fields made by `setting`, of a dataclass and those nested in it; ``prefix`` goes before their names.

    Raises:
        ValueError: A value is not a number, out of its range, or not whole where it must be; the message gives the
            setting, its value, and what is allowed.
    """
    for field in dataclasses.fields(config):
        value, allowed = getattr(config, field.name), field.metadata.get(ALLOWED)
        if dataclasses.is_dataclass(value):
            check_settings(value, f"{prefix}{field.name}.")
        elif allowed is not None and not (value is None and "None" in str(field.type)):
            check_setting(f"{prefix}{field.name}", value, allowed, whole=field.type in _WHOLE)


def check_setting(name: str, value: object, allowed: Range, whole: bool = False) -> None:
    """Raise ``ValueError`` unless the value of a setting is a number in a range, and whole if asked."""
    is_whole = isinstance(value, Integral) or (isinstance(value, Real) and float(value).is_integer())
    if not is_number(value):
        raise ValueError(f"{name}={quoted(value)}: must be a number, {allowed}.")
    if value not in allowed:
        finite = ", and finite" if value == math.inf and allowed != FINITE else ""
        raise ValueError(f"{name}={value}: must be {allowed}{finite}.")
    if whole and not is_whole:
        raise ValueError(f"{name}={value}: must be a whole number, {allowed}.")


def check_numbers(whole: Mapping[str, object], real: Mapping[str, object]) -> None:
    """Raise ``ValueError`` unless arguments, given by name, are numbers: ``whole`` ones, or also fractions."""
    for values, kind, words in ((whole, Integral, "a whole number"), (real, Real, "a number")):
        for name, value in values.items():
            if isinstance(value, bool) or not isinstance(value, kind):
                raise ValueError(f"{name}={quoted(value)}: must be {words}.")


def check_three(name: str, values: object, allowed: Range) -> None:
    """Raise ``ValueError`` unless a setting is three numbers in a range, one for each axis."""
    three = isinstance(values, Iterable) and not isinstance(values, str) and list(values)
    if not three or len(three) != 3 or not all(value in allowed for value in three):
        raise ValueError(f"{name}={quoted(values)}: must be three numbers, each {allowed}.")


def without_none(**arguments: object) -> dict[str, object]:
    """Return the arguments that are not None."""
    return {name: value for name, value in arguments.items() if value is not None}


def given(value: T | None, field: str, needs_it: str) -> T:
    """Return a required setting; raise ``ValueError``, which says what needs it, if it is None."""
    if value is None:
        raise ValueError(f"{field} is not given: {needs_it} needs it.")
    return value


def shortened(text: str, length: int = 80) -> str:
    """Return a text for a message, cut to ``length`` characters."""
    return text if len(text) <= length else f"{text[:length]}…"


def check_flags(**flags: object) -> None:
    """Raise ``ValueError`` unless arguments are True or False: a string like "no" would be truthy."""
    for name, value in flags.items():
        if value is not True and value is not False:
            raise ValueError(f"{name}={quoted(value)}: must be True or False.")


def quoted(value: object) -> str:
    """Return the shortened ``repr`` of a value, for messages."""
    try:
        return shortened(repr(value))
    except ValueError:  # Python converts no integer of more than 4,300 digits to text
        return "a number of thousands of digits"


def suggestion(word: object, known: Collection[str]) -> str:
    """Return ``" (did you mean x?)"`` for a likely typing error, else an empty string."""
    close = difflib.get_close_matches(str(word), known, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def wrong_choice(name: str, value: object, known: Collection[str]) -> str:
    """Return the message that a setting's value is none of the known ones, with one that may have been meant."""
    return f"{name}={value}: must be one of {', '.join(known)}{suggestion(value, known)}."


def check_choice(name: str, value: object, known: Collection[str]) -> None:
    """Raise ``ValueError`` with the message `wrong_choice` unless a value is one of the known ones."""
    if value not in known:
        raise ValueError(wrong_choice(name, value, known))


def import_own(name: str, asked: str) -> Any:
    """Import a user's class or function by its name, ``module:name``; messages call it ``asked``.

    The working directory is searched last, after the rest of ``sys.path``.

    Raises:
        ValueError: If it cannot be imported; the message says which folders were searched, and what to set.
    """
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError(f"{asked}: must be module:name, a file's name without .py and what it defines.")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise ValueError(f"{asked} cannot be imported: {error}.") from error
        searched = os.environ.get("PYTHONPATH") or "not set"
        raise ValueError(
            f"{asked} was not found: there is no {module}.py in {folder}, nor on PYTHONPATH "
            f"({searched}). Start from the folder that holds it, or set PYTHONPATH to that folder."
        ) from error
    except ImportError as error:
        raise ValueError(f"{asked} cannot be imported: {error}.") from error
    if not hasattr(found, attribute):
        meant = suggestion(attribute, vars(found))
        raise ValueError(f"{asked}: module {module!r} has no {attribute!r}{meant}.")
    return getattr(found, attribute)
