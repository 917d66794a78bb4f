"""kill -9 of pose source, loop, link and plant while they fly: who cuts, and how long after, at nominal limits.

Times are those that the loop records and that the kernel stamps, not the test's own. What the machine adds, ticks that
begin late or take long, is recorded too and taken off: where it adds nothing, what is left is the bound itself.
"""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.inlet import UdpInlet
from dreamer_racing.hil.links.udp import decode_command
from dreamer_racing.hil.recording import Flight
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.plant.commands import TIMEOUT, Failsafe
from tests.running_recipes import Process, free_port

PERIOD = 0.04  # s, of the agents that ship
CUT_AFTER = SafetyLimits.of_track(load_track("circle")).cut_after
WITHIN = 0.2  # s from the last pose to the cut
BUSY = ("limits.tick_max=1.0", "limits.overruns_max=1000")  # a busy machine: not what is measured here

POSES = """
import socket, sys, time
import numpy as np
from dreamer_racing.hil.pose import PosePacket, encode_pose
port, *start = map(float, sys.argv[1:])
out, attitude, zero = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), np.array(start[3:]), np.zeros(3)
for count in range(10**9):
    position = np.array(start[:3]) + 1e-3 * np.sin(0.1 * count)  # a vehicle that trembles on its stand
    packet = PosePacket(count, time.monotonic(), position, attitude, zero, zero)
    out.sendto(encode_pose(packet), ("127.0.0.1", int(port)))
    time.sleep(0.005)
"""
RELAY = """
import socket, sys
incoming, outgoing = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
incoming.bind(("127.0.0.1", int(sys.argv[1])))
print("relays", flush=True)
while True:
    outgoing.sendto(incoming.recv(2048), ("127.0.0.1", int(sys.argv[2])))
"""


class Ground:
    """A vehicle that only listens: commands with the time at which the kernel received each."""

    def __init__(self) -> None:
        self._inlet = UdpInlet(0)
        self.port = self._inlet.address[1]
        self.heard: list[tuple[float, bool]] = []  # s (time.monotonic), armed

    def listen(self) -> list[tuple[float, bool]]:
        for arrived, data in self._inlet.read():
            packet = decode_command(data)
            assert packet is not None
            self.heard.append((arrived, packet.command.armed))
        return self.heard

    def wait_until_armed(self, loop: Process) -> None:
        deadline = time.monotonic() + 90
        while not any(armed for _, armed in self.listen()):
            assert time.monotonic() < deadline and loop.running.poll() is None, loop.said
            loop.listen(0.05)

    def close(self) -> None:
        self._inlet.close()


class Parts(NamedTuple):
    poses: Process
    relay: Process
    loop: Process
    ground: Ground


@contextmanager
def armed(folder: Path) -> Iterator[Parts]:
    """Pose source, loop and link, each a process of its own, and a vehicle that has just been armed."""
    (folder / "poses.py").write_text(POSES)
    (folder / "relay.py").write_text(RELAY)
    track, ground, pose_port, relay_port = load_track("circle"), Ground(), free_port(), free_port()
    yaw = math.radians(track.start_yaw_degrees) / 2
    start = (pose_port, *track.start_position, math.cos(yaw), 0.0, 0.0, math.sin(yaw))
    own = ("actor=circle", "arm=true", f"run_dir={folder / 'run'}", *BUSY, "duration=20")
    with (
        Process(str(folder / "poses.py"), *map(str, start)) as poses,
        Process(str(folder / "relay.py"), str(relay_port), str(ground.port)) as relay,
        Process("hil", *own, f"link_port={relay_port}", f"pose_port={pose_port}") as loop,
    ):
        relay.wait_for("relays")
        ground.wait_until_armed(loop)
        time.sleep(0.2)
        yield Parts(poses, relay, loop, ground)
    ground.close()


def check_cut(flown: Flight) -> None:
    """The first tick at which poses are lost cuts, and it comes in time but for what the machine added."""
    newest, before = -math.inf, math.nan
    for tick in flown.ticks:
        now = tick["in"]["time"]
        newest = max([newest, *(arrived for arrived, *_ in tick["in"]["received"])])
        if tick["out"]["state"] == "cut":
            break
        assert not tick["out"]["command"][0] or now - newest <= CUT_AFTER, "poses were lost at a tick that flew on"
        before = now
    assert tick["out"]["state"] == "cut" and "pose lost" in tick["out"]["reasons"]
    machine = max(now - before - PERIOD, 0.0) + tick["took"]["sent"]
    assert CUT_AFTER < now - newest <= WITHIN + machine - 0.005, f"{now - newest:.3f} s, {machine:.3f} of them its"


def test_poses_that_stop(tmp_path):
    with armed(tmp_path) as parts:
        parts.poses.running.kill()
        while parts.loop.running.poll() is None:
            parts.ground.listen()
            parts.loop.listen(0.02)
        said, heard = parts.loop.end(), parts.ground.listen()
    assert "ended: cut: the newest pose is" in said
    flown = Flight(tmp_path / "run")
    check_cut(flown)
    cut = next(tick["in"]["time"] for tick in flown.ticks if tick["out"]["state"] == "cut")
    after = [is_armed for arrived, is_armed in heard if arrived > cut]
    assert len(after) > 40 and not any(after), "from the cut on the vehicle hears disarm frames, and nothing else"


def test_a_loop_that_dies_leaves_a_silence_that_the_vehicles_own_failsafe_ends(tmp_path):
    with armed(tmp_path) as parts:
        parts.loop.running.kill()
        parts.loop.running.wait()
        time.sleep(0.1)
        heard = list(parts.ground.listen())
        time.sleep(0.3)
        assert parts.ground.listen() == heard and heard[-1][1], "nothing more is said, the last word was to fly"
    failsafe = Failsafe(TIMEOUT)
    for arrived, is_armed in heard:
        failsafe.hear(is_armed, arrived)
    last = heard[-1][0]
    assert failsafe.deadline == pytest.approx(last + 0.25)
    assert not failsafe.expire(last + 0.249) and failsafe.expire(last + 0.251)
    flown = Flight(tmp_path / "run")
    assert not flown.whole and flown.ticks[-1]["out"]["command"][0] is True, "it is on disk up to its last tick"


def test_a_link_that_dies_is_noticed_and_the_vehicles_own_failsafe_ends_it(tmp_path):
    with armed(tmp_path) as parts:
        parts.relay.running.kill()
        parts.relay.running.wait()
        time.sleep(0.1)
        heard = len(parts.ground.listen())
        time.sleep(0.4)
        assert len(parts.ground.listen()) == heard and parts.ground.heard[-1][1]
        said = parts.loop.end()
    assert "ended: cut: the link has accepted no command" in said
    statistics = json.loads((tmp_path / "run" / "statistics.json").read_text())
    assert statistics["commands_dropped"] >= 1  # a port where nobody listens is known on the same machine


@contextmanager
def flying(folder: Path) -> Iterator[tuple[Process, Process]]:
    """A plant that an agent flies, and the loop; it may have been cut already where the machine is too busy."""
    command_port, pose_port = free_port(), free_port()
    with Process(
        "plant", "track=circle", "preset=easy", f"command_port={command_port}", f"pose_port={pose_port}"
    ) as plant:
        plant.wait_for("listens on")
        own = ("actor=circle", "arm=true", f"run_dir={folder}", *BUSY)
        with Process("hil", *own, f"link_port={command_port}", f"pose_port={pose_port}") as loop:
            deadline = time.monotonic() + 90
            while "the stand released it" not in plant.said and loop.running.poll() is None:
                assert time.monotonic() < deadline, plant.said + loop.said
                plant.listen(0.05)
            yield plant, loop


def test_a_plant_that_dies(tmp_path):
    with flying(tmp_path) as (plant, loop):
        plant.running.kill()
        said = loop.end()
    assert loop.running.returncode == 1, said  # it was cut
    assert "ended: cut: " in said and "the newest pose is" in said, said
    flown = Flight(tmp_path)
    assert flown.whole
    check_cut(flown)
    assert json.loads((tmp_path / "statistics.json").read_text())["loop"]["ticks"] == len(flown.ticks)


def test_the_plant_cuts_when_the_loop_dies(tmp_path):
    with flying(tmp_path) as (plant, loop):
        loop.running.kill()
        loop.running.wait()
        plant.wait_for("no message for 0.25 s: motors are cut")  # by its physics, which keeps to the clock
        plant.running.send_signal(signal.SIGTERM)
        plant.end()
    assert plant.running.returncode == 0
