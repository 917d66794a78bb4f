"""Print a recipe's `--help` and refuse mistyped settings, before torch is imported.

The options are read from a file that `python docs/options.py` makes from the recipes' dataclasses.
"""

from __future__ import annotations

import ast
import difflib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from textwrap import wrap
from typing import NamedTuple

import yaml

from composing.messages import say_error
from dreamer_racing import settings
from dreamer_racing.commands import from_here, python

FOLDER = Path(__file__).parents[1]
CONFIG_DIR = FOLDER / "config"
OPTIONS = CONFIG_DIR / "options.json"
"""JSON file with the fields of every `Option`, by recipe."""
FLAGS = {"--json": "json=true"}
"""Flags that are accepted for settings."""
HYDRAS_FLAGS = (
    "--cfg", "--config-dir", "--config-name", "--config-path", "--experimental-rerun", "--help", "--hydra-help",
    "--info", "--multirun", "--package", "--resolve", "--run", "--shell-completion", "--version",
)  # fmt: skip
"""Hydra's own flags; it also accepts prefixes of their names."""
TRAINING = ("dreamer_v3", "latent_ppo", "ppo", "sac")
"""The training recipes."""


WIDTH, COLUMN = 118, 42
"""Characters of a line of help, and those before its second column."""


class Option(NamedTuple):
    """One option, or the fields of one schedule."""

    names: Sequence[str]
    default: str
    allowed: str
    meaning: str
    free: bool  # whether it takes entries of any name

    @property
    def name(self) -> str:
        """The first name, and the last parts of the others."""
        first, *others = self.names
        return ", ".join([first, *(f".{other.rpartition('.')[2]}" for other in others)])


@cache
def options(recipe: str) -> list[Option]:
    """Return all options of a recipe."""
    return [Option(*fields) for fields in json.loads(OPTIONS.read_text(encoding="utf-8"))[recipe]]


def groups(recipe: str) -> dict[str, list[str]]:
    """Return the configuration groups of a recipe, and the choices in each."""
    path = CONFIG_DIR / f"{recipe}.yaml"
    defaults = yaml.safe_load(path.read_text(encoding="utf-8")).get("defaults", []) if path.is_file() else []
    named = [name for entry in defaults if isinstance(entry, dict) for name in entry if "/" not in name]
    named += ["decoys"] if any(option.name == "decoys" for option in options(recipe)) else []
    choices = {name: sorted(path.stem for path in (CONFIG_DIR / name).glob("*.yaml")) for name in named}
    return {name: found for name, found in choices.items() if found}


@cache
def names(recipe: str) -> list[str]:
    """Return the dotted names of all settings of a recipe, and of the groups they are in."""
    found: dict[str, None] = {}
    for option in options(recipe):
        for name in option.names:
            parts = name.split(".")
            found |= dict.fromkeys(".".join(parts[:length]) for length in range(1, len(parts) + 1))
    return list(found)


def no_such_setting(name: str, recipe: str) -> str:
    """Return a message that a recipe has no setting of this name, with the one that may be meant."""
    known = names(recipe)
    if name in known:  # a group that is not among the defaults
        return f"{name}: must be added with a plus: +{name}=..."
    last = {full.rpartition(".")[2]: full for full in known}
    if takers := [f"recipes/{other}.py" for other in TRAINING if recipe in TRAINING and name in names(other)]:
        return f"{name}: there is no such setting of recipes/{recipe}.py; it is for {' and '.join(takers)}."
    close = difflib.get_close_matches(name, known, n=1)
    close = close or [last[word] for word in difflib.get_close_matches(name.rpartition(".")[2], last, n=1)]
    meant = f" (did you mean {close[0]}?)" if close else ""
    return f"{name}: there is no such setting of recipes/{recipe}.py{meant}. docs/options.md has them all."


def check_arguments(recipe: str, arguments: Sequence[str]) -> None:
    """Refuse unknown settings, unknown choices of a group, and settings written as flags."""
    for argument in arguments:
        flag, _, value = argument.partition("=")
        if flag.startswith("--") and flag not in FLAGS and not any(known.startswith(flag) for known in HYDRAS_FLAGS):
            written = f"{flag[2:].replace('-', '_')}={value or 'VALUE'}"
            raise ValueError(f"{argument}: settings are written without dashes, {written}.")
    if any(argument.startswith(("--config", "-c")) for argument in arguments):
        return  # the user's own configurations may have other groups
    found, known = groups(recipe), set(names(recipe))
    free = tuple(f"{option.name}." for option in options(recipe) if option.free)
    for argument in arguments:
        name, equals, value = argument.partition("=")
        name = name.lstrip("+~")
        if not equals or not re.fullmatch(r"[\w.]+", name):
            continue  # hydra's own flags and groups, or no override
        if not (name in known or name.startswith(("hydra.", *free)) or (CONFIG_DIR / name).is_dir()):
            raise ValueError(no_such_setting(name, recipe))
        if name in found and value.replace(" ", "").startswith("[["):  # hydra fails on it
            quoted = settings.shortened(value)
            raise ValueError(f"{name}={quoted}: must be the name of one of the group's configurations.")
        if name in found and re.fullmatch(r"\w+", value) and value not in (*found[name], "null"):
            raise ValueError(settings.wrong_choice(name, value, found[name]))


def handle_help_and_typos() -> None:
    """Print the started recipe's help if asked for, or an error for an unknown setting, and exit; else return."""
    program = Path(sys.argv[0])
    if program.resolve().parent != FOLDER:
        return
    if {"--help", "-h"} & set(sys.argv[1:]):
        try:
            print("\n".join(usage(program.stem)), flush=True)
        except BrokenPipeError:  # e.g. `| head`: discard the rest, also what is flushed at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)
    try:
        check_arguments(program.stem, sys.argv[1:])
    except ValueError as error:
        say_error(error)
        raise SystemExit(2) from error


def command(recipe: str) -> str:
    """Return the shell command that starts a recipe, from the clone or from the installed package."""
    installed = (FOLDER.parent / "__main__.py").is_file()
    return f"{python()} -m dreamer_racing {recipe}" if installed else f"{python()} {from_here(FOLDER / recipe)}.py"


def usage(recipe: str) -> Iterator[str]:
    """Yield the lines of a recipe's help."""
    docstring = ast.get_docstring(ast.parse((FOLDER / f"{recipe}.py").read_text(encoding="utf-8"))) or ""
    docstring = re.sub(r"python recipes/(\w+)\.py", lambda match: command(match[1]), docstring)
    yield from (f"usage: {command(recipe)} [NAME=VALUE ...]", "", *docstring.splitlines(), "")
    if found := groups(recipe):
        yield "Groups: settings that go together (GROUP=CHOICE)"
        for name, choices in found.items():
            yield from _entry(f"{name}=", ", ".join(choices))
        yield ""
    yield "Options (NAME=DEFAULT; `chosen`: the recipe chooses the value and prints it)"
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
    """Yield the lines of a name with its meaning beside it."""
    lines = wrap(text, WIDTH - COLUMN) or [""]
    if len(name) + 4 > COLUMN:
        yield f"  {name}"
        name = ""
    yield f"  {name:<{COLUMN - 2}}{lines[0]}".rstrip()
    yield from (" " * COLUMN + line for line in lines[1:])
