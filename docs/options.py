"""Write docs/options.md from the recipes' schema: every option with its default, what it may be, and its meaning.

    python docs/options.py            # write the page
    python docs/options.py --check    # exit with status 2 if it is not up to date

A meaning is the comment at a field, or its line under `Attributes:` in the docstring of its dataclass.
"""

import argparse
import dataclasses
import enum
import inspect
import re
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import MISSING

sys.path.append(str(Path(__file__).resolve().parents[1] / "recipes"))  # where the next ones are found

import dashboard
import doctor
import fly
import hil
import plant
import sim_to_real
import tracks
from composing import schema

from dreamer_racing.settings import ALLOWED
from dreamer_racing.training.schedule import RampClock

PAGE = Path(__file__).with_name("options.md")
COMMON, RECIPES = schema.RunConfig, tuple(schema.RECIPES.values())
OTHERS = (
    schema.ExperimentConfig,
    schema.EvaluateConfig,
    schema.PerceptionConfig,
    schema.ExportConfig,
    schema.PlotConfig,
    fly.FlyConfig,
    dashboard.DashboardConfig,
    hil.HilConfig,
    plant.PlantConfig,
    sim_to_real.SimToRealConfig,
    doctor.DoctorConfig,
    tracks.TracksConfig,
)
HEAD = """# Options

Made by `python docs/options.py` from [recipes/composing/schema.py](../recipes/composing/schema.py) and the recipes:
change those, not this page. `--help` of a recipe says the same. Options are [hydra](https://hydra.cc) overrides,
`env.num_envs=64` or, for a whole group, `model=size12m`; the groups are the folders of
[recipes/config](../recipes/config). What is "chosen" is settled by the recipe when it starts, by device, size or
budget, and printed. A wrong name, type or value is refused with the field named.
"""


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare")
    arguments = parser.parse_args()
    text = make_page()
    if not arguments.check:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        parser.error(f"docs/{PAGE.name} is not what the schemas make: run python docs/options.py.")


def make_page() -> str:
    """Return the whole page."""
    shared = list(rows(COMMON))
    parts = [HEAD, section("All training recipes", shared)]
    for recipe in (*RECIPES, *OTHERS):
        known = shared if issubclass(recipe, COMMON) else []
        parts.append(section(first_sentence(recipe), [row for row in rows(recipe) if row not in known]))
    return "\n".join(parts)


def section(title: str, found: list[tuple[str, str, str, str]]) -> str:
    """Return a heading and a table."""
    lines = [f"## {title}", "", "| option | default | may be | |", "|---|---|---|---|"]
    lines += [f"| `{name}=` | {default} | {allowed} | {meaning} |" for name, default, allowed, meaning in found]
    return "\n".join(lines) + "\n"


def rows(config: type, prefix: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Name, default, allowed values and meaning of every option of a dataclass and of those within it."""
    types, said = typing.get_type_hints(config), meanings(config)
    for field in dataclasses.fields(config):
        kind, name = types[field.name], f"{prefix}{field.name}"
        if name == "algorithm":  # is the recipe
            continue
        if dataclasses.is_dataclass(kind):
            if kind is schema.Ramp and field.name in said:
                clocks = "`by`: " + ", ".join(f"`{clock.value}`" for clock in RampClock)
                yield (
                    f"{name}.{', .'.join(parts.name for parts in dataclasses.fields(kind))}",
                    ", ".join(default_of(part) for part in dataclasses.fields(kind)),
                    clocks,
                    said[field.name],
                )
            elif kind is not schema.Ramp:
                yield from rows(typing.cast(type, kind), f"{name}.")
            continue
        yield name, default_of(field), allowed_of(field, kind), said.get(field.name, "")


def default_of(field: dataclasses.Field[Any]) -> str:
    """A field's default as one would write it."""
    made = field.default_factory
    value = made() if made is not dataclasses.MISSING else field.default
    if value == MISSING:
        return "chosen"
    if isinstance(value, enum.Enum):
        value = value.value
    if dataclasses.is_dataclass(value):
        return ""
    words = {None: "null", True: "true", False: "false"}
    if value is None or isinstance(value, bool):
        return f"`{words[value]}`"
    if isinstance(value, float):
        return f"`{value:g}`"
    return f"`{value}`" if value not in ("", [], {}) else ""


def allowed_of(field: dataclasses.Field[Any], kind: Any) -> str:
    """What a field may be, in words: its range, or the values of an enumeration."""
    if inspect.isclass(kind) and issubclass(kind, enum.Enum):
        return ", ".join(f"`{member.value}`" for member in kind)
    allowed = field.metadata.get(ALLOWED)
    return "" if allowed is None else str(allowed)


def meanings(config: type) -> dict[str, str]:
    """The meaning of each field, from the class that says it last."""
    found: dict[str, str] = {}
    for base in reversed(config.__mro__):
        if dataclasses.is_dataclass(base):
            found |= of_attributes(inspect.getdoc(base) or "") | of_comments(inspect.getsource(base))
    return {name: text.replace("|", "\\|").replace("``", "`") for name, text in found.items()}


def of_attributes(docstring: str) -> dict[str, str]:
    """Read the section `Attributes:` of a docstring."""
    _, _, section_ = docstring.partition("Attributes:\n")
    found: dict[str, str] = {}
    last = None
    for line in section_.splitlines():
        if match := re.match(r"    (\w+): (.*)", line):
            last = match[1]
            found[last] = match[2]
        elif last and line.startswith("        "):
            found[last] += " " + line.strip()
        elif not line.startswith(" "):
            break
    return found


def of_comments(source: str) -> dict[str, str]:
    """Read the comment behind or above each field of a dataclass."""
    found: dict[str, str] = {}
    above = ""
    for line in source.splitlines():
        if line.startswith("    # "):
            above += " " + line.strip()[2:]
            continue
        if match := re.match(r"    (\w+): [^#]*(?:#\s*(.*))?$", line):
            text = (match[2] or above).strip()
            if text:
                found[match[1]] = text
        above = ""
    return found


def first_sentence(config: type) -> str:
    """The first sentence of a dataclass's docstring."""
    return (inspect.getdoc(config) or "").partition(".\n")[0].partition(": ")[0].rstrip(".:")


if __name__ == "__main__":
    main()
