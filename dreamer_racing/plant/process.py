"""The process of a simulated drone: datagrams in and out, and physics that keeps up with a clock.

`Plant` has no clock: `fly_in_real_time` advances it by the wall clock.
"""

from __future__ import annotations

import logging
import math
import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from dreamer_racing.hil.betaflight.firmware import Firmware, Ports, find_firmware
from dreamer_racing.hil.imu import encode_imu
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links.sitl import MSP_PORT, RC_PORT
from dreamer_racing.hil.links.udp import UdpTransport
from dreamer_racing.plant.betaflight_sitl import MOTOR_PORT, STATE_PORT, BetaflightSitl, convention_of
from dreamer_racing.plant.commands import TIMEOUT, CommandReceiver, Controls
from dreamer_racing.plant.delivery import Delivery, PoseDelivery
from dreamer_racing.plant.vehicle import PlantVehicle
from dreamer_racing.settings import POSITIVE, Range, setting
from dreamer_racing.training.signals import GracefulExit

logger = logging.getLogger(__name__)

LATE = 0.005  # s behind the clock from which an event counts as late [choice]: the time between two poses at 200 Hz
_PATIENCE = 0.1  # s, between two checks of whether to stop
_LONGEST = 2048  # bytes of a datagram that are read: more than any valid one has
_ROUNDING = 1e-9  # s
_PORT = Range(1, 65535)


@dataclass
class ProcessOptions:
    """Where a plant's datagrams go, and how long it flies."""

    host: str = "127.0.0.1"  # to listen on and to send to
    command_port: int = setting(9101, Range(0, 65535))  # port on which commands arrive; 0: a free one
    pose_port: int = setting(9100, _PORT)  # port to which poses are sent
    failsafe: float = setting(TIMEOUT, Range(0.02, 10))  # s without a command after which motors are cut
    duration: float | None = setting(None, POSITIVE)  # s of physics; null: until it is stopped
    betaflight: str | None = None  # release of a running firmware (SITL), as 4.6 or 2026.6: fly by its motors
    # set up and start a firmware, and fly by its motors: its program, or auto: BETAFLIGHT_SITL, or the extra sitl
    firmware: str | None = None
    motor_port: int = setting(MOTOR_PORT, Range(0, 65535))  # port on which the firmware's motor commands arrive
    state_port: int = setting(STATE_PORT, _PORT)  # port to which the vehicle's state is sent
    channel_port: int = setting(RC_PORT, _PORT)  # with firmware=: port on which it receives channels
    serial_port: int = setting(MSP_PORT, _PORT)  # with firmware=: its first serial port (TCP): MSP and CLI


class Plant:
    """A vehicle with its controls and the delivery of its poses; all times are physics time.

    Args:
        vehicle: The drone.
        controls: Receives the messages that control it.
        delivery: Of its poses.
        send: Sends a pose packet.
        incoming: Socket by which the sender of commands gets IMU samples, as often as poses are measured; None: they
            are not sent.

    Attributes:
        commander: Address from which the last datagram came; None before the first.
        time: s, to which physics has advanced.
        late: Number of events that were more than `LATE` behind the clock.
        latest: s, largest such delay.
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
        self._incoming, self._imu_packets = incoming, 0
        self.commander: Any = None
        self._poses, self._send = PoseDelivery(delivery), send
        self.time = 0.0
        self.late, self.latest = 0, 0.0

    @property
    def due(self) -> float:
        """Time of the next event, s."""
        return min(self._poses.next_measurement, self._poses.next_departure, self.controls.due)

    def advance_to(self, until: float) -> None:
        """Fly to a time, and handle the events on the way; a time that is past changes nothing."""
        while (due := self.due) <= until + _ROUNDING:
            self._fly_to(due)
            if self.controls.due <= due:
                self.controls.act(due)
            if self._poses.next_measurement <= due:
                self._poses.measure(self.vehicle.pose(), due)
                self._send_imu()
            for packet in self._poses.depart(due):
                self._send(packet)
        self._fly_to(until)

    def _send_imu(self) -> None:
        if self._incoming is None or self.commander is None:
            return
        self._imu_packets += 1
        with suppress(OSError):  # a receiver that has gone does not concern the plant
            self._incoming.sendto(encode_imu(self._imu_packets, self.time, self.vehicle.read_imu()), self.commander)

    def _fly_to(self, until: float) -> None:
        if until > self.time:
            self.vehicle.advance(until - self.time)
            self.time = until

    def take(self, data: bytes) -> bool:
        """Process a datagram as it arrives; return whether it was accepted."""
        return self.controls.take(data, self.time)

    def summary(self) -> str:
        """Return one line on what happened."""
        vehicle = self.vehicle
        laps = " ".join(f"{lap:.2f}" for lap in vehicle.lap_times)
        late = f", late {self.late} times (by {self.latest * 1e3:.0f} ms at most)" if self.late else ""
        return (
            f"plant: {self.time:.2f} s, {vehicle.gates_passed} gates in order, "
            f"{len(vehicle.lap_times)} laps{f' ({laps} s)' if laps else ''}, "
            f"crash: {vehicle.crash_description}, {self.controls.summary()}, "
            f"{self._poses.sent} poses sent, {self._poses.dropped} lost{late}"
        )


def fly_in_real_time(plant: Plant, incoming: socket.socket, stop: GracefulExit, duration: float = math.inf) -> None:
    """Fly for so many s by the wall clock, counted from now; delays are caught up with, and do not add up."""
    start = time.monotonic() - plant.time
    while not stop.requested and plant.time < duration:
        wait = start + min(plant.due, duration) - time.monotonic()
        if -wait > LATE:
            plant.late += 1
            plant.latest = max(plant.latest, -wait)
        if select.select([incoming], [], [], min(max(wait, 0.0), _PATIENCE))[0]:
            now = min(time.monotonic() - start, duration)
            if now < plant.due + LATE:  # else physics is late: as if datagrams arrived at its present time
                plant.advance_to(now)
            for data in _drain(plant, incoming):
                plant.take(data)
        elif wait <= _PATIENCE:
            plant.advance_to(min(plant.due, duration))


def _drain(plant: Plant, incoming: socket.socket) -> list[bytes]:
    """Return the waiting datagrams, up to 256, and note in the plant who sent the last one."""
    received: list[bytes] = []
    while len(received) < 256:
        try:
            data, plant.commander = incoming.recvfrom(_LONGEST)
        except (BlockingIOError, ConnectionRefusedError):
            break
        received.append(data)
    return received


def check_process(options: ProcessOptions) -> None:
    """Refuse options that exclude each other, and name them."""
    incoming, outgoing = "command_port", ["pose_port"]
    if options.betaflight is not None:
        convention_of(options.betaflight)
    if firmware_option(options):
        incoming, outgoing = "motor_port", ["pose_port", "state_port"]
    for name in outgoing:
        if getattr(options, name) == getattr(options, incoming):
            raise ValueError(f"{incoming} and {name} are both {getattr(options, name)}: give each its own port.")


def firmware_option(options: ProcessOptions) -> str | None:
    """Return the name of the option that selects flight by a firmware's motors; None if none does."""
    return next((name for name in ("betaflight", "firmware") if getattr(options, name) is not None), None)


class Sockets(NamedTuple):
    """The sockets of a plant."""

    incoming: socket.socket  # commands, or the firmware's motors
    poses: UdpTransport  # to the receiver of poses
    state: UdpTransport  # to the firmware

    def close(self) -> None:
        """Close all sockets."""
        for end in self:
            end.close()


def open_sockets(options: ProcessOptions) -> Sockets:
    """Open the sockets of a plant.

    Raises:
        ValueError: The options exclude each other.
        OSError: A port is in use, or there is no such host.
    """
    check_process(options)
    port = options.motor_port if firmware_option(options) else options.command_port
    incoming = bind(options.host, port)
    poses, state = (UdpTransport(options.host, port) for port in (options.pose_port, options.state_port))
    return Sockets(incoming, poses, state)


def start_firmware(named: str, options: ProcessOptions, sockets: Sockets, settings: Sequence[str]) -> Firmware:
    """Set up a firmware with lines for its CLI and start it, in real time; ``named`` is its program or ``auto``.

    Raises:
        ValueError: It is of another release than ``betaflight=``.
        OSError: There is no firmware, or it does not start.
    """
    program = find_firmware(None if named == "auto" else named)
    motors = int(sockets.incoming.getsockname()[1])
    firmware = Firmware(program, settings, Ports(motors, options.state_port, options.channel_port, options.serial_port))
    try:
        given, found = options.betaflight, convention_of(firmware.release)
        if given is not None and convention_of(given) != found:
            raise ValueError(f"betaflight={given}: the firmware reports release {firmware.release}; leave it out.")
        firmware.start()
        firmware.wait_for_serial()
    except BaseException:
        firmware.close()
        raise
    logger.info("plant: Betaflight %s, set up in an empty folder: %s", firmware.release, program)
    for line, words in firmware.refused.items():
        logger.info("plant: the firmware refused %r: %s", line, words)
    return firmware


def run(
    vehicle: PlantVehicle,
    delivery: Delivery,
    options: ProcessOptions,
    sockets: Sockets,
    firmware: Firmware | None = None,
) -> Plant:
    """Fly until SIGINT, SIGTERM or the end of the duration, log a line on what happened, and return the plant.

    The sockets, opened for these options, are closed at the end, and a firmware that was started for it is stopped.
    """
    with ExitStack() as opened, GracefulExit() as stop:
        opened.callback(sockets.close)
        if firmware is not None:
            opened.callback(firmware.close)
        controls: Controls = CommandReceiver(vehicle, options.failsafe)
        release = options.betaflight if firmware is None else firmware.release
        if release is not None:
            controls = BetaflightSitl(vehicle, sockets.state.write, release, options.failsafe)
        plant = Plant(vehicle, controls, delivery, sockets.poses.write, sockets.incoming if release is None else None)
        opened.callback(lambda: logger.info(plant.summary()))
        host, port = sockets.incoming.getsockname()
        logger.info("plant: %s, listens on %s:%d, poses to %d", vehicle.track.name, host, port, options.pose_port)
        duration = math.inf if options.duration is None else options.duration
        fly_in_real_time(plant, sockets.incoming, stop, duration)
    return plant
