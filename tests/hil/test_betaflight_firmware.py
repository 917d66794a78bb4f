"""What finds, sets up and questions a firmware, without one: `tests/plant/test_real_firmware.py` has a real one."""

from __future__ import annotations

import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from dreamer_racing.hil.betaflight import firmware as firmwares
from dreamer_racing.hil.betaflight.command_line import CommandLine
from dreamer_racing.hil.betaflight.firmware import Firmware, Ports, find_firmware, takes_file
from dreamer_racing.hil.betaflight.status import FlightControllerStatus, read_status


def program(folder: Path, text: str) -> Path:
    """A program that stands for a firmware."""
    path = folder / "betaflight_SITL.elf"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_firmware_is_found_by_name_then_by_the_variable_then_in_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(firmwares.VARIABLE, raising=False)
    monkeypatch.setattr(firmwares.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match=r"pip install .*\[sitl\]' compiles version 4.6"):
        find_firmware()
    named = program(tmp_path, "true")
    monkeypatch.setenv(firmwares.VARIABLE, str(named))
    assert find_firmware() == named
    with pytest.raises(FileNotFoundError, match="nowhere is not an executable Betaflight"):
        find_firmware(tmp_path / "nowhere")


def test_one_that_ends_at_once_is_said_with_its_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(firmwares, "_BOOTS_WITHIN", 0.5)
    dies = program(tmp_path, "echo no such address; exit 3")
    with pytest.raises(OSError, match="ended with status 3: …no such address"):
        Firmware(dies, ["set a = 1"], Ports.free(9))


def test_one_that_reads_a_file_is_given_one(tmp_path: Path) -> None:
    assert takes_file(program(tmp_path, "# --config FILE"))
    assert not takes_file(program(tmp_path, "# the address"))


def test_ports_are_free_ones() -> None:
    ports = Ports.free(9002)
    assert len({*ports}) == 4 and ports.motors == 9002
    assert Ports() == (9002, 9003, 9004, 5761)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def test_the_command_line_types_lines_and_names_those_that_are_not_taken(listener: socket.socket) -> None:
    """The dialogue of 4.6.0, byte by byte."""
    heard = []

    def answer() -> None:
        connection, _ = listener.accept()
        with connection:
            assert connection.recv(1) == b"#"
            connection.sendall(b"\r\nEntering CLI Mode, type 'exit' to reboot, or 'help'\r\n\r\n# ")
            for said in (
                b"set mid_rc = 1500\r\nmid_rc set to 1500\r\n",
                b"set x = 0\r\n###ERROR IN set: INVALID NAME: x = 0###\r\n",
            ):
                heard.append(connection.recv(100))
                connection.sendall(said + b"\r\n# ")

    thread = threading.Thread(target=answer)
    thread.start()
    line = CommandLine(listener.getsockname()[1], patience=5.0)
    refused = line.type_all(["# why", "set mid_rc = 1500", "", "set x = 0"])
    thread.join()
    line.close()
    assert heard == [b"set mid_rc = 1500\n", b"set x = 0\n"]
    assert refused == {"set x = 0": "ERROR IN set: INVALID NAME: x = 0"}


STATUS_4_6 = bytes.fromhex("0000 0000 2300 00000000 00 0000 0000 03 000000 1d 04000010 00 0000 04".replace(" ", ""))
"""Of 4.6.0 without a radio, told to arm: 29 flags, of which RXLOSS and the last."""


def test_a_status_is_read_and_said_in_words() -> None:
    status = read_status(STATUS_4_6)
    assert status == FlightControllerStatus(modes=0, flags=1 << 2 | 1 << 28, total=29)
    assert list(status.reasons) == ["RXLOSS", "ARM_SWITCH"]
    assert status.words.startswith("RXLOSS: it receives no valid channels; ARM_SWITCH: ")
    armed = read_status(STATUS_4_6[:6] + b"\1\0\0\0" + STATUS_4_6[10:16] + b"\2" + STATUS_4_6[17:])
    assert armed.armed and armed.modes == 1 | 1 << 33  # of which the further bytes tell
    assert FlightControllerStatus(0, 1 << 26, 29).reasons == {"flag 26": "see `status` in its CLI"}
    assert FlightControllerStatus(0, 0, 29).words == ""
    for size in range(len(STATUS_4_6) - 4):
        assert read_status(STATUS_4_6[:size]) is None
