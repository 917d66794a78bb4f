"""The options of recipes, read from the source of their dataclasses: for `--help`, docs/options.md and typing errors.

Nothing is imported that loads torch or hydra, so that an answer is there at once. A field's meaning is the comment
behind or above it, or its line under `Attributes:` in the docstring of its class.
"""

from __future__ import annotations

import ast
import difflib
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

import dreamer_racing
from dreamer_racing import settings

FOLDER = Path(__file__).parents[1]
CONFIG_DIR = FOLDER / "config"
PACKAGE = Path(dreamer_racing.__file__).parent
CHOSEN = object()
"""A default that a recipe chooses."""
FLAGS = {"--json": "json=true"}
"""Settings that are customary as flags, for recipes that have them."""
HYDRAS_FLAGS = (
    "--cfg", "--config-dir", "--config-name", "--config-path", "--experimental-rerun", "--help", "--hydra-help",
    "--info", "--multirun", "--package", "--resolve", "--run", "--shell-completion", "--version",
)  # fmt: skip
"""Flags that are hydra's own; it takes the beginnings of their names, too."""

TRAINING = ("dreamer_v3", "latent_ppo", "ppo", "sac")
"""The training recipes."""


class Option(NamedTuple):
    """One option, or the parts of a schedule."""

    names: tuple[str, ...]
    default: str
    allowed: str
    meaning: str
    free: bool  # whether entries of any name may be below it

    @property
    def name(self) -> str:
        """The name, and what else is set below the same."""
        first, *others = self.names
        return ", ".join([first, *(f".{other.rpartition('.')[2]}" for other in others)])


class Module:
    """The source of a module: its classes, its constants, and where other names come from."""

    def __init__(self, path: Path) -> None:
        text = path.read_text(encoding="utf-8")
        self.lines = text.splitlines()
        self.classes: dict[str, ast.ClassDef] = {}
        self.constants: dict[str, ast.expr] = {}
        self.imports: dict[str, tuple[str, str]] = {}
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef):
                self.classes[node.name] = node
            elif isinstance(node, ast.Assign):
                self.constants |= _assigned(node.targets[0], node.value)
            elif isinstance(node, ast.ImportFrom) and node.module:
                self.imports |= {name.asname or name.name: (node.module, name.name) for name in node.names}


def _assigned(target: ast.expr, value: ast.expr) -> dict[str, ast.expr]:
    """Return the names that an assignment gives values, and these."""
    if isinstance(target, ast.Name):
        return {target.id: value}
    if not (isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)):
        return {}
    pairs = zip(target.elts, value.elts, strict=True)
    return {name: part for one, other in pairs for name, part in _assigned(one, other).items()}


@cache
def load(name: str) -> Module | None:
    """Return the module of a dotted name, if its source is here."""
    first, _, rest = name.partition(".")
    place = (PACKAGE if first == "dreamer_racing" else FOLDER / first).joinpath(*filter(None, rest.split(".")))
    path = next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)
    return None if path is None else Module(path)


def find_class(module: Module, name: str) -> tuple[ast.ClassDef, Module] | None:
    """Return a class by the name that it has in a module, and the module where it stands."""
    if name in module.classes:
        return module.classes[name], module
    source = load(module.imports[name][0]) if name in module.imports else None
    return None if source is None else find_class(source, module.imports[name][1])


def evaluate(node: ast.expr, module: Module) -> Any:
    """Return what a default or a range is; `CHOSEN` for what is missing."""
    if isinstance(node, ast.Name):
        if node.id == "MISSING":
            return CHOSEN
        if node.id in module.constants:
            return evaluate(module.constants[node.id], module)
        source, name = module.imports[node.id]
        if source == settings.__name__:
            return getattr(settings, name)
        found = load(source)
        assert found is not None, node.id
        return evaluate(ast.Name(name), found)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Range":
        return settings.Range(*(evaluate(part, module) for part in node.args))
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):  # of an enumeration
        declared = find_class(module, node.value.id)
        return members(declared[0])[node.attr] if declared else None
    if isinstance(node, ast.Lambda):
        return evaluate(node.body, module)
    return ast.literal_eval(node)


def members(enumeration: ast.ClassDef) -> dict[str, Any]:
    """Return names and values of an enumeration."""
    assigned = [node for node in enumeration.body if isinstance(node, ast.Assign)]
    return {
        node.targets[0].id: ast.literal_eval(node.value) for node in assigned if isinstance(node.targets[0], ast.Name)
    }


@cache
def schema_of(recipe: str) -> tuple[ast.ClassDef, Module]:
    """Return the dataclass of a recipe's options, whose docstring begins with its file's name, and its module."""
    module = load(recipe)
    if module is not None:
        for name in (*module.classes, *(name for name in module.imports if name.endswith("Config"))):
            found = find_class(module, name)
            if found and (ast.get_docstring(found[0]) or "").startswith(f"`recipes/{recipe}.py`"):
                return found
    raise LookupError(f"recipes/{recipe}.py has no dataclass whose docstring begins with its name.")


@cache
def options(recipe: str) -> list[Option]:
    """Return all options of a recipe."""
    return list(_options(*schema_of(recipe)))


def common_options() -> list[Option]:
    """Return the options that all training recipes share."""
    schema = load("composing.schema")
    assert schema is not None
    return list(_options(schema.classes["RunConfig"], schema))


def _options(config: ast.ClassDef, module: Module, prefix: str = "") -> Iterator[Option]:
    """Yield the options of a dataclass and of those within it."""
    meanings = {
        name: text for node, home in lineage(config, module) for name, text in read_meanings(node, home).items()
    }
    for name, (field, home) in fields(config, module).items():
        if name == "algorithm" and not prefix and config.name != "ExperimentConfig":  # is the recipe
            continue
        kind = find_class(home, field.annotation.id) if isinstance(field.annotation, ast.Name) else None
        if kind and is_dataclass(kind[0]):
            inner = list(_options(*kind, f"{prefix}{name}."))
            if kind[0].name != "Ramp":
                yield from inner
                continue
            defaults, allowed = ", ".join(one.default for one in inner), f"`by`: {inner[-1].allowed}"
            yield Option(tuple(one.names[0] for one in inner), defaults, allowed, meanings.get(name, ""), free=False)
            continue
        default, allowed = default_of(field, home)
        if kind:  # an enumeration
            allowed = ", ".join(f"`{value}`" for value in members(kind[0]).values())
        # Any: also of a dataclass that is made of the fields of another
        free = ast.unparse(field.annotation).startswith(("dict", "Any"))
        yield Option((f"{prefix}{name}",), default, allowed, meanings.get(name, ""), free)


def is_dataclass(node: ast.ClassDef) -> bool:
    """Return whether a class is declared as a dataclass."""
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def lineage(config: ast.ClassDef, module: Module) -> list[tuple[ast.ClassDef, Module]]:
    """Return a class behind its bases, in the order in which dataclasses take their fields."""
    bases = [find_class(module, base.id) for base in reversed(config.bases) if isinstance(base, ast.Name)]
    return [pair for base in bases if base for pair in lineage(*base)] + [(config, module)]


def fields(config: ast.ClassDef, module: Module) -> dict[str, tuple[ast.AnnAssign, Module]]:
    """Return the fields of a dataclass by name, with the module where each is declared."""
    found: dict[str, tuple[ast.AnnAssign, Module]] = {}
    for node, home in lineage(config, module):
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                found[field.target.id] = field, home
    return found


def default_of(field: ast.AnnAssign, module: Module) -> tuple[str, str]:
    """Return a field's default as one would write it, and what it may be, in words."""
    value, allowed = field.value, ""
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        made_by = value.func.id
        if made_by == "setting":
            allowed = str(evaluate(value.args[1], module))
            value = value.args[0]
        elif made_by == "field":  # of an empty list or dictionary, or one that a lambda makes
            factory = value.keywords[0].value
            value = factory if isinstance(factory, ast.Lambda) else ast.Constant("")
    default = None if value is None else evaluate(value, module)
    if default is CHOSEN or value is None:
        return "chosen", allowed
    words = {None: "null", True: "true", False: "false"}
    if default is None or isinstance(default, bool):
        return f"`{words[default]}`", allowed
    text = f"{default:g}" if isinstance(default, float) else str(default)
    return (f"`{text}`" if text else ""), allowed


def read_meanings(config: ast.ClassDef, module: Module) -> dict[str, str]:
    """Return what a class says of its fields, in its docstring or in comments."""
    found = dict(_attributes(ast.get_docstring(config) or ""))
    above = ""
    for line in module.lines[config.lineno : config.end_lineno]:
        if line.startswith("    # "):
            above += " " + line.strip()[2:]
            continue
        if match := re.match(r"    (\w+): [^#]*(?:#\s*(.*))?$", line):
            found |= {match[1]: text} if (text := (match[2] or above).strip()) else {}
        above = ""
    return {name: text.replace("``", "`") for name, text in found.items()}


def _attributes(docstring: str) -> Iterator[tuple[str, str]]:
    """Yield the entries of the section `Attributes:`."""
    section = docstring.partition("Attributes:\n")[2].partition("\n\n")[0]
    for entry in re.split(r"\n(?=    \w)", f"\n{section}")[1:]:
        name, _, text = entry.strip().partition(": ")
        yield name, " ".join(text.split())


def groups(recipe: str) -> dict[str, list[str]]:
    """Return the configuration groups that a recipe composes, and what there is to choose in each."""
    path = CONFIG_DIR / f"{recipe}.yaml"
    defaults = yaml.safe_load(path.read_text(encoding="utf-8")).get("defaults", []) if path.is_file() else []
    named = [name for entry in defaults if isinstance(entry, dict) for name in entry if "/" not in name]
    named += ["decoys"] if any(option.name == "decoys" for option in options(recipe)) else []
    choices = {name: sorted(path.stem for path in (CONFIG_DIR / name).glob("*.yaml")) for name in named}
    return {name: found for name, found in choices.items() if found}


def names(recipe: str) -> list[str]:
    """Return the dotted names of all settings of a recipe, and of the groups they are in."""
    found: dict[str, None] = {}
    for option in options(recipe):
        for name in option.names:
            parts = name.split(".")
            found |= dict.fromkeys(".".join(parts[:length]) for length in range(1, len(parts) + 1))
    return list(found)


RENAMED = {
    "loss.ppo.flown": "it is called loss.ppo.steps now",
    "loss.ppo.updates": "actors no longer learn by PPO from what they imagine",
    "loss.kl_mode": "free nats apply to the sum over latents, as in the reference",
}
"""What became of settings that were there before."""


def no_such_setting(name: str, recipe: str) -> str:
    """Say that there is no setting of a name, and which may be meant."""
    if name in RENAMED:
        return f"{name}: {RENAMED[name]}. docs/options.md has all settings."
    known = names(recipe)
    if name in known:  # a group that nothing is taken from where nobody says so
        return f"{name}: is added, with a plus: +{name}=..."
    last = {full.rpartition(".")[2]: full for full in known}
    if takers := [f"recipes/{other}.py" for other in TRAINING if recipe in TRAINING and name in names(other)]:
        return f"{name}: there is no such setting of recipes/{recipe}.py; it is for {' and '.join(takers)}."
    close = difflib.get_close_matches(name, known, n=1) or [
        last[word] for word in difflib.get_close_matches(name.rpartition(".")[2], last, n=1)
    ]
    meant = f" (did you mean {close[0]}?)" if close else ""
    return f"{name}: there is no such setting of recipes/{recipe}.py{meant}. docs/options.md has them all."


def no_such_choice(group: str, choice: str, choices: Sequence[str]) -> str:
    """Say that there is no file of a name in a group."""
    return f"{group}={choice}: there are {', '.join(choices)}{settings.suggestion(choice, choices)}."


def refuse_slips(recipe: str, arguments: Sequence[str]) -> None:
    """Refuse what is no setting and no choice of a group, and a setting that is written as a flag.

    Raises:
        ValueError: the message says what may be meant, or how it is written.
    """
    for argument in arguments:
        flag, _, value = argument.partition("=")
        if flag.startswith("--") and flag not in FLAGS and not any(known.startswith(flag) for known in HYDRAS_FLAGS):
            written = f"{flag[2:].replace('-', '_')}={value or 'VALUE'}"
            raise ValueError(f"{argument}: settings are written without dashes, {written}.")
    if any(argument.startswith(("--config", "-c")) for argument in arguments):
        return  # with configurations of one's own there may be other groups
    found, known = groups(recipe), set(names(recipe))
    free = tuple(f"{option.name}." for option in options(recipe) if option.free)
    for argument in arguments:
        name, equals, value = argument.partition("=")
        name = name.lstrip("+~")
        if not equals or not re.fullmatch(r"[\w.]+", name):
            continue  # hydra's own flags and groups, or nothing that it reads
        if not (name in known or name.startswith(("hydra.", *free)) or (CONFIG_DIR / name).is_dir()):
            raise ValueError(no_such_setting(name, recipe))
        if name in found and value.replace(" ", "").startswith("[["):  # hydra fails on it
            quoted = settings.shortened(value)
            raise ValueError(f"{name}={quoted}: a group takes the name of one of its configurations.")
        if name in found and re.fullmatch(r"\w+", value) and value not in (*found[name], "null"):
            raise ValueError(no_such_choice(name, value, found[name]))
