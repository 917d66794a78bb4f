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
from dreamer_racing.hil.betaflight.firmware import Ports, find_firmware
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.udp import UdpLink
from dreamer_racing.hil.pose import UdpPose
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import Command, Setpoint, at_rest
from tests.plant.test_betaflight_sitl import Firmware
from tests.running_recipes import ROOT, recipe


@contextmanager
def plant(*overrides: str) -> Iterator[tuple[int, Callable[[int], str]]]:
    """Start the process; give its port and what ends it and returns what it said."""
    command = [sys.executable, str(ROOT / "recipes" / "plant.py"), *overrides]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    first, listens = "", None
    while listens is None and (line := process.stdout.readline()):
        first += line
        listens = re.search(r"listens on 127\.0\.0\.1:(\d+)", line)

    def stop(number: int) -> str:
        process.send_signal(number)
        said, _ = process.communicate(timeout=20)
        assert process.returncode == 0, said
        return first + said

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
    late = float(re.search(r"late \d+ times \(by (\d+) ms at most\)", said)[1]) / 1e3 if "late" in said else 0.0
    assert -0.1 * took < took - stamped < 0.1 * took + late, said  # it keeps to the clock, or says how far it is behind
    assert "the stand released it" in said
    assert "0 gates in order, 0 laps, crash: none, 60 commands (0 lost, 0 stale, 1 malformed), 0 failsafe(s)" in said


def test_a_stand_in_for_the_firmware_flies_it_over_loopback_until_sigint() -> None:
    firmware, state = Firmware("2026.6"), bind("127.0.0.1", 0)
    state.settimeout(0.2)
    over, answers = threading.Event(), 0
    options = (
        "betaflight=2026.6", "motor_port=0", f"state_port={state.getsockname()[1]}", "pose_port=9", "track=circle"
    )  # fmt: skip
    with plant(*options) as (port, stop), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:

        def serve() -> None:
            nonlocal answers
            while not over.is_set():
                try:
                    out.sendto(firmware.answer(state.recv(1024)), ("127.0.0.1", port))
                    answers += 1
                except TimeoutError:
                    continue

        def wait_for(number: int) -> None:
            deadline = time.monotonic() + 60.0
            while answers < number and time.monotonic() < deadline:
                time.sleep(0.01)

        thread = threading.Thread(target=serve)
        thread.start()
        wait_for(100)
        firmware.armed = True
        wait_for(200)
        firmware.throttle = 0.62
        wait_for(700)
        said = stop(signal.SIGINT)
        over.set()
        thread.join(5.0)
    state.close()
    assert "the stand released it" in said and "crash: none" in said, said
    assert int(re.search(r"(\d+) motor packets \(0 malformed\), 0 failsafe", said)[1]) > 300, said


@pytest.mark.slow
@pytest.mark.xdist_group("betaflight")
def test_one_command_starts_a_real_firmware_that_flies_it_and_stops_it() -> None:
    try:
        find_firmware()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    poses, ports = UdpPose(0), Ports.free(0)
    where = (f"state_port={ports.state}", f"channel_port={ports.channels}", f"serial_port={ports.serial}")
    with plant("firmware=auto", "track=circle", *where, "motor_port=0", f"pose_port={poses.address[1]}") as (_, stop):
        rates, thrust = RateMap(10.0, 10.0, 4.0), ThrustMap(0.6, 16.0, 15.0, 15.0)
        link = make_link(
            LinkConfig("betaflight_sitl", port=ports.channels, serial_port=ports.serial, rates=rates, thrust=thrust)
        )
        height, accepted, refused, deadline = 0.0, 0, 0, time.monotonic() + 120.0
        while height < 1.5 and time.monotonic() < deadline:
            link.listen()
            thrust_now = 0.0 if accepted < 100 else 1.2 * GRAVITY
            armed = Command(True, Setpoint(thrust_now, np.zeros(3)))
            sent = link.send(armed if accepted > 50 else at_rest())
            refused = refused + 1 if link.refusal else 0
            begins_anew = not sent or refused > (
                50 if accepted > 50 else 0
            )  # a busy machine's firmware may refuse once
            accepted = 0 if begins_anew else accepted + 1
            height = max([height, *(one.packet.position[2] for one in poses.poll())])
            time.sleep(0.02)
        refusal, said = link.refusal, stop(signal.SIGTERM)
        link.close()
    poses.close()
    assert height >= 1.5, (refusal, said)
    assert "set up in an empty folder" in said and "the stand released it" in said
    with socket.socket() as gone:
        assert gone.connect_ex(("127.0.0.1", ports.serial)) != 0, "it was stopped"


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
        (["betaflight=2026.6", "delay=0.01"], "delay=0.01 is for commands"),
        (["actor=circle"], "actor=circle is for firmware="),
        (["firmware=/nowhere", "motor_port=0"], "/nowhere is not an executable Betaflight"),
    ],
)
def test_refusals_say_what_is_wrong(overrides: list[str], message: str, tmp_path: Path) -> None:
    done = recipe("plant", *overrides, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and message in done.stderr
    assert done.stderr.count("\n") == 1 and list(tmp_path.iterdir()) == []
