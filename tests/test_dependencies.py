"""Every dependency has both bounds, of which .ci/lowest and .ci/run install the ends."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
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
