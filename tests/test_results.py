"""The results page is what the generator makes of results/, and the generator invents nothing."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest

from tests.running_recipes import module_of

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def results() -> ModuleType:
    return module_of("docs", "results")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one planned table and one result, whose JSON file knows its machine and commit."""
    table = {"title": "Planned", "text": "What is to be run.", "rows": {"ppo": "PPO"}, "columns": {"a": "A", "b": "B"}}
    (tmp_path / "planned.json").write_text(json.dumps([table]))
    (tmp_path / "one" / "deep").mkdir(parents=True)
    records = [{"machine": "M", "commit": "c1", "s": 1.0}, {"machine": "M", "commit": "c2", "s": 2.0}]
    (tmp_path / "one" / "deep" / "numbers.json").write_text(json.dumps(records))
    (tmp_path / "one" / "deep" / "curve.png").touch()
    entry = {"title": "One: a result", "files": {"curve.png": "A curve", "numbers.json": ""}, "fills": ["ppo/b"]}
    (tmp_path / "one" / "deep" / "provenance.json").write_text(json.dumps(entry))
    return tmp_path


def change(folder: Path, **fields) -> None:
    path = folder / "one" / "deep" / "provenance.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_page_in_the_repository_is_up_to_date(results):
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert page == results.make_page(ROOT / "results"), "run python docs/results.py"


def test_every_result_is_on_the_page(results):
    """Whatever lies in results/ is named by a provenance.json."""
    listed = {
        entry.folder / name
        for path in (ROOT / "results").rglob("provenance.json")
        for entry in results.read_entries(path)
        for name in entry.files
    }
    own = {"provenance.json", "planned.json"}
    present = {path for path in (ROOT / "results").rglob("*") if path.is_file() and path.name not in own}
    missing = sorted(str(path.relative_to(ROOT)) for path in present - listed)
    assert missing == [], "name them in a provenance.json beside them; the head of docs/results.py says how"


def test_facts_come_from_the_entry_or_its_records_and_are_never_invented(results, folder):
    said = " ".join(results.make_page(folder).split())
    assert "Command: not recorded. Time: not recorded." in said and "Commit: not" not in said  # of its JSON file


FACTS = {"command": "python old.py", "machine": "N", "wall_clock": "3 minutes", "commit": "c3"}


@pytest.mark.parametrize(
    ("fields", "shown", "hidden"),
    [
        ({}, ["| PPO | not run | [One: a result](#one-a-result) |", "## One: a result"], []),
        ({}, ["![A curve](PLACE/curve.png)\n*A curve*\n", "[numbers.json](PLACE/numbers.json)."], []),
        ({"fills": {"ppo/b": "99 %"}}, ["| PPO | not run | [99 %](#one-a-result) |"], []),
        (
            FACTS | {"today": "python x.py"},
            ["```bash\npython x.py\n```\n\n[Commands, commits, machine](PLACE/provenance.json)."],
            ["not recorded", "old.py"],
        ),
        (
            {"today": ["python x.py", "python y.py  # likewise z.py"]},
            ["```bash\npython x.py\n# likewise z.py\npython y.py\n```"],
            [],
        ),
        (
            {"brief": True, "result": "a figure", "command": "python x.py"},
            ["| One: a result | a figure | [numbers.json](PLACE/numbers.json) |"],
            ["## One", "python x.py"],
        ),
    ],
    ids=["cell", "picture and numbers", "cell says what it shows", "command of today", "commands", "brief"],
)
def test_what_an_entry_says_is_on_the_page(results, folder, fields, shown, hidden):
    change(folder, **fields)
    page = results.make_page(folder).replace(f"../{folder.name}/one/deep", "PLACE")
    assert all(text in page for text in shown) and not any(text in page for text in hidden)


def test_a_planned_table_may_have_a_picture_below_it(results, folder):
    (table,) = json.loads((folder / "planned.json").read_text())
    table["picture"] = {"file": "docs/media/curves.png", "caption": "All curves."}
    (folder / "planned.json").write_text(json.dumps([table]))
    assert (
        "[One: a result](#one-a-result) |\n\n![All curves.](../docs/media/curves.png)\n*All curves.*\n"
        in results.make_page(folder)
    )


def test_a_planned_table_without_rows_is_its_text(results, folder):
    planned = json.loads((folder / "planned.json").read_text())
    (folder / "planned.json").write_text(json.dumps([*planned, {"title": "Each run", "text": "| a | b |\n|---|---|"}]))
    assert "\n## Each run\n\n| a | b |\n|---|---|\n" in results.make_page(folder)


def test_many_files_are_linked_by_their_folder(results, folder):
    names = [f"{name}.csv" for name in "abcd"]
    for name in names:
        (folder / "one" / "deep" / name).touch()
    change(folder, files=names)
    assert f"Numbers: [{folder.name}/one/deep](../{folder.name}/one/deep)." in " ".join(
        results.make_page(folder).split()
    )


def test_commands_are_not_broken_within_quotes(results):
    words = ["python x.py", "'a={b: 1, c: 2}'", '"d e"'] * 6
    lines = results.wrapped_command(" ".join(words)).splitlines()
    assert len(lines) > 1 and all(line.endswith(" \\") for line in lines[:-1])
    assert " ".join(line.removesuffix(" \\").strip() for line in lines) == " ".join(words)


def test_long_lines_are_broken_and_tables_are_not(results, folder):
    row = "|" + " a |" * 100
    change(folder, text=f"{'word ' * 100}\n\n{row}", today=f"python x.py {'option=value ' * 30}")
    lines = results.make_page(folder).splitlines()
    assert row in lines and max(len(line) for line in lines if line != row and "](" not in line) <= results.WIDTH
    assert any(line.startswith("    option=value") for line in lines)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"title": ""}, "an entry has no title. For the format see the head of docs/results.py"),
        ({"files": {}}, "an entry has no files"),
        ({"files": ["lost.png"]}, "files names lost.png, which does not exist"),
        ({"fills": ["ppo/c"]}, r"fills \['ppo/c'\]: not in planned.json"),
    ],
)
def test_bad_entries_are_refused_with_their_file(results, folder, fields, words):
    change(folder, **fields)
    with pytest.raises(ValueError, match=rf"one/deep/provenance\.json: {words}"):
        results.make_page(folder)
