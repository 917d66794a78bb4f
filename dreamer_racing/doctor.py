"""Checks of a machine for training and flying, with remedies; does not import torch, which is slow."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import math
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from dreamer_racing.caches import ensure_caches, warp_cache, why_not_writable
from dreamer_racing.commands import install_extra
from dreamer_racing.envs.gl_variables import VARIABLES, unset_variables
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, loads
from dreamer_racing.machine import available_cpus, available_memory

DISTRIBUTION = "dreamer_racing"
RECORD_BYTES = 13_570
"""Size of one replay record of the default run: image, numbers and latents."""
NETWORKS_BYTES = 1.5e9
"""Memory of a default run beside its replay buffer: networks, optimiser, batch, libraries."""
SMALLER_ON_DISK = 7
"""Compression factor of a race's replay buffer in a checkpoint."""
PROBE = """
import sys, time
import numpy as np
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.vehicle import Pose
eyes = NoseCamera(load_track("kidney"), Camera(), sys.argv[1])
still = np.zeros(3)
pose = Pose(0.0, np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.0, 0.0, 0.0]), still, still)
end, frames = time.monotonic() + 1.0, 0
while time.monotonic() < end:
    frames += eyes.see(pose).any()
print(frames)
eyes.close()
"""
"""Program that counts the images that an OpenGL back end renders in 1 s; two back ends cannot share a process."""


PATIENCE = 15  # timeout of a probe, s
SHOWN = ("torch", "torchrl", "tensordict", "mujoco", "mujoco-warp", "warp-lang", "dm-control")
"""Packages whose versions are also reported if they are right."""


class Verdict(Enum):
    """Outcome of a check."""

    fine = "ok"
    note = "note"
    wrong = "WRONG"


class Diagnosis(NamedTuple):
    """Result of one check: its subject, its outcome, what was found, and the remedy."""

    what: str
    state: Verdict
    found: str
    remedy: str = ""


def _judge(what: str, fine: bool, found: str, remedy: str, otherwise: Verdict = Verdict.wrong) -> Diagnosis:
    return Diagnosis(what, Verdict.fine, found) if fine else Diagnosis(what, otherwise, found, remedy)


def examine(capacity: int, keep: int, run_dir: Path) -> Iterator[Diagnosis]:
    """Yield the results of all checks, for a replay of ``capacity`` records and ``keep`` checkpoints in ``run_dir``."""
    probes = {backend: _start_probe(backend) for backend in GL_LIBRARIES}
    yield python()
    yield from packages()
    yield from accelerator()
    yield from cores()
    yield memory(capacity * RECORD_BYTES + NETWORKS_BYTES)
    yield disk((keep + 1) * capacity * RECORD_BYTES / SMALLER_ON_DISK, run_dir)
    yield caches()
    yield from variables()
    yield from renderers(probes)


def python() -> Diagnosis:
    """Check the version of the Python interpreter."""
    wanted, found = importlib.metadata.metadata(DISTRIBUTION)["Requires-Python"], platform.python_version()
    return _judge("python", found in SpecifierSet(wanted), found, f"PYTHON=/path/to/python{wanted} ./dev ...")


def packages() -> Iterator[Diagnosis]:
    """Check every package that the project requires, and list the extras that are completely installed."""
    extras: dict[str, list[str]] = {}
    for text in requirements():
        requirement = Requirement(text)
        extra = re.search(r'extra == "(.+?)"', text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra[1] if extra else ""}):
            continue
        found = version_of(requirement.name)
        fits = found is not None and found in requirement.specifier
        if extra:
            extras.setdefault(extra[1], []).extend([] if fits else [str(requirement)])
        elif not fits or requirement.name in SHOWN:
            remedy = f"pip install '{requirement.name}{requirement.specifier}'"
            yield _judge(requirement.name, fits, found or "not installed", remedy)
    complete = sorted(extra for extra, missing in extras.items() if not missing)
    absent = sorted(extra for extra, missing in extras.items() if missing)
    remedy = f"for {', '.join(absent)}: {install_extra('NAME')}" if absent else ""
    yield Diagnosis("extras", Verdict.fine, ", ".join(complete) or "none", remedy)


def requirements() -> Iterator[str]:
    """Yield the project's requirements, and mujoco-warp's of Warp, since Warp's version must fit the GPU driver."""
    yield from importlib.metadata.requires(DISTRIBUTION) or ()
    with suppress(importlib.metadata.PackageNotFoundError):  # then mujoco-warp itself is reported as missing
        of_warp = importlib.metadata.requires("mujoco-warp") or ()
        yield from (text for text in of_warp if text.startswith("warp-lang") and ";" not in text)


def version_of(package: str) -> str | None:
    """Return the version of an installed package without its local part; None if it is not installed."""
    try:
        return importlib.metadata.version(package).partition("+")[0]
    except importlib.metadata.PackageNotFoundError:
        return None


def accelerator() -> Iterator[Diagnosis]:
    """Check for an NVIDIA GPU, its driver, and a torch build that can use it."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, check=True, timeout=5).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        yield Diagnosis("gpu", Verdict.fine, "no NVIDIA driver answers: trains on the CPU")
        return
    yield Diagnosis("gpu", Verdict.fine, "; ".join(answer))
    if cuda_of_torch() is None:
        remedy = "reinstall torch from https://download.pytorch.org/whl (TORCH_INDEX_URL of ./dev)"
        yield Diagnosis("cuda", Verdict.wrong, "this torch is a CPU build", remedy)


def cuda_of_torch() -> str | None:
    """Return the CUDA version that torch was built for, without importing it."""
    package = importlib.util.find_spec("torch")
    places = package.submodule_search_locations if package is not None else None
    version = Path(places[0]) / "version.py" if places else None
    text = version.read_text(encoding="utf-8") if version is not None and version.is_file() else ""
    found = re.search(r"^cuda.*= '(.+)'", text, re.MULTILINE)
    return found[1] if found else None


def cores() -> Iterator[Diagnosis]:
    """Check the CPU cores, their load, the number of threads of torch, and bfloat16 instructions."""
    available, load = available_cpus(), os.getloadavg()[0]
    remedy = "other processes slow a training down; two trainings need OMP_NUM_THREADS=1 each"
    yield _judge("cores", load <= 0.5 * available, f"{available}, load {load:.1f}", remedy, Verdict.note)
    threads = os.environ.get("OMP_NUM_THREADS")
    outside = (threads or "").partition(",")[0].strip()  # outer number of "4,2"
    too_many = outside.isdecimal() and int(outside) > available
    found = f"OMP_NUM_THREADS={threads}" if threads else "as many as cores"
    remedy = f"OMP_NUM_THREADS={available}: more threads than cores wait for each other"
    yield _judge("threads", not too_many, found, remedy)
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    bfloat16 = [name for name in ("amx_bf16", "avx512_bf16") if name in flags]
    found = f"{', '.join(bfloat16)}: a training measures whether this is faster" if bfloat16 else ""
    yield Diagnosis("bfloat16", Verdict.fine, found or "not supported by this CPU: mixed precision is off")


def memory(needed: float) -> Diagnosis:
    """Check that a run fits in memory; ``needed`` is in bytes."""
    free = available_memory("cpu")
    if free == math.inf:
        return Diagnosis("memory", Verdict.note, f"a default run takes {needed / 1e9:.1f} GB")
    found = f"{free / 1e9:.1f} GB free, such a run takes {needed / 1e9:.1f}"
    return _judge("memory", free >= needed, found, "lower replay.capacity=, or replay.storage=memmap")


def disk(needed: float, run_dir: Path) -> Diagnosis:
    """Check that checkpoints can be written and fit on the disk; ``needed`` is in bytes."""
    place = next(folder for folder in (run_dir.absolute(), *run_dir.absolute().parents) if folder.is_dir())
    if reason := why_not_writable(place):
        return Diagnosis("disk", Verdict.wrong, f"cannot write to {place} ({reason})", "choose another run_dir=")
    free = shutil.disk_usage(place).free
    found = f"{free / 1e9:.1f} GB free at {run_dir}, checkpoints of such a run take about {needed / 1e9:.1f}"
    return _judge("disk", free >= needed, found, "lower checkpoint.keep= or choose another run_dir=")


def caches() -> Diagnosis:
    """Check that compiled kernels can be cached for the next program."""
    if reason := ensure_caches():
        remedy = "WARP_CACHE_PATH=FOLDER, or a writable HOME; until then every program compiles again"
        return Diagnosis("caches", Verdict.note, reason, remedy)
    return Diagnosis("caches", Verdict.fine, str(warp_cache()))


def renderers(probes: dict[str, subprocess.Popen[str]]) -> Iterator[Diagnosis]:
    """Check which renderers work, and how fast they are."""
    found, reasons = {}, {}
    for backend, probe in probes.items():
        try:
            printed, errors = probe.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            probe.kill()
            printed, errors = probe.communicate()[0], f"TimeoutError: no image within {PATIENCE} s"
        if probe.returncode == 0:
            found[backend] = int(printed)
        else:
            reasons[backend] = (
                errors.strip().splitlines()[-1].partition(": ")[2] if errors.strip() else "its test process failed"
            )
    for backend, images in found.items():
        yield Diagnosis(backend, Verdict.fine, f"{images:,} images a second, 64 × 64 pixels, one core")
    for backend, reason in reasons.items():
        named = sorted(name for name in VARIABLES if f"{name}=" in reason)
        remedy = f"unset {' '.join(named)}" if named else ""
        yield Diagnosis(backend, Verdict.fine if found and not named else Verdict.note, f"fails: {reason}", remedy)
    if not found:
        installed = any(loads(library) for library in GL_LIBRARIES["egl"])
        remedy = "" if installed else "apt-get install libegl1 libopengl0 libgl1-mesa-dri: seven times as fast"
        yield Diagnosis("ray caster", Verdict.note, "is used, because OpenGL does not work", remedy)


def variables() -> Iterator[Diagnosis]:
    """Report environment variables that would break OpenGL and were therefore ignored."""
    for setting, reason in unset_variables.items():
        name = setting.partition("=")[0]
        yield Diagnosis(name, Verdict.note, f"{setting} is ignored: {reason}", f"unset {name}")


def _start_probe(backend: str) -> subprocess.Popen[str]:
    program = [sys.executable, "-c", PROBE, backend]
    return subprocess.Popen(program, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
