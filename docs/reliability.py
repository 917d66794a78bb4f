"""Write what attacks measured into the last column of docs/reliability.md.

    python docs/reliability.py            # write the column
    python docs/reliability.py --check    # exit with status 1 if it is not up to date

The numbers are those of results/faults.json and results/fuzz.json, which faults.py and fuzz.py in tests/robustness
write, each with the commit that was attacked; what is in neither is not measured. Everything else of the page is
written by hand: a row that an attack is to fill is named in `ATTACKS` by its first cell.
"""

import argparse
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reliability.md"
HEADING = "last attack"
NOT_MEASURED, NO_ATTACK = "not measured", "–"
ATTACKS = {
    "the process is killed, at any time": (
        "kill", "kill early", "kill at open", "kill at rename", "kill at fsync",
    ),
    "Ctrl-C, SIGTERM": ("SIGTERM",),
    "power loss, or the machine is taken away": ("kill by the clock",),
    "a file of a checkpoint is damaged or missing": ("damage", "checkpoints"),
    "the disk fills up": ("full disk",),
    "a loss or gradient that is not finite": ("not finite",),
    "an action or a world that is not finite": ("actions",),
    "the system clock changes": ("clock",),
    "a wrong option": ("overrides",),
    "an untrusted track file": ("tracks",),
    "an untrusted export": ("contracts",),
    "an untrusted checkpoint": ("checkpoints",),
}  # fmt: skip
"""Kinds of attacks by the fault that a row is about."""
CALLS = re.compile(r"(?:call|after opening) \d+ of (\d+)")
"""Where a case was killed that is one of so many."""


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare")
    there = PAGE.read_text(encoding="utf-8")
    page = fill(there, read_results(ROOT / "results"))
    if parser.parse_args().check:
        if page != there:
            raise SystemExit("docs/reliability.md is not up to date: run python docs/reliability.py")
        return
    PAGE.write_text(page, encoding="utf-8")


def read_results(folder: Path) -> dict[str, str]:
    """Return a phrase on each kind of attack that was measured."""
    phrases: dict[str, str] = {}
    faults = _read(folder / "faults.json")
    for kind in dict.fromkeys(record["fault"] for record in faults):
        cases = [record for record in faults if record["fault"] == kind]
        survived = sum(record["survived"] for record in cases)
        there = max((int(calls[1]) for case in cases if (calls := CALLS.fullmatch(case.get("where", "")))), default=0)
        among = f", among {there}" if there > len(cases) else ""
        phrases[kind] = f"{kind}: {survived} of {len(cases)} survived{among}"
    for record in _read(folder / "fuzz.json"):
        phrases[record["kind"]] = f"{record['kind']}: {record['failed']} of {record['cases']:,} failed"
    return phrases


def fill(page: str, phrases: dict[str, str]) -> str:
    """Return a page with the last column of its table filled.

    Raises:
        ValueError: the table lacks a row of `ATTACKS`, or the column.
    """
    missing = set(ATTACKS)

    def cell(match: re.Match[str]) -> str:
        fault = match[1].strip()
        missing.discard(fault)
        kinds = ATTACKS.get(fault, ())
        found = [phrases.get(kind, f"{kind}: {NOT_MEASURED}") for kind in kinds]
        return f"{match[0].rpartition('|')[0].rpartition('|')[0]}| {'; '.join(found) or NO_ATTACK} |"

    head, heading, table = page.partition(f"| {HEADING} |\n")
    rows, blank, rest = table.partition("\n\n")
    separator, _, rows = rows.partition("\n")
    filled = re.sub(r"^\| ([^|]+)\|.*\|$", cell, rows, flags=re.MULTILINE)
    if missing or not heading:
        raise ValueError(f"{PAGE.name} lacks {', '.join(sorted(missing)) or f'the column {HEADING}'}.")
    return f"{head}{heading}{separator}\n{filled}{blank}{rest}"


def _read(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else []


if __name__ == "__main__":
    main()
