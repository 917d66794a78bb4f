"""Where numbers come from: machine, versions, commit and command, to be kept beside them."""

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp")


def provenance() -> dict[str, Any]:
    """Return machine, versions and commit, as JSON knows them."""
    return {
        "machine": f"{platform.system()} {platform.machine()}, {_cpu()}, {torch.get_num_threads()} torch threads",
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": git_commit(Path(__file__).parent),
    }


def git_commit(folder: Path) -> str | None:
    """Name the commit that a folder is at, ``-dirty`` if files have changed since; None outside a repository."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # no git here
        return None
    return answer.stdout.strip() or None


def command_line() -> str:
    """Return the command that started this process, to be run again in the same folder."""
    return shlex.join(["python", *sys.argv])


def _cpu() -> str:
    from dreamer_racing.envs.simulator.mujoco_cpu import available_cpus

    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line for line in lines if line.startswith("model name")]
    return f"{available_cpus()} x {names[0].partition(': ')[2]}" if names else f"{available_cpus()} cores"
