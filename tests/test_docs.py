"""Pages: made ones are up to date, and links between them lead somewhere."""

from __future__ import annotations

import doctest
import importlib
import inspect
import json
import pkgutil
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import dreamer_racing
from dreamer_racing import GYM_ENVIRONMENTS
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.simulator.rendering import RENDERERS, WARP_CUDA
from dreamer_racing.envs.worlds import RaceOptions
from dreamer_racing.learners.latent_ppo import CRITICS
from dreamer_racing.losses import TARGETS
from tests.running_recipes import module_of

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "CODE_OF_CONDUCT.md")),
    *(ROOT / "docs").rglob("*.md"),
]


@pytest.fixture(scope="module")
def options() -> ModuleType:
    """The generator of the page of options."""
    return module_of("docs", "options")


@pytest.fixture(scope="module")
def reliability() -> ModuleType:
    """What fills the last column of the page on faults."""
    return module_of("docs", "reliability")


@pytest.fixture(scope="module")
def site_links() -> ModuleType:
    """What mkdocs does with links."""
    return module_of("docs", "site_links")


class SiteLoader(yaml.SafeLoader):
    """Reads mkdocs.yml without what it makes of Python's objects."""


SiteLoader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


def strings(tree: object) -> list[str]:
    """The texts in lists and in values of mappings, at any depth."""
    if isinstance(tree, str):
        return [tree]
    inner = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else []
    return [text for part in inner for text in strings(part)]


def sentences(text: str) -> list[str]:
    """Of paragraphs and list items; code is a word, and code blocks, tables and headings are left out."""
    text = re.sub(r"```.*?```|^(?:#|\s*\||<!--).*?$", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^\s*(?:-|\d+\.) ", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"!?\[([^\[\]]*)\]\([^)]*\)", r"\1", re.sub(r"`[^`]*`", "CODE", text))
    return [
        found
        for part in re.split(r"\n\s*\n", text)
        for found in re.split(r"(?<=[.!?])[\"*)]*\s+(?=[A-Z0-9\"*(])", part)
    ]


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


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "options.md"], ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    found = sentences(page.read_text(encoding="utf-8"))
    assert [sentence for sentence in found if len(re.findall(r"\S*\w\S*", sentence)) > 40] == []


def commands(text: str) -> list[tuple[str, list[str]]]:
    """The recipes that a page starts, in blocks and within lines, and their settings."""
    code = re.findall(r"```\w*\n(.*?)```|`([^`\n]+)`", text.replace("\\\n", " "), flags=re.DOTALL)
    found = re.findall(r"(?<!tests/)recipes/([a-z_0-9]+)\.py(.*)", "\n".join(map("".join, code)))
    words = ((name, shlex.split(given, comments=True)) for name, given in found)
    return [(name, [word for word in given if re.match(r"[\w.+~-]+=|--", word)]) for name, given in words]


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name not in ("results.md", "CHANGELOG.md")],  # which are of older commits, too
    ids=lambda page: page.name,
)
def test_commands_name_settings_that_there_are(page: Path) -> None:
    known = module_of("recipes", "composing.options")
    for name, given in commands(page.read_text(encoding="utf-8")):
        assert (ROOT / "recipes" / f"{name}.py").is_file(), name
        known.check_arguments(name, given)


def test_commands_are_found_with_their_settings() -> None:
    text = "```bash\n./dev python recipes/fly.py agent=a \\\n  view=x  # b=1\n```\nOr `recipes/plot.py runs='r/*'` b=1."
    assert commands(text) == [("fly", ["agent=a", "view=x"]), ("plot", ["runs=r/*"])]


def test_sentences_are_told_apart() -> None:
    text = "# A head\n\nOne `a b. C`, [see this](x.md).\nTwo words? *Three*\n\n- an item\n- two\n\n| a |\n```\nx\n```"
    found = [" ".join(sentence.split()) for sentence in sentences(text)]
    assert [sentence for sentence in found if sentence] == [
        "One CODE, see this.",
        "Two words?",
        "*Three*",
        "an item",
        "two",
    ]


def test_what_is_made_of_the_options_is_up_to_date(options):
    for path, text in options.make_files().items():
        assert path.read_text(encoding="utf-8") == text, "run python docs/options.py"


def test_comments_and_attributes_are_read(options, tmp_path, monkeypatch):
    source = '''from dataclasses import dataclass


@dataclass
class Config:
    """Says.

    Attributes:
        c: Of c,
            and more.
        d: Of d.

    Reference: none.
    """

    a: int = 1  # of a
    # of b,
    # and more
    b: str = "x"
    c: float = 2.0
    d: bool = True
'''
    (tmp_path / "described.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    meanings = options.read_meanings(importlib.import_module("described").Config)
    assert meanings == {"a": "of a", "b": "of b, and more", "c": "Of c, and more.", "d": "Of d."}


def test_names_that_are_chosen_from_are_all_on_their_pages(options):
    rows = dict(re.findall(r"^\| `([\w.]+)=` (.*)$", options.PAGE.read_text(encoding="utf-8"), re.M))
    for name in ("auto", *RENDERERS, WARP_CUDA):
        assert re.search(rf"\b{name}\b", rows["env.renderer"]), name
    for name in (*TARGETS, *CRITICS):
        assert any(f"`{name}`" in rows[f"loss.{setting}"] for setting in ("world_model", "critic")), name
    assert "`reinforce`, `dynamics`" in options.PAGE.read_text(encoding="utf-8")  # of two recipes' `loss.actor`
    for name in GYM_ENVIRONMENTS:
        assert re.search(rf"\b{name}\b", (ROOT / "README.md").read_text(encoding="utf-8")), name


def test_the_page_of_the_environment_has_every_crash_and_every_argument():
    text = (ROOT / "docs" / "environment.md").read_text(encoding="utf-8")
    names = {cause.name.lower() for cause in CrashCause if cause}
    names |= inspect.signature(DroneRacingEnv.__init__).parameters.keys() | RaceOptions.__annotations__.keys()
    assert {name for name in names if f"`{name}`" not in text} == {"self", "worlds", "backend"}  # the last is for tests


def test_the_page_of_learning_names_columns_that_there_are():
    text = (ROOT / "docs" / "learning.md").read_text(encoding="utf-8")
    run = ROOT / "results" / "latent_ppo" / "metrics_kidney_seed1.csv"
    known = set(run.read_text(encoding="utf-8").partition("\n")[0].split(","))
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "dreamer_racing").rglob("*.py"))
    named = set(re.findall(r"`([a-z_]+/[a-z_]+)`", text))
    assert len(named) > 15
    assert not {name for name in named - known if name not in sources}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


def test_every_page_is_in_the_navigation_of_the_site(site_links):
    nav = strings(yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), SiteLoader)["nav"])
    assert sorted(nav) == sorted(site_links.place_of(page) for page in PAGES)


def test_the_api_names_every_loss():
    named = set(
        re.findall(r"^::: dreamer_racing\.losses\.(\w+)$", (ROOT / "docs/api/training.md").read_text("utf-8"), re.M)
    )
    there = {path.stem for path in (ROOT / "dreamer_racing" / "losses").glob("*.py")} - {"__init__"}
    assert there <= named, f"docs/api/training.md lacks {sorted(there - named)}"


def test_the_api_names_modules_that_are_there():
    for page in (ROOT / "docs" / "api").glob("*.md"):
        named = re.findall(r"^::: (.+)$", page.read_text(encoding="utf-8"), re.M)
        assert named
        for name in named:
            assert (ROOT / name.replace(".", "/")).with_suffix(".py").is_file(), name


@pytest.mark.parametrize(
    ("page", "text", "expected"),
    [
        ("docs/hil.md", "[a](export.md#b) [c](#d) [e](https://f)", "[a](export.md#b) [c](#d) [e](https://f)"),
        ("docs/hil.md", "![x\ny](../results/pilot.json)", "![x\ny](repository/results/pilot.json)"),
        ("docs/hil.md", "[a](../README.md) [b](../results) `[c](../LICENSE)`", "[a](index.md) b `[c](../LICENSE)`"),
        (
            "docs/hil.md",
            "```\n[c](../LICENSE)\n```\n[c](../LICENSE)",
            "```\n[c](../LICENSE)\n```\n[c](repository/LICENSE)",
        ),
        ("docs/api/race.md", "[a](../hil.md) [b](../../LICENSE)", "[a](../hil.md) [b](../repository/LICENSE)"),
        ("README.md", "[a](docs/hil.md#b) [c](LICENSE)", "[a](hil.md#b) [c](repository/LICENSE)"),
        ("CONTRIBUTING.md", "[a](docs/hil.md) [c](LICENSE)", "[a](../hil.md) [c](LICENSE)"),
    ],
)
def test_links_of_the_site(site_links, page, text, expected):
    assert site_links.for_site(text, ROOT / page) == expected


def test_pages_outside_docs_are_found_again(site_links):
    for page in PAGES:
        assert site_links.page_source(site_links.place_of(page)) == page
    assert ROOT / "results" / "pilot.json" in set(site_links.linked(ROOT / "docs" / "simulation.md"))


def test_what_attacks_measured_is_up_to_date(reliability: ModuleType) -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    assert page == reliability.fill(page, reliability.read_results(ROOT / "results")), "run python docs/reliability.py"


def test_every_attack_of_the_benchmarks_is_in_a_row_and_what_was_not_measured_says_so(
    reliability: ModuleType, tmp_path: Path
) -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    records = [{"fault": "damage", "survived": index != 1, "commit": "abc"} for index in range(3)]
    records += [
        {"fault": "kill at fsync", "where": f"call {call} of 9", "survived": True, "commit": "d"} for call in (2, 7)
    ]
    (tmp_path / "faults.json").write_text(json.dumps(records))
    filled = reliability.fill(page, reliability.read_results(tmp_path))
    assert "damage: 2 of 3 survived; checkpoints: not measured |" in filled
    assert "kill at rename: not measured; kill at fsync: 2 of 2 survived, among 9 |" in filled
    attacks = {kind for kinds in reliability.ATTACKS.values() for kind in kinds}
    faults, fuzz = (
        (ROOT / "tests" / "robustness" / f"{name}.py").read_text(encoding="utf-8") for name in ("faults", "fuzz")
    )
    named = set(re.findall(r'(?:_verdict|self\.kills)\(\s*f?"([^"]+)"', faults))
    named = named - {"kill at {function}"} | {f"kill at {name}" for name in ("open", "rename", "fsync")}
    kinds = set(re.findall(r'^    "(\w+)": \w+,$', fuzz, re.MULTILINE))
    assert len(named) > 8 and len(kinds) == 5 and attacks == named | kinds


def examples() -> Iterator[str]:
    """Modules with examples that run; comments and lines with ``+SKIP`` are only shown."""
    for found in pkgutil.walk_packages(dreamer_racing.__path__, "dreamer_racing."):
        place = Path(ROOT, *found.name.split("."))
        file = place / "__init__.py" if found.ispkg else place.with_suffix(".py")
        if re.search(r">>> (?!#)(?!.*\+SKIP)", file.read_text(encoding="utf-8")):
            yield found.name


@pytest.mark.parametrize("module", list(examples()))
def test_examples_do_what_they_say(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(module), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted and not found.failed, f"{found.failed} of {found.attempted} lines, see above"


def test_every_guarantee_has_tests_that_are_there(reliability: ModuleType) -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    first_table = page.partition("| fault | guarantee |")[2].partition("\n\n")[0]
    assert set(reliability.TESTS) == set(re.findall(r"^\| ([^|]+) \|", first_table, re.MULTILINE))
    page += "".join(f"`{name}`" for names in reliability.TESTS.values() for name in names)
    tests = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    named = set(re.findall(r"`(test_\w+)`", page))
    assert named and {name for name in named if f"def {name}(" not in tests} == set()
    assert {path for path in re.findall(r"`(tests/[\w/.]+)`", page) if not (ROOT / path).exists()} == set()
