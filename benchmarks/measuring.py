"""What every benchmark does: say where it was measured, print a table, write flat JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dreamer_racing.machine import provenance

COMMIT = provenance()["commit"]
"""When the benchmark began, which is what it measures: others may come before it writes."""


def print_table(records: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print some columns of the records as a Markdown table."""
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for record in records:
        print("| " + " | ".join(_text(record.get(column, "")) for column in columns) + " |")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def write_json(records: Sequence[dict[str, Any]], path: str | None) -> None:
    """Write the records with their provenance, if a path is given."""
    if path:
        where = {**provenance(), "commit": COMMIT}
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps([{**record, **where} for record in records], indent=1) + "\n")
