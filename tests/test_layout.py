"""The house: who imports whom, what stands where, and on what it depends."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "dreamer_racing"


def name_of(path: Path) -> str:
    """The dotted name of a module's file."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imported(module: str) -> set[str]:
    """Modules of the package that a module imports anywhere, in functions and for type checkers too."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else str(node.module) for name in inner}
    return found & MODULES.keys()


def circles(graph: dict[str, set[str]]) -> Iterator[list[str]]:
    """Every way that leads back to where it began, found once each."""
    done: set[str] = set()

    def walk(name: str, way: list[str]) -> Iterator[list[str]]:
        if name in way:
            yield [*way[way.index(name) :], name]
        elif name not in done:
            for next_name in sorted(graph[name]):
                yield from walk(next_name, [*way, name])
            done.add(name)

    for name in graph:
        yield from walk(name, [])


def test_circles_are_found():
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}})) == [["b", "c", "b"]]
    assert list(circles({"a": {"a"}})) == [["a", "a"]]
    assert list(circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})) == []


def test_no_module_imports_one_that_imports_it():
    assert [" → ".join(way) for way in circles({name: imported(name) for name in MODULES})] == []


def wing(module: str) -> str:
    """The folder at the package's top, or the file, that a module stands in."""
    return ".".join(module.split(".")[:2])


def test_no_wing_imports_one_that_imports_it():
    wings: dict[str, set[str]] = {wing(name): set() for name in MODULES}
    for name in MODULES:
        wings[wing(name)] |= {wing(other) for other in imported(name)} - {wing(name)}
    assert {"dreamer_racing.envs", "dreamer_racing.training"} <= wings.keys()
    assert [" → ".join(way) for way in circles(wings)] == []


def functions(folder: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Every function of a folder's modules, with a name for messages."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                yield f"{path.relative_to(ROOT)}: {node.name}", node


def length(function: ast.FunctionDef) -> int:
    """Lines, without those of the docstring."""
    docstring = ast.get_docstring(function, clean=False)
    return function.end_lineno - function.lineno + 1 - (docstring.count("\n") + 1 if docstring else 0)


@pytest.mark.parametrize("folder", ["dreamer_racing", "recipes"])
def test_functions_are_short(folder):
    """But for kernels, which warp compiles whole, and what reads top to bottom: a recipe's loop, an update's maths."""
    whole = re.compile(r"make_kernels$|^recipes/\w+\.py: train$")
    lengths = {name: length(function) for name, function in functions(folder) if not whole.search(name)}
    algorithm = re.compile(r"learners/\w+\.py: (compute_losses|update_actor)$")
    limits = {name: 80 if algorithm.search(name) else 60 for name in lengths}
    assert {name: lines for name, lines in lengths.items() if lines > limits[name]} == {}
    assert sorted(lengths.values())[int(0.9 * len(lengths))] <= 24


def test_no_class_of_a_learner_or_loss_has_a_grandparent_of_ours():
    """Data goes through arguments and return values, not through hooks of a chain of classes."""
    bases: dict[str, list[str]] = {}
    for folder in ("losses", "learners", "modules", "experience", "training"):
        for path in sorted((PACKAGE / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    bases[node.name] = [base.id for base in node.bases if isinstance(base, ast.Name)]
    assert {"DreamerV3", "LatentPPO", "Image"} <= bases.keys()
    ours = {name: [base for base in of if base in bases] for name, of in bases.items()}
    assert [name for name, of in ours.items() if any(ours[base] for base in of)] == []


def test_few_plain_modules_stand_at_the_top():
    top = {path.name for path in PACKAGE.glob("*.py")} - {"__init__.py"}
    known = {
        "caches.py",
        "commands.py",
        "devices.py",
        "doctor.py",
        "machine.py",
        "parallel.py",
        "settings.py",
        "terminal.py",
    }
    assert top == {"__main__.py", *known}


def test_recipes_are_what_a_person_starts():
    for path in (ROOT / "recipes").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert '\nif __name__ == "__main__":\n    main()\n' in text and "@recipe(" in text, path


def is_setter(node: ast.AST) -> bool:
    return any(
        isinstance(mark, ast.Attribute) and mark.attr == "setter" for mark in getattr(node, "decorator_list", [])
    )


@pytest.mark.parametrize("folder", ["dreamer_racing", "recipes"])
def test_every_module_and_all_that_is_public_says_what_it_is(folder):
    """Public: without an underscore, in a module or in a public class; a setter says what its property does."""
    silent = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        homes = [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_")]
        public = [node for home in homes for node in home.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
        silent += [
            f"{path.relative_to(ROOT)}: {getattr(node, 'name', 'module')}"
            for node in (tree, *(node for node in public if node.name[0] != "_"))
            if not ast.get_docstring(node) and not is_setter(node)
        ]
    assert silent == []


# Every dependency has both bounds, of which .ci/lowest and .ci/run install the ends.


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TEXTS = [*PROJECT["dependencies"], *(text for extra in PROJECT["optional-dependencies"].values() for text in extra)]
REQUIREMENTS = [found for text in TEXTS if (found := Requirement(text)).name != PROJECT["name"]]


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_a_dependency_has_a_lower_and_an_upper_bound(requirement: Requirement) -> None:
    operators = sorted(bound.operator for bound in requirement.specifier)
    assert operators in (["<", ">="], ["=="]), f"{requirement}: write >=LOWEST,<NEXT, or =="


def test_the_page_on_installing_names_every_extra() -> None:
    page = (ROOT / "docs" / "installation.md").read_text(encoding="utf-8")
    named = page.partition("Extras:")[2].partition("\n\n")[0]
    assert {extra for extra in PROJECT["optional-dependencies"] if f"`{extra}`" not in named} == {"dev"}


def test_a_dependency_of_several_extras_has_the_same_bounds_in_all() -> None:
    bounds = {requirement.name: requirement.specifier for requirement in REQUIREMENTS}
    assert {str(found) for found in REQUIREMENTS if found.specifier != bounds[found.name]} == set()
