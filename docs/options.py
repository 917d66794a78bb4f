"""Write docs/options.md from the recipes' dataclasses: every option, its default, what it may be, and its meaning.

python docs/options.py            # write the page, and what `--help` of a recipe reads, recipes/config/options.json
python docs/options.py --check    # exit with status 2 if they are not up to date

A field's meaning is the comment behind or above it, or its line under `Attributes:` in the docstring of its class.
"""

import argparse
import importlib
import inspect
import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, get_type_hints

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
sys.path.append(str(RECIPES))  # where the next ones are found, which therefore come behind it

from composing.entry import SCHEMAS  # noqa: E402 - behind the path
from composing.options import OPTIONS, Option  # noqa: E402 - behind the path
from composing.schema import RunConfig  # noqa: E402 - behind the path

from dreamer_racing.settings import ALLOWED  # noqa: E402 - behind the path
from dreamer_racing.training.schedule import Ramp  # noqa: E402 - behind the path

PAGE = Path(__file__).with_name("options.md")
FIRST = ("dreamer_v3", "latent_ppo", "ppo", "sac", "experiment", "evaluate", "perception", "export", "plot")
HEAD = """# Options

Made by `python docs/options.py` from [recipes/composing/schema.py](../recipes/composing/schema.py) and the recipes:
change those, not this page. `--help` of a recipe says the same. Options are [hydra](https://hydra.cc) overrides,
`env.num_envs=64` or, for a whole group, `model=size12m`; the groups are the folders of
[recipes/config](../recipes/config). Where a default is "chosen", the recipe chooses it at its start, from device,
size or budget, and prints it. A wrong name, type or value is an error that names the field.
"""


def main() -> None:
    """Write both files, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only check that both files are up to date")
    arguments = parser.parse_args()
    for path, text in make_files().items():
        if not arguments.check:
            path.write_text(text, encoding="utf-8")
        elif path.read_text(encoding="utf-8") != text:
            parser.error(f"{path.name} is not up to date: run python docs/options.py.")


def make_files() -> dict[Path, str]:
    """Return the text of the page, and that of the file that recipes read."""
    recipes = [*FIRST, *sorted(path.stem for path in RECIPES.glob("*.py") if path.stem not in FIRST)]
    for name in recipes:
        importlib.import_module(name)
    shared, found = list(read_options(RunConfig)), {name: list(read_options(SCHEMAS[name])) for name in recipes}
    parts = [HEAD, section("All training recipes", shared)]
    for name, options in found.items():
        trains = {option.name for option in shared} <= {option.name for option in options}
        parts.append(section(f"`recipes/{name}.py`", [one for one in options if not (trains and one in shared)]))
    rows = {name: ",\n".join(json.dumps(option, ensure_ascii=False) for option in one) for name, one in found.items()}
    read = ",\n".join(f'"{name}": [\n{options}\n]' for name, options in rows.items())
    return {PAGE: "\n".join(parts), OPTIONS: f"{{\n{read}\n}}\n"}


def read_options(config: type, prefix: str = "") -> Iterator[Option]:
    """Yield the options of a dataclass and of those within it."""
    kinds, meanings = get_type_hints(config), read_meanings(config)
    for field in fields(config):
        if field.name == "algorithm" and SCHEMAS.get("experiment") is not config:  # is the recipe
            continue
        name, kind, meaning = f"{prefix}{field.name}", kinds[field.name], meanings.get(field.name, "")
        if kind is Ramp:
            parts = list(read_options(kind, f"{name}."))
            defaults = ", ".join(part.default for part in parts)
            yield Option([part.names[0] for part in parts], defaults, f"`by`: {parts[-1].allowed}", meaning, False)
        elif isinstance(kind, type) and is_dataclass(kind):
            yield from read_options(kind, f"{name}.")
        else:
            allowed = str(field.metadata.get(ALLOWED, ""))
            if isinstance(kind, type) and issubclass(kind, Enum):
                allowed = ", ".join(f"`{member.value}`" for member in kind)
            free = kind is Any or getattr(kind, "__origin__", None) is dict  # Any: of the fields of another dataclass
            default = field.default if field.default_factory is MISSING else field.default_factory()
            yield Option([name], write_default(default), allowed, meaning, free)


def write_default(value: Any) -> str:
    """Return a default as one would type it."""
    if value is MISSING or value == "???":  # the latter is OmegaConf's word
        return "chosen"
    words = {None: "null", True: "true", False: "false"}
    value = value.value if isinstance(value, Enum) else value
    if value is None or isinstance(value, bool):
        return f"`{words[value]}`"
    if value in ([], {}) or is_dataclass(value):
        return ""
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return f"`{text}`" if text else ""


def read_meanings(config: type) -> dict[str, str]:
    """Return what a class and its bases say of their fields, in docstrings or in comments."""
    found: dict[str, str] = {}
    for base in reversed([base for base in config.__mro__ if is_dataclass(base)]):
        section = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")[2].partition("\n\n")[0]
        for entry in re.split(r"\n(?=    \w)", f"\n{section}")[1:]:
            name, _, text = entry.strip().partition(": ")
            found[name] = " ".join(text.split())
        above = ""
        for line in inspect.getsource(base).splitlines():
            if line.startswith("    # "):
                above += " " + line.strip()[2:]
                continue
            if match := re.match(r"    (\w+): [^#]*(?:#\s*(.*))?$", line):
                found |= {match[1]: text} if (text := (match[2] or above).strip()) else {}
            above = ""
    return {name: text.replace("``", "`") for name, text in found.items()}


def section(title: str, found: Sequence[Option]) -> str:
    """Return a heading and a table."""
    lines = [f"## {title}", "", "| option | default | may be | meaning |", "|---|---|---|---|"]
    for option in found:
        cells = (f"`{option.name}=`", option.default, option.allowed, option.meaning.replace("|", "\\|"))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
