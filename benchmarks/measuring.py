"""Shared functions of benchmarks: arguments, timing, provenance, Markdown tables and flat JSON."""

import argparse
import json
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from dreamer_racing.machine import provenance

COMMIT = provenance()["commit"]
"""Commit at the start of the benchmark, which is the one measured; HEAD may change before results are written."""


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Make the argument parser of a benchmark, with the benchmark's docstring as help."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", help="file for the results")
    return parser


def report(records: Sequence[dict[str, Any]], columns: Sequence[str], path: str | None) -> None:
    """Print some columns of the records as a table, and write all columns to a file if a path is given."""
    print_table(records, columns)
    write_json(records, path)


def print_table(records: Sequence[dict[str, Any]], columns: Sequence[str]) -> None:
    """Print some columns of the records as a Markdown table."""
    print("| " + " | ".join(columns) + " |")
    print("|" + "---|" * len(columns))
    for record in records:
        print("| " + " | ".join(as_text(record.get(column, "")) for column in columns) + " |")


def as_text(value: Any) -> str:
    """Format a value for tables."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def write_json(records: Sequence[dict[str, Any]], path: str | None) -> None:
    """Write the records with their provenance, if a path is given."""
    if path:
        where = {**provenance(), "commit": COMMIT}
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps([{**record, **where} for record in records], indent=1) + "\n")


def fill_page(page: Path, begin: str, end: str, lines: Iterable[str]) -> None:
    """Replace the text between two marker lines of a page.

    Raises:
        SystemExit: the page lacks a marker.
    """
    head, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise SystemExit(f"{page} lacks the lines {begin} and {end}, which must surround the table.")
    page.write_text("\n".join((head + begin, *lines, end + tail)), encoding="utf-8")


def seconds(function: Callable[[], Any], device: str) -> float:
    """Return the duration of one call in s, including its asynchronous work on the device."""
    start = now(device)
    function()
    return now(device) - start


def now(device: torch.device | str) -> float:
    """Return the current time in s, after the device has finished all its work."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def matmul_speed(device: str, dtype: torch.dtype) -> float:
    """Return the FLOP/s of a large matrix product, as the machine's limit."""
    side = 8192 if device.startswith("cuda") else 2048
    left, right = (torch.randn(side, side, device=device, dtype=dtype) for _ in range(2))
    left @ right
    return 2 * side**3 / min(seconds(lambda: left @ right, device) for _ in range(5))
