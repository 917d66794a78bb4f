"""What every benchmark does: say where it was measured, print a table, write flat JSON."""

import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp")


def provenance() -> dict[str, Any]:
    """Machine, versions and commit, to be added to every record."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return {
        "machine": f"{platform.system()} {platform.machine()}, {_cpu()}, {torch.get_num_threads()} torch threads",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": commit.stdout.strip(),
    }


def _cpu() -> str:
    from dreamer_racing.envs.simulator.mujoco_cpu import available_cpus

    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return f"{available_cpus()} x {names[0].partition(': ')[2]}" if names else f"{available_cpus()} cores"


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
        where = provenance()
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps([{**record, **where} for record in records], indent=1) + "\n")
