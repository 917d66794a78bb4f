"""The plant by its own clock, by the wall's, and by none."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.pose import PosePacket, decode_pose
from dreamer_racing.hil.vehicle import Command, at_rest, hover
from dreamer_racing.plant import process
from dreamer_racing.plant.commands import CommandReceiver
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.process import Plant, ProcessOptions, check_process, fly_in_real_time
from dreamer_racing.plant.vehicle import PlantVehicle
from dreamer_racing.settings import check_settings
from dreamer_racing.training.signals import GracefulExit


@pytest.fixture
def incoming() -> Iterator[socket.socket]:
    with bind("127.0.0.1", 0) as listening:
        yield listening


def make(
    vehicle: PlantVehicle, send: Callable[[bytes], object] | None = None, **settings: float
) -> tuple[Plant, list[PosePacket]]:
    """A plant and the poses that leave it."""
    poses: list[PosePacket] = []
    plant = Plant(
        vehicle, CommandReceiver(vehicle), Delivery(**settings), send or (lambda data: poses.append(decode_pose(data)))
    )
    return plant, poses


def packet(sequence: int, command: Command) -> bytes:
    return encode_command(CommandPacket(sequence, 0.0, command))


def test_poses_leave_at_their_rate_stamped_with_the_time_of_the_physics(fresh: PlantVehicle) -> None:
    plant, poses = make(fresh, rate=250.0)
    begin = fresh.time
    for step in range(1, 501):
        plant.advance_to(0.002 * step)
    assert [pose.sequence for pose in poses] == list(range(251))
    stamps = np.array([pose.stamp for pose in poses]) - begin
    assert stamps == pytest.approx(np.arange(251) / 250.0, abs=1e-9)
    assert poses[0].position == pytest.approx((4.0, -2.5, 1.35))
    plant.advance_to(0.5)  # past
    assert plant.time == 1.0 and len(poses) == 251


def test_the_failsafe_cuts_when_its_time_is_over_however_time_passes(fresh: PlantVehicle) -> None:
    plant, _ = make(fresh)
    assert plant.take(packet(0, at_rest()))
    plant.take(packet(1, Command(True, hover())))
    plant.advance_to(0.2)
    plant.take(packet(2, Command(True, hover())))
    plant.advance_to(0.449)
    assert fresh.armed and not fresh.on_stand
    plant.advance_to(2.0)  # in one go: the cut is where it belongs
    assert not fresh.armed
    fall = 0.5 * GRAVITY * 0.25**2
    assert fall < 1.35 and fresh.crash_description.endswith("when disarmed")
    seconds_to_ground = math.sqrt(2 * 1.3 / GRAVITY)
    crashed_at = float(fresh.crash_description.split()[2])
    assert crashed_at - (fresh.time - 2.0) == pytest.approx(0.45 + seconds_to_ground, abs=0.05)
    assert (
        "2 commands" not in plant.summary()
        and "3 commands (0 lost, 0 stale, 0 malformed), 1 failsafe(s)" in plant.summary()
    )


class Clock:
    """A wall clock that only waiting moves; it stands for both modules that tell the loop the time."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def select(self, reading: list, _: list, __: list, timeout: float) -> tuple[list, list, list]:
        self.now += timeout
        return [], [], []


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(process, "time", clock)
    monkeypatch.setattr(process, "select", clock)
    return clock


def test_real_time_does_not_drift_and_catches_up(
    fresh: PlantVehicle, incoming: socket.socket, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, poses = make(fresh, rate=200.0)
    advance = fresh.advance

    def slow(seconds: float) -> None:
        clock.now += 0.06 if 0.299 < plant.time < 0.301 else 0.001
        advance(seconds)

    monkeypatch.setattr(fresh, "advance", slow)
    fly_in_real_time(plant, incoming, GracefulExit(), duration=0.6)
    assert plant.time == pytest.approx(0.6) and len(poses) == 121
    assert clock.now - 1000.0 == pytest.approx(0.601, abs=1e-6)  # what a step takes does not add up
    # each of the steps after the long one makes up for 4 of its 55 ms behind the next pose
    assert plant.late == 13 and plant.latest == pytest.approx(0.055)
    assert "late 13 times (by 55 ms at most)" in plant.summary()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"command_port": 9100}, "command_port and pose_port are both 9100"),
        ({"betaflight": "2026.6", "state_port": 9100, "motor_port": 9100}, "motor_port and pose_port are both 9100"),
        ({"betaflight": "4"}, "betaflight=4: must be a firmware release, as 4.6 or 2026.6, or before"),
        ({"betaflight": "new"}, "betaflight=new: must be a firmware release"),
        ({"firmware": "auto", "state_port": 9002}, "motor_port and state_port are both 9002"),
    ],
)
def test_what_excludes_each_other_is_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_process(ProcessOptions(**options))


@pytest.mark.parametrize("options", [{"failsafe": 0.0}, {"pose_port": 0}])
def test_impossible_numbers_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))}=.*must be at least"):
        check_settings(ProcessOptions(**options))
