"""Write docs/results.md from results/: every figure and table with its command, commit, machine and wall clock.

    python docs/results.py            # write the page
    python docs/results.py --check    # exit with status 1 if it is not up to date

A folder of results is described by its `provenance.json`, an entry or a list of entries:

    {"title": "...", "text": "...", "command": "..." or [...], "commit": "...", "machine": "...", "wall_clock": "...",
     "files": {"curve.png": "caption"} or ["curve.png"], "fills": {"sac/circle": "99 %"} or ["sac/circle"]}

`title` and `files`, relative to the folder, are required. What is null or missing is read from the records of its JSON
files where they have it (`machine`, `commit`), and otherwise the page says that it was not recorded. `fills` names
cells of results/planned.json, the tables of what is to be run, and may say what a cell shows instead of the title; a
cell that nothing fills says so. With `"brief": true` an entry is an item of the list at the end, with no pictures.
"""

import argparse
import json
import os
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results.md"
PICTURES = (".png", ".gif", ".svg")
WIDTH = 128
BRIEF = "In brief"
NOT_RECORDED, NOT_RUN = "not recorded", "not run"
HEAD = """# Results

Made by `python docs/results.py` from the `provenance.json` files in [results/](../results): change those, not this
page. [What we know](what_we_know.md) says what follows, and [figures](figures.md) how to draw your own. More results,
of earlier defaults, are in the tree of commit 3c460b3.

A command runs at the commit below it. Until 2c16a57 `recipes/latent_ppo.py` was called `recipes/dreamer_v3.py`, so
commands of older results name that one. Flights of 100 randomised starts are by `python recipes/evaluate.py
checkpoint=runs/RUN episodes=100 num_envs=100 start_noise=1 seed=7`, deterministic unless sampling is said. Files of
metrics hold the rows with evaluations and every fourth to twentieth of the others.
"""


@dataclass
class Entry:
    """A result: an entry of a `provenance.json`."""

    folder: Path
    title: str
    files: dict[str, str]  # captions by name, relative to the folder
    text: str = ""
    command: list[str] = field(default_factory=list)
    commit: str | None = None
    machine: str | None = None
    wall_clock: str | None = None
    brief: bool = False  # an item of the last list
    fills: dict[str, str] = field(default_factory=dict)  # what cells of the planned tables show, by their names

    @property
    def anchor(self) -> str:
        """Of its heading, as GitHub makes them."""
        kept = (letter for letter in self.title.lower() if letter.isalnum() or letter in " -_")
        return "".join(kept).replace(" ", "-")


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare")
    arguments = parser.parse_args()
    try:
        text = make_page(ROOT / "results")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if not arguments.check:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        parser.error(f"{PAGE.relative_to(ROOT)} is not what results/ makes: run python docs/results.py.")


def make_page(results: Path) -> str:
    """Make the text of docs/results.md from a folder of results."""
    paths = sorted(results.rglob("provenance.json"), key=lambda path: (path.parent == results, path))
    entries = [entry for path in paths for entry in read_entries(path)]
    planned = json.loads((results / "planned.json").read_text(encoding="utf-8"))
    known = [cell for table in planned for cell in cells_of(table)]
    for entry in entries:
        if unknown := set(entry.fills) - set(known):
            raise ValueError(f"{entry.folder / 'provenance.json'}: fills {sorted(unknown)}: not in planned.json.")
    tables = [table_text(table, entries) for table in planned]
    entries.sort(key=lambda entry: min(map(known.index, entry.fills), default=len(known)))  # as the tables link to them
    long = [entry_text(entry, results) for entry in entries if not entry.brief]
    brief = [brief_text(entry, results) for entry in entries if entry.brief]
    return "\n".join([HEAD, *tables, *long, *([f"## {BRIEF}\n", *brief] if brief else []), ""]).rstrip("\n") + "\n"


def read_entries(path: Path) -> Iterator[Entry]:
    """Read a `provenance.json`.

    Raises:
        ValueError: it lacks something or names a file that is not there; the message says what.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: {error}.") from error
    for raw in content if isinstance(content, list) else [content]:
        for name in ("title", "files"):
            if not isinstance(raw, dict) or not raw.get(name):
                raise ValueError(f"{path}: an entry has no {name}. What one looks like: the head of docs/results.py.")
        files = raw["files"] if isinstance(raw["files"], dict) else dict.fromkeys(raw["files"], "")
        for name in files:
            if not (path.parent / name).is_file():
                raise ValueError(f"{path}: files names {name}, which is not there.")
        command, fills = raw.get("command") or [], raw.get("fills") or {}
        yield Entry(
            folder=path.parent,
            title=raw["title"],
            files=files,
            text=raw.get("text") or "",
            command=[command] if isinstance(command, str) else command,
            commit=raw.get("commit") or recorded(path.parent, files, "commit"),
            machine=raw.get("machine") or recorded(path.parent, files, "machine"),
            wall_clock=raw.get("wall_clock"),
            brief=bool(raw.get("brief")),
            fills=fills if isinstance(fills, dict) else dict.fromkeys(fills, raw["title"]),
        )


def recorded(folder: Path, files: dict[str, str], name: str) -> str | None:
    """Find a fact in the records of the JSON files, where every benchmark leaves it."""
    found: dict[str, None] = {}
    for file in files:
        if file.endswith(".json"):
            content = json.loads((folder / file).read_text(encoding="utf-8"))
            records = content if isinstance(content, list) else [content.get("provenance") or content]
            found |= {str(record[name]): None for record in records if isinstance(record, dict) and record.get(name)}
    return "; ".join(found) or None


def cells_of(table: dict[str, Any]) -> list[str]:
    """Name the cells of a planned table: row/column."""
    return [f"{row}/{column}" for row in table["rows"] for column in table["columns"]]


def table_text(table: dict[str, Any], entries: list[Entry]) -> str:
    """Draw a planned table; its cells link to what fills them."""
    lines = [f"## {table['title']}\n", f"{wrapped(table['text'])}\n", f"| | {' | '.join(table['columns'].values())} |"]
    lines.append("|---" * (len(table["columns"]) + 1) + "|")
    for row, title in table["rows"].items():
        names = [f"{row}/{column}" for column in table["columns"]]
        links = ([f"[{e.fills[name]}](#{e.anchor})" for e in entries if name in e.fills] for name in names)
        cells = ["<br>".join(found) or NOT_RUN for found in links]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def entry_text(entry: Entry, results: Path) -> str:
    """Draw an entry: heading, text, commands, where it comes from, pictures, other files."""
    place = Path(os.path.relpath(entry.folder, results.parent))
    lines = [f"## {entry.title}\n"]
    if entry.text:
        lines.append(f"{wrapped(entry.text)}\n")
    if entry.command:
        lines.append("\n".join(["```bash", *map(wrapped_command, entry.command), "```"]) + "\n")
    lines.append("\n".join(filter(None, (wrapped(provenance(entry)), links(entry, results)))) + "\n")
    pictures = [name for name in entry.files if name.endswith(PICTURES)]
    shown = [f"![{entry.files[name] or name}](../{(place / name).as_posix()})" for name in pictures]
    return "\n".join([*lines, *shown, *([""] if shown else [])])


def brief_text(entry: Entry, results: Path) -> str:
    """Draw an entry as an item of a list."""
    parts = (command.partition("  # ") for command in entry.command)
    commands = "; ".join(f"`{command}`" + (f" ({remark})" if remark else "") for command, _, remark in parts)
    said = " ".join(filter(None, (f"**{entry.title}**.", entry.text, f"{commands}." if commands else "")))
    text = wrapped(f"- {said} {provenance(entry)}")
    return "\n".join([text.replace("\n", "\n  "), *([f"  {numbers}"] if (numbers := links(entry, results)) else [])])


def provenance(entry: Entry) -> str:
    """Say where an entry comes from; an item of the list leaves out the time that was not recorded."""
    facts: dict[str, str | None] = {} if entry.command else {"Command": None}
    facts |= {"Commit": entry.commit, "Machine": entry.machine, "Time": entry.wall_clock}
    if entry.brief and not entry.wall_clock:
        del facts["Time"]
    return " ".join(f"{name}: {value or NOT_RECORDED}." for name, value in facts.items())


def links(entry: Entry, results: Path) -> str:
    """Link to the files that are no pictures, in one line; nothing if there are none."""
    place = Path(os.path.relpath(entry.folder, results.parent))
    others = [name for name in entry.files if not name.endswith(PICTURES)]
    linked = (f"[{n}](../{(place / n).as_posix()}){f' ({entry.files[n]})' if entry.files[n] else ''}" for n in others)
    return f"Numbers: {', '.join(linked)}." if others else ""


def wrapped(text: str) -> str:
    """Break paragraphs into lines; tables stay as they are."""
    wrapper = textwrap.TextWrapper(WIDTH, break_long_words=False, break_on_hyphens=False)
    paragraphs = text.split("\n\n")
    return "\n\n".join(part if part.startswith("|") else wrapper.fill(part) for part in paragraphs)


def wrapped_command(command: str) -> str:
    """Break a command into lines, never within quotes, and put the remark behind it above it."""
    command, _, remark = command.partition("  # ")
    lines = [f"# {line}" for line in wrapped(remark).splitlines()]
    line = ""
    for word in re.findall(r"""(?:[^\s"']|"[^"]*"|'[^']*')+""", command):
        if line and len(line) + len(word) > WIDTH - 2:
            lines.append(f"{line} \\")
            line = "   "
        line = f"{line} {word}" if line else word
    return "\n".join([*lines, line])


if __name__ == "__main__":
    main()
