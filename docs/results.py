"""Write docs/results.md from results/: every figure and table with its command, commit, machine and wall clock.

    python docs/results.py            # write the page
    python docs/results.py --check    # exit with status 1 if it is not up to date

A folder of results is described by its `provenance.json`, an entry or a list of entries:

    {"title": "...", "text": "...", "command": "..." or [...], "commit": "...", "machine": "...", "wall_clock": "...",
     "files": {"curve.png": "caption"} or ["curve.png"], "fills": ["dreamer_v3/circle"]}

`title` and `files`, relative to the folder, are required. What is null or missing is read from the records of its JSON
files where they have it (`machine`, `commit`), and otherwise the page says that it was not recorded. `fills` names
cells of results/planned.json, the tables of what is to be run; a cell that nothing fills says so.
"""

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results.md"
PICTURES = (".png", ".gif", ".svg")
NOT_RECORDED, NOT_RUN = "not recorded", "not run"
HEAD = """# Results

Made by `python docs/results.py` from the `provenance.json` files in [results/](../results): change those, not this
page. Only what was run is here. [What we know](what_we_know.md) says what follows from it, and
[figures.md](figures.md) how to draw such figures from runs of your own.

A command runs at the commit beside it. Until 2c16a57 the recipe that is `recipes/latent_ppo.py` today was called
`recipes/dreamer_v3.py`, so commands of older results name that one. Where nothing is said, flights are deterministic:
by the policy's mean, without sampling.
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
    fills: list[str] = field(default_factory=list)

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
    entries = [entry for path in sorted(results.rglob("provenance.json")) for entry in read_entries(path)]
    planned = json.loads((results / "planned.json").read_text(encoding="utf-8"))
    known = [cell for table in planned for cell in cells_of(table)]
    for entry in entries:
        if unknown := set(entry.fills) - set(known):
            raise ValueError(f"{entry.folder / 'provenance.json'}: fills {sorted(unknown)}: not in planned.json.")
    tables = [table_text(table, entries) for table in planned]
    entries.sort(key=lambda entry: min(map(known.index, entry.fills), default=len(known)))  # as the tables link to them
    return "\n".join([HEAD, *tables, *(entry_text(entry, results) for entry in entries)])


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
        command = raw.get("command") or []
        yield Entry(
            folder=path.parent,
            title=raw["title"],
            files=files,
            text=raw.get("text") or "",
            command=[command] if isinstance(command, str) else command,
            commit=raw.get("commit") or recorded(path.parent, files, "commit"),
            machine=raw.get("machine") or recorded(path.parent, files, "machine"),
            wall_clock=raw.get("wall_clock"),
            fills=raw.get("fills") or [],
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
    lines = [f"## {table['title']}\n", f"{table['text']}\n", f"| | {' | '.join(table['columns'].values())} |"]
    lines.append("|---" * (len(table["columns"]) + 1) + "|")
    for row, title in table["rows"].items():
        filling = ([e for e in entries if f"{row}/{column}" in e.fills] for column in table["columns"])
        cells = ["<br>".join(f"[{e.title}](#{e.anchor})" for e in found) or NOT_RUN for found in filling]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def entry_text(entry: Entry, results: Path) -> str:
    """Draw an entry: heading, text, where it comes from, pictures, other files."""
    place = Path(os.path.relpath(entry.folder, results.parent))
    lines = [f"## {entry.title}\n"]
    if entry.text:
        lines.append(f"{entry.text}\n")
    if len(entry.command) > 1:
        lines.append("\n".join(["```bash", *entry.command, "```"]) + "\n")
    command = f"`{entry.command[0]}`" if len(entry.command) == 1 else "above" if entry.command else NOT_RECORDED
    facts = {"command": command, "commit": entry.commit, "machine": entry.machine, "wall clock": entry.wall_clock}
    lines += ["| | |", "|---|---|", *(f"| {name} | {value or NOT_RECORDED} |" for name, value in facts.items()), ""]
    for name, caption in entry.files.items():
        if name.endswith(PICTURES):
            lines += [f"![{caption or name}](../{(place / name).as_posix()})\n", *([f"{caption}\n"] if caption else [])]
    others = [name for name in entry.files if not name.endswith(PICTURES)]
    if others:
        linked = (
            f"[{n}](../{(place / n).as_posix()}){f' ({entry.files[n]})' if entry.files[n] else ''}" for n in others
        )
        lines.append(f"Numbers: {', '.join(linked)}.\n")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
