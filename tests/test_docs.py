"""Pages: made ones are up to date, and links between them lead somewhere."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from dreamer_racing import GYM_ENVIRONMENTS
from dreamer_racing.envs.simulator.rendering import HYBRID, RENDERERS
from dreamer_racing.losses import ACTOR_LOSSES, CRITIC_LOSSES, WORLD_MODEL_LOSSES

ROOT = Path(__file__).parents[1]
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *(ROOT / "docs").glob("*.md")]


@pytest.fixture(scope="module")
def options() -> ModuleType:
    """The generator of the page of options, a script beside it."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        return importlib.import_module("options")
    finally:
        sys.path.pop(0)


def anchors(page: Path) -> set[str]:
    """Of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    kept = (
        "".join(letter for letter in heading.lower() if letter.isalnum() or letter in " -_") for heading in headings
    )
    return {heading.replace(" ", "-") for heading in kept}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("http"):
            continue
        file, _, anchor = target.partition("#")
        found = (page.parent / file).resolve() if file else page
        assert found.exists(), target
        assert not anchor or found.suffix != ".md" or anchor in anchors(found), target


def test_the_page_of_options_is_up_to_date(options):
    assert options.PAGE.read_text(encoding="utf-8") == options.make_page(), "run python docs/options.py"


def test_comments_and_attributes_are_read(options):
    source = '    a: int = 1  # of a\n    # of b,\n    # and more\n    b: str = "x"\n    c: float = 2.0\n'
    assert options.of_comments(source) == {"a": "of a", "b": "of b, and more"}
    docstring = "Says.\n\nAttributes:\n    a: Of a,\n        and more.\n    b: Of b.\n\nReference: none."
    assert options.of_attributes(docstring) == {"a": "Of a, and more.", "b": "Of b."}


def test_names_that_are_chosen_from_are_all_on_their_pages(options):
    rows = dict(re.findall(r"^\| `([\w.]+)=` (.*)$", options.PAGE.read_text(encoding="utf-8"), re.M))
    for name in ("auto", *RENDERERS, HYBRID):
        assert re.search(rf"\b{name}\b", rows["env.renderer"]), name
    for registry, setting in ((WORLD_MODEL_LOSSES, "world_model"), (ACTOR_LOSSES, "actor"), (CRITIC_LOSSES, "critic")):
        for name in registry:
            assert f"`{name}`" in rows[f"loss.{setting}"], name
    for name in GYM_ENVIRONMENTS:
        assert re.search(rf"\b{name}\b", (ROOT / "README.md").read_text(encoding="utf-8")), name


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 180
