"""Losses of a user's own, given as ``module:name``."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import Any


def import_own(name: str, kind: str) -> Any:
    """Import what a user has written.

    The folder that a command is started from is looked in last, after all that Python looks in anyway.

    Args:
        name: ``module:name``.
        kind: What it is for, as the message says.

    Raises:
        ValueError: If it cannot be imported; the message says where it was looked for, and what to set.
    """
    module, _, attribute = name.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        return getattr(importlib.import_module(module), attribute)
    except AttributeError as error:
        raise ValueError(f"{kind.capitalize()} {name!r}: module {module!r} has no {attribute!r}.") from error
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise ValueError(f"{kind.capitalize()} {name!r} cannot be imported: {error}.") from error
        searched = os.environ.get("PYTHONPATH") or "not set"
        raise ValueError(
            f"{kind.capitalize()} {name!r} was not found: there is no {module}.py in {folder}, nor on PYTHONPATH "
            f"({searched}). Start from the folder that holds it, or set PYTHONPATH to that folder."
        ) from error
    except ImportError as error:
        raise ValueError(f"{kind.capitalize()} {name!r} cannot be imported: {error}.") from error
