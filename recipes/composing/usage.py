"""What a recipe answers before torch is loaded: `--help`, and slips of the pen."""

from __future__ import annotations

import ast
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import wrap

from composing.messages import say_error
from composing.options import FOLDER, groups, options, refuse_slips
from dreamer_racing.commands import from_here, python

WIDTH, COLUMN = 118, 42


def answer_early() -> None:
    """Print the help of the recipe that is started, if it is asked for, or say which setting is none; and leave."""
    program = Path(sys.argv[0])
    if program.resolve().parent != FOLDER:
        return
    if {"--help", "-h"} & set(sys.argv[1:]):
        try:
            print("\n".join(usage(program.stem)), flush=True)
        except BrokenPipeError:  # `| head` has what it wanted: what is left goes nowhere, also at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)
    try:
        refuse_slips(program.stem, sys.argv[1:])
    except ValueError as error:
        say_error(error)
        raise SystemExit(2) from error


def command(recipe: str) -> str:
    """Return the words that start a recipe from here: of a clone its file, of an installed package, that."""
    installed = (FOLDER.parent / "__main__.py").is_file()
    return f"{python()} -m dreamer_racing {recipe}" if installed else f"{python()} {from_here(FOLDER / recipe)}.py"


def usage(recipe: str) -> Iterator[str]:
    """Yield the lines of a recipe's help."""
    said = ast.get_docstring(ast.parse((FOLDER / f"{recipe}.py").read_text(encoding="utf-8"))) or ""
    said = re.sub(r"python recipes/(\w+)\.py", lambda match: command(match[1]), said)
    yield from (f"usage: {command(recipe)} [NAME=VALUE ...]", "", *said.splitlines(), "")
    if found := groups(recipe):
        yield "Groups: settings that go together (GROUP=CHOICE)"
        for name, choices in found.items():
            yield from _entry(f"{name}=", ", ".join(choices))
        yield ""
    yield "Options (NAME=DEFAULT; `chosen` means: by the recipe, which prints it)"
    family = ""
    for option in options(recipe):
        if (own := option.name.partition(".")[0] if "." in option.name else "") != family:
            family = own
            yield ""
        may_be = f"({option.allowed})" if option.allowed else ""
        text = " ".join(filter(None, (option.meaning, may_be)))
        yield from _entry(f"{option.name}={option.default}".replace("`", ""), text.replace("`", ""))
    yield from ("", "More: docs/options.md, docs/recipes.md")


def _entry(name: str, text: str) -> Iterator[str]:
    """Yield a name, and beside it what it means."""
    lines = wrap(text, WIDTH - COLUMN) or [""]
    if len(name) + 4 > COLUMN:
        yield f"  {name}"
        name = ""
    yield f"  {name:<{COLUMN - 2}}{lines[0]}".rstrip()
    yield from (" " * COLUMN + line for line in lines[1:])
