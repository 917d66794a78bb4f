"""`recipes/plant.py` as a user starts it: a process to fly over loopback, and plain refusals."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links.udp import UdpLink
from dreamer_racing.hil.pose import UdpPose
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest
from tests.plant.test_betaflight_sitl import Firmware
from tests.running_recipes import ROOT, recipe


@contextmanager
def plant(*overrides: str) -> Iterator[tuple[int, Callable[[int], str]]]:
    """Start the process; give its port and what ends it and returns what it said."""
    command = [sys.executable, str(ROOT / "recipes" / "plant.py"), *overrides]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    listens = re.search(r"listens on 127\.0\.0\.1:(\d+)", first)

    def stop(number: int) -> str:
        process.send_signal(number)
        said, _ = process.communicate(timeout=20)
        assert process.returncode == 0, said
        return said

    try:
        assert listens, first + process.stdout.read()
        yield int(listens[1]), stop
    finally:
        process.kill()
        process.communicate()


def test_a_commander_flies_it_over_loopback_until_sigterm() -> None:
    poses = UdpPose(0)
    drone = ("track=figure8", "mass=1.1", "thrust=0.9", "packet_loss=0.05", "failsafe=2")
    with plant(*drone, "command_port=0", f"pose_port={poses.address[1]}") as (port, stop):
        link, received = UdpLink("127.0.0.1", port), []
        hover = Command(True, Setpoint(GRAVITY * 1.1 / 0.9, np.zeros(3)))
        for count in range(60):
            link.send(at_rest() if count < 10 else hover)
            received += poses.poll()
            time.sleep(0.02)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(b"no command", ("127.0.0.1", port))
        time.sleep(0.2)
        said = stop(signal.SIGTERM)
        link.close()
    poses.close()
    packets = [one.packet for one in received]
    assert poses.rejected == 0 and len(packets) > 100
    assert packets[-1].position == pytest.approx(packets[0].position, abs=0.03)
    took, stamped = received[-1].time - received[0].time, packets[-1].stamp - packets[0].stamp
    assert stamped == pytest.approx(took, rel=0.1)  # it keeps to the clock
    assert "the stand let go" in said
    assert "0 gates in order, 0 laps, crash: none, 60 commands (0 lost, 0 stale, 1 malformed), 0 failsafe(s)" in said


def test_a_stand_in_for_the_firmware_flies_it_over_loopback_until_sigint() -> None:
    firmware, state = Firmware("2026.6"), bind("127.0.0.1", 0)
    state.settimeout(0.2)
    over = threading.Event()
    options = (
        "betaflight=2026.6", "motor_port=0", f"state_port={state.getsockname()[1]}", "pose_port=9", "track=circle"
    )  # fmt: skip
    with plant(*options) as (port, stop), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:

        def serve() -> None:
            while not over.is_set():
                try:
                    out.sendto(firmware.answer(state.recv(1024)), ("127.0.0.1", port))
                except TimeoutError:
                    continue

        thread = threading.Thread(target=serve)
        thread.start()
        time.sleep(0.2)
        firmware.armed = True
        time.sleep(0.2)
        firmware.throttle = 0.62
        time.sleep(0.8)
        said = stop(signal.SIGINT)
        over.set()
        thread.join(5.0)
    state.close()
    assert "the stand let go" in said and "crash: none" in said, said
    assert int(re.search(r"(\d+) motor packets \(0 malformed\), 0 failsafe", said)[1]) > 300, said


def test_a_port_in_use_is_one_paragraph(tmp_path: Path) -> None:
    with bind("127.0.0.1", 0) as busy:
        done = recipe("plant", f"command_port={busy.getsockname()[1]}", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert re.fullmatch(r"error: cannot listen on 127\.0\.0\.1:\d+: .*\n", done.stderr)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["track=nowhere"], "unknown track 'nowhere'"),
        (["mass=9"], "mass=9.0: must be at least 0.5 and at most 2"),
        (["betaflight=2026.6", "delay=0.01"], "delay=0.01 is of commands"),
    ],
)
def test_refusals_say_what_is_wrong(overrides: list[str], message: str, tmp_path: Path) -> None:
    done = recipe("plant", *overrides, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and message in done.stderr
    assert done.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []
