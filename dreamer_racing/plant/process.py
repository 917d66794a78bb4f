"""The process of a simulated drone: datagrams in and out, and physics that keeps to the clock.

`Plant` knows no clock: it is told how late it is. Two loops tell it: `fly_in_real_time` by the wall clock,
`fly_in_lock_step` by the commands themselves.
"""

from __future__ import annotations

import logging
import math
import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from dreamer_racing.hil.betaflight.firmware import Firmware, Ports, find_firmware
from dreamer_racing.hil.imu import encode_imu
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links.sitl import MSP_PORT, RC_PORT
from dreamer_racing.hil.links.udp import UdpTransport
from dreamer_racing.plant.betaflight_sitl import MOTOR_PORT, STATE_PORT, BetaflightSitl, dialect_of
from dreamer_racing.plant.commands import TIMEOUT, CommandReceiver, Controls
from dreamer_racing.plant.delivery import Delivery, PoseDelivery
from dreamer_racing.plant.vehicle import PlantVehicle
from dreamer_racing.settings import POSITIVE, Range, setting
from dreamer_racing.training.signals import GracefulExit

logger = logging.getLogger(__name__)

LATE = 0.005
"""s behind the clock from which it counts as late [choice]: the time between two poses at 200 Hz."""

_PATIENCE = 0.1  # s, between two looks at whether to stop
_LONGEST = 2048  # bytes of a datagram that are read: more than any that means something
_ROUNDING = 1e-9  # s
_PORT = Range(1, 65535)


@dataclass
class ProcessOptions:
    """Where a plant's datagrams go, and by which clock it flies."""

    host: str = "127.0.0.1"  # to listen on and to send to
    command_port: int = setting(9101, Range(0, 65535))  # commands come in here; 0: a free one
    pose_port: int = setting(9100, _PORT)  # poses go there
    failsafe: float = setting(TIMEOUT, Range(0.02, 10))  # s without a command after which motors are cut
    speed: float = setting(1.0, Range(0.05, 20))  # s of physics in one of the wall clock
    lock_step: bool = False  # no clock: each command flies one control step of the preset, each pose comes of one
    duration: float | None = setting(None, POSITIVE)  # s of physics; null: until it is stopped
    betaflight: str | None = None  # its release, as 4.6 or 2026.6: fly by the motors of a firmware (SITL), not commands
    # auto, or a program: set up and start that firmware and fly by it; auto: BETAFLIGHT_SITL, or the extra sitl
    firmware: str | None = None
    motor_port: int = setting(MOTOR_PORT, Range(0, 65535))  # the firmware's motors come in here
    state_port: int = setting(STATE_PORT, _PORT)  # the vehicle's state goes there
    channel_port: int = setting(RC_PORT, _PORT)  # with firmware=: where that is to hear channels
    serial_port: int = setting(MSP_PORT, _PORT)  # with firmware=: its first serial port (TCP): MSP and CLI


class Plant:
    """A vehicle with what moves it and what becomes of its poses; all times are those of its physics.

    Args:
        vehicle: The drone.
        controls: What tells it what to do.
        delivery: What becomes of poses.
        send: Sends a pose packet.
        incoming: By which whoever sent a command is told what the IMU tells, as often as poses are measured; None:
            nobody is.

    Attributes:
        commander: Address from which the last datagram came; None before it.
        time: s, to which everything has been done.
        vehicle: The drone.
        controls: What tells it what to do.
        late: Events that were done more than `LATE` behind the clock.
        latest: s, by how much at most.
    """

    def __init__(
        self,
        vehicle: PlantVehicle,
        controls: Controls,
        delivery: Delivery,
        send: Callable[[bytes], object],
        incoming: socket.socket | None = None,
    ) -> None:
        self.vehicle, self.controls = vehicle, controls
        self._incoming, self._told = incoming, 0
        self.commander: Any = None
        self._poses, self._send = PoseDelivery(delivery), send
        self.time = 0.0
        self.late, self.latest = 0, 0.0

    @property
    def due(self) -> float:
        """When there is next something to do, s."""
        return min(self._poses.next_measurement, self._poses.next_departure, self.controls.due)

    def advance_to(self, until: float) -> None:
        """Fly to a time, and do on the way what is due; a time that is past changes nothing."""
        while (due := self.due) <= until + _ROUNDING:
            self._fly_to(due)
            if self.controls.due <= due:
                self.controls.act(due)
            if self._poses.next_measurement <= due:
                self._poses.measure(self.vehicle.pose(), due)
                self._tell_imu()
            for packet in self._poses.depart(due):
                self._send(packet)
        self._fly_to(until)

    def _tell_imu(self) -> None:
        if self._incoming is None or self.commander is None:
            return
        self._told += 1
        with suppress(OSError):  # who listens no longer is no matter of the plant's
            self._incoming.sendto(encode_imu(self._told, self.time, self.vehicle.feel()), self.commander)

    def _fly_to(self, until: float) -> None:
        if until > self.time:
            self.vehicle.advance(until - self.time)
            self.time = until

    def take(self, data: bytes) -> bool:
        """Take a datagram as it arrives; return whether it was one to fly by."""
        return self.controls.take(data, self.time)

    def note_delay(self, delay: float) -> None:
        """Note that what is due is done so much behind the clock, s."""
        if delay > LATE:
            self.late += 1
            self.latest = max(self.latest, delay)

    def summary(self) -> str:
        """Say in a line what happened."""
        vehicle = self.vehicle
        laps = " ".join(f"{lap:.2f}" for lap in vehicle.lap_times)
        late = f", late {self.late} times (by {self.latest * 1e3:.0f} ms at most)" if self.late else ""
        return (
            f"plant: {self.time:.2f} s, {vehicle.gates_passed} gates in order, "
            f"{len(vehicle.lap_times)} laps{f' ({laps} s)' if laps else ''}, "
            f"crash: {vehicle.fate}, {self.controls.summary()}, "
            f"{self._poses.sent} poses sent, {self._poses.dropped} lost{late}"
        )


def fly_in_real_time(
    plant: Plant, incoming: socket.socket, stop: GracefulExit, speed: float = 1.0, duration: float = math.inf
) -> None:
    """Fly by the wall clock, counted from now: what is late is caught up with, and no delay adds to the next.

    Args:
        plant: What flies.
        incoming: Datagrams for it.
        stop: Ends it.
        speed: s of physics in one of the clock.
        duration: s of physics.
    """
    start = time.monotonic() - plant.time / speed
    while not stop.requested and plant.time < duration:
        wait = start + min(plant.due, duration) / speed - time.monotonic()
        plant.note_delay(-wait)
        if select.select([incoming], [], [], min(max(wait, 0.0), _PATIENCE))[0]:
            now = min((time.monotonic() - start) * speed, duration)
            if now < plant.due + LATE * speed:  # else they came during what was late: as if at its beginning
                plant.advance_to(now)
            for data in _drain(plant, incoming):
                plant.take(data)
        elif wait <= _PATIENCE:
            plant.advance_to(min(plant.due, duration))


def fly_in_lock_step(
    plant: Plant, incoming: socket.socket, stop: GracefulExit, period: float, duration: float = math.inf
) -> None:
    """Fly without a clock: every command lets a control step pass, and nothing else does.

    Args:
        plant: What flies.
        incoming: Commands for it.
        stop: Ends it.
        period: s of physics that a command lets pass.
        duration: s of physics.
    """
    while not stop.requested and plant.time < duration - _ROUNDING:
        if select.select([incoming], [], [], _PATIENCE)[0]:
            for data in _drain(plant, incoming):
                if plant.take(data):
                    plant.advance_to(plant.time + period)


def _drain(plant: Plant, incoming: socket.socket) -> list[bytes]:
    """Return the datagrams that wait, as many as there is time for, and let the plant know who sent them."""
    received: list[bytes] = []
    while len(received) < 256:
        try:
            data, plant.commander = incoming.recvfrom(_LONGEST)
        except (BlockingIOError, ConnectionRefusedError):
            break
        received.append(data)
    return received


def check_process(options: ProcessOptions) -> None:
    """Refuse ways to fly that exclude each other.

    Raises:
        ValueError: The message names the settings.
    """
    incoming, outgoing = "command_port", ["pose_port"]
    if options.betaflight is not None:
        dialect_of(options.betaflight)
    if name := by_firmware(options):
        incoming, outgoing = "motor_port", ["pose_port", "state_port"]
        if options.lock_step or options.speed != 1.0:
            given = getattr(options, name)
            raise ValueError(f"{name}={given}: it keeps to the wall clock; leave lock_step=false and speed=1.")
    if options.lock_step and options.speed != 1.0:
        raise ValueError(f"speed={options.speed}: with lock_step=true there is no clock to be faster than; leave it.")
    for name in outgoing:
        if getattr(options, name) == getattr(options, incoming):
            raise ValueError(f"{incoming} and {name} are both {getattr(options, name)}: give each its own.")


def by_firmware(options: ProcessOptions) -> str | None:
    """Return the setting that says that a firmware's motors fly it; None if none does."""
    return next((name for name in ("betaflight", "firmware") if getattr(options, name) is not None), None)


class Sockets(NamedTuple):
    """The ways in and out.

    Args:
        incoming: Commands, or the firmware's motors.
        poses: To whoever flies it.
        state: To the firmware.
    """

    incoming: socket.socket
    poses: UdpTransport
    state: UdpTransport

    def close(self) -> None:
        """Give back all ports."""
        for end in self:
            end.close()


def open_sockets(options: ProcessOptions) -> Sockets:
    """Open what a plant needs.

    Raises:
        ValueError: The options exclude each other.
        OSError: A port is in use, or there is no such host.
    """
    check_process(options)
    port = options.motor_port if by_firmware(options) else options.command_port
    incoming = bind(options.host, port)
    poses, state = (UdpTransport(options.host, port) for port in (options.pose_port, options.state_port))
    return Sockets(incoming, poses, state)


def start_firmware(named: str, options: ProcessOptions, sockets: Sockets, settings: Sequence[str]) -> Firmware:
    """Set up a firmware and start it, in real time.

    Args:
        named: Its program, or ``auto``, see `find_firmware`.
        options: Where it is reached.
        sockets: Of these options.
        settings: Lines for its CLI.

    Raises:
        ValueError: It is of another release than ``betaflight=``.
        OSError: There is none, or it does not start.
    """
    program = find_firmware(None if named == "auto" else named)
    motors = int(sockets.incoming.getsockname()[1])
    firmware = Firmware(program, settings, Ports(motors, options.state_port, options.channel_port, options.serial_port))
    try:
        given = options.betaflight
        if given is not None and dialect_of(given) != dialect_of(firmware.release):
            raise ValueError(f"betaflight={given}: the firmware says that it is {firmware.release}; leave it out.")
        firmware.start()
        firmware.wait_for_serial()
    except BaseException:
        firmware.close()
        raise
    logger.info("plant: Betaflight %s, set up in an empty folder: %s", firmware.release, program)
    for line, words in firmware.refused.items():
        logger.info("plant: it does not take %r: %s", line, words)
    return firmware


def run(
    vehicle: PlantVehicle,
    delivery: Delivery,
    options: ProcessOptions,
    sockets: Sockets,
    firmware: Firmware | None = None,
) -> Plant:
    """Fly until it is stopped by SIGINT or SIGTERM, or its time is up, and log a line of what happened.

    Args:
        vehicle: The drone.
        delivery: What becomes of its poses.
        options: By which clock it flies, and by which firmware.
        sockets: Of these options; they are closed at the end.
        firmware: That was started for it; it is stopped at the end.

    Returns:
        What has flown.
    """
    controls: Controls = CommandReceiver(vehicle, options.failsafe)
    release = options.betaflight if firmware is None else firmware.release
    if release is not None:
        controls = BetaflightSitl(vehicle, sockets.state.write, release, options.failsafe)
    plant = Plant(vehicle, controls, delivery, sockets.poses.write, sockets.incoming if release is None else None)
    duration = math.inf if options.duration is None else options.duration
    try:
        with GracefulExit() as stop:
            host, port = sockets.incoming.getsockname()
            logger.info("plant: %s, listens on %s:%d, poses to %d", vehicle.track.name, host, port, options.pose_port)
            if options.lock_step:
                fly_in_lock_step(plant, sockets.incoming, stop, vehicle.control_dt, duration)
            else:
                fly_in_real_time(plant, sockets.incoming, stop, options.speed, duration)
    finally:
        sockets.close()
        if firmware is not None:
            firmware.close()
        logger.info(plant.summary())
    return plant
