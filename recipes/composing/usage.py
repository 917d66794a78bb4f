"""What `--help` says of a recipe: its own words, its groups and its options. No torch, so that it is there at once."""

from __future__ import annotations

import ast
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import yaml

from dreamer_racing.commands import from_here, python

FOLDER = Path(__file__).parents[1]
OPTIONS = FOLDER.parent / "docs" / "options.md"
TRAINING = ("dreamer_v3", "ppo", "sac")
WIDTH, COLUMN = 118, 42


class Option(NamedTuple):
    """A row of the page."""

    name: str  # with the sign that follows it
    default: str
    allowed: str
    meaning: str


def answer_help() -> None:
    """Print the help and leave, if the command line of a recipe asks for it."""
    program = Path(sys.argv[0])
    if program.resolve().parent == FOLDER and {"--help", "-h"} & set(sys.argv[1:]):
        try:
            print("\n".join(usage(program.stem)), flush=True)
        except BrokenPipeError:  # `| head` has what it wanted: what is left goes nowhere, also at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


def command(recipe: str) -> str:
    """The words that start a recipe from here: of a clone its file, of an installed package, which holds it, that."""
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
    sections = tables(OPTIONS.read_text(encoding="utf-8"))
    yield "Options (NAME=DEFAULT; `chosen` means: by the recipe, which prints it)"
    family = ""
    shared = sections["All training recipes"] if recipe in TRAINING else []
    options = {option.name: option for option in (*shared, *sections.get(f"recipes/{recipe}.py", []))}
    for name, default, allowed, meaning in options.values():
        if (own := name.partition(".")[0] if "." in name else "") != family:
            family = own
            yield ""
        may_be = f"({allowed})" if allowed else ""
        yield from _entry(f"{name}{default}", " ".join(filter(None, (meaning, may_be))))
    yield from ("", "More: docs/options.md, docs/recipes.md")


def groups(recipe: str) -> dict[str, list[str]]:
    """Return the configuration groups that a recipe composes, and what there is to choose in each."""
    config = FOLDER / "config"
    defaults = yaml.safe_load((config / f"{recipe}.yaml").read_text(encoding="utf-8")).get("defaults", [])
    named = [name for entry in defaults if isinstance(entry, dict) for name in entry if "/" not in name]
    named += ["decoys"] if recipe in TRAINING else []
    choices = {name: sorted(path.stem for path in (config / name).glob("*.yaml")) for name in named}
    return {name: found for name, found in choices.items() if found}


def tables(page: str) -> dict[str, list[Option]]:
    """Read the page of options by its sections."""
    found: dict[str, list[Option]] = {}
    section = ""
    for line in page.splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ").strip("`")
        elif line.startswith("| `"):
            cells = re.split(r"(?<!\\)\|", line)[1:-1]
            option = Option(*(cell.strip().replace("`", "").replace("\\|", "|") for cell in cells))
            found.setdefault(section, []).append(option)
    return found


def _entry(name: str, text: str) -> Iterator[str]:
    """Yield a name, and beside it what it means."""
    lines = wrap(text, WIDTH - COLUMN) or [""]
    if len(name) + 4 > COLUMN:
        yield f"  {name}"
        name = ""
    yield f"  {name:<{COLUMN - 2}}{lines[0]}".rstrip()
    yield from (" " * COLUMN + line for line in lines[1:])
