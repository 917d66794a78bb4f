"""Runs flight loop and plant in simulated time, as fast as they compute: alone, or with a real Betaflight firmware.

Packets, and the code that reads them, are those of a real flight; only time is that of the plant's physics. The result
does not depend on the machine's load, and is reproducible. Of a firmware's process, each state packet lets one physics
step pass.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from dreamer_racing.hil.battery import Reading
from dreamer_racing.hil.betaflight.firmware import Firmware, Ports
from dreamer_racing.hil.chain import FlightChain
from dreamer_racing.hil.imu import ImuReading
from dreamer_racing.hil.inlet import bind
from dreamer_racing.hil.links.link import TransportLink
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.loop import FlightLoop
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import Received, decode_pose
from dreamer_racing.hil.recording import FlightRecorder
from dreamer_racing.hil.vehicle import Command, at_rest
from dreamer_racing.plant.betaflight_sitl import BetaflightSitl
from dreamer_racing.plant.commands import CommandReceiver, Controls
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.process import Plant
from dreamer_racing.plant.vehicle import PlantVehicle

CLOCK_OFFSET = 1000.0
"""s, by the loop's clock, when the plant's physics began: not 0, so that mixing up the clocks shows."""

ENABLE_AFTER = 0.5  # s after which the operator gives the enable [choice]
READY_AFTER = 1.5
"""s for which a booted firmware receives the state of a vehicle at rest before it flies [choice]: it finds its level
within 0.1 s and accepts a radio after 0.6 s of valid channels (measured with 4.6.0)."""

_STEP_DONE = b"step"  # of `simulated_time.c`
_PATIENCE = 20.0  # s for a step; it takes 0.1 ms


class LockStep:
    """A plant with all that a `FlightLoop` needs: clock, link, pose source and operator.

    Attributes:
        plant: The drone, with its controls and pose delivery.
        speed_max: m/s, highest speed at the ticks while armed: a fall after the flight does not count.
        enable_after: s after which the operator gives the enable.
        killed: Whether the operator kills; settable.
    """

    def __init__(
        self, vehicle: PlantVehicle, delivery: Delivery | None = None, controls: Controls | None = None
    ) -> None:
        self.plant = Plant(vehicle, controls or CommandReceiver(vehicle), delivery or Delivery(), self._deliver)
        self.speed_max = 0.0
        self.enable_after, self.killed = ENABLE_AFTER, False
        self.poses, self.operator = _Poses(), _Operator(self)
        self._sequence = 0

    @property
    def elapsed(self) -> float:
        """Physics time since construction, s."""
        return self.plant.time

    def now(self) -> float:
        """Return the time by the loop's clock, s."""
        return CLOCK_OFFSET + self.plant.time

    def sleep_until(self, deadline: float) -> None:
        """Let the plant fly until a time."""
        self.plant.advance_to(deadline - CLOCK_OFFSET)
        if self.plant.vehicle.armed:
            velocity = self.plant.vehicle.pose().linear_velocity
            self.speed_max = max(self.speed_max, float((velocity @ velocity) ** 0.5))

    def send(self, command: Command) -> bytes:
        """Send a command to the plant; return its packet."""
        self._sequence += 1
        data = encode_command(CommandPacket(self._sequence, self.now(), command))
        self.plant.take(data)
        return data

    def listen(self) -> list[Reading]:
        """Return nothing: this vehicle does not report its battery."""
        return []

    def read_imu(self) -> list[ImuReading]:
        """Return the present sample of the plant's IMU."""
        return [ImuReading(self.now(), self.plant.vehicle.read_imu())]

    @property
    def refusal(self) -> str:
        """Empty: this vehicle follows all commands."""
        return ""

    def set_voltage(self, voltage: float) -> None:
        """Do nothing: thrust is sent in SI units."""

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def fly(self, chain: FlightChain, rate: float, duration: float, recorder: FlightRecorder | None = None) -> str:
        """Fly until the flight is over, or for ``duration`` s; return why it ended."""
        return FlightLoop(chain, self.poses, self.operator, self, rate, recorder, clock=self).run(
            duration, patience=duration
        )

    def _deliver(self, data: bytes) -> None:
        packet = decode_pose(data)
        if packet is None:
            self.poses.rejected += 1
        else:
            self.poses.arrived.append(Received(self.now(), packet))


class _Poses:
    """The source of the poses that the plant has sent."""

    def __init__(self) -> None:
        self.rejected = 0
        self.arrived: list[Received] = []

    def poll(self) -> list[Received]:
        arrived, self.arrived = self.arrived, []
        return arrived

    def close(self) -> None:
        pass


class _Operator:
    """Gives the enable after a while."""

    def __init__(self, lock_step: LockStep) -> None:
        self._lock_step = lock_step

    def poll(self, armed: bool = False) -> Operator:
        lock_step = self._lock_step
        return Operator(lock_step.elapsed >= lock_step.enable_after, lock_step.killed)

    def close(self) -> None:
        pass


class SteppedFirmware:
    """A `Firmware` in simulated time, which has its arguments.

    Attributes:
        firmware: The process.
    """

    def __init__(self, program: Path, settings: Sequence[str], step: float = 0.001) -> None:
        self._motors = bind("127.0.0.1", 0)
        self._motors.settimeout(_PATIENCE)
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            ports = Ports.free(self._motors.getsockname()[1])
            self.firmware = Firmware(program, settings, ports, step)
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Restart the firmware with its settings."""
        self.firmware.stop()
        self._motors.setblocking(False)
        with suppress(BlockingIOError):  # what the last process has sent
            while True:
                self._motors.recv(64)
        self._motors.settimeout(_PATIENCE)
        self.firmware.start()
        self._take_step()

    def exchange(self, state: bytes) -> list[bytes]:
        """Send the vehicle's state, let a step pass, and return the motor packets that the firmware sent.

        Raises:
            OSError: The firmware has ended, or hangs.
        """
        self._out.sendto(state, ("127.0.0.1", self.firmware.ports.state))
        return self._take_step()

    def _take_step(self) -> list[bytes]:
        """Return the packets that the firmware sends until a step, or its boot, is over."""
        packets: list[bytes] = []
        while True:
            try:
                data = self._motors.recv(64)
            except TimeoutError as error:
                self.firmware.check()
                raise OSError(f"the firmware did not make a step within {_PATIENCE:g} s.") from error
            if data == _STEP_DONE:
                return packets
            packets.append(data)

    def hear(self, data: bytes) -> None:
        """Send a radio's packet, which the firmware reads before the next step."""
        self._out.sendto(data, ("127.0.0.1", self.firmware.ports.channels))

    def close(self) -> None:
        """Stop it, and close the sockets."""
        if hasattr(self, "firmware"):
            self.firmware.close()
        self._motors.close()
        self._out.close()


class Radio:
    """A `Transport` of channels to a firmware, which can be disconnected.

    Attributes:
        disconnected: Whether it is disconnected, so that packets are lost.
    """

    def __init__(self, firmware: SteppedFirmware) -> None:
        self._firmware = firmware
        self.disconnected = False

    def write(self, data: bytes) -> bool:
        """Send a packet to the firmware; report success even if disconnected, as a radio would."""
        if not self.disconnected:
            self._firmware.hear(data)
        return True

    def discard(self) -> None:
        """Do nothing: packets leave at once."""

    def read(self) -> Iterator[tuple[float, bytes]]:
        """Yield nothing: nothing comes back."""
        return iter(())

    def close(self) -> None:
        """Do nothing: the firmware's owner closes it."""


class FirmwareStep(LockStep):
    """A plant whose motors a firmware controls; the loop sends its commands to the firmware by a link.

    Args:
        vehicle: The drone.
        firmware: One that was started, and has not flown since.
        link: To the firmware.
        delivery: Of the drone's poses.

    Attributes:
        disarmed_at: When its motors first stopped after they had turned, s of physics; None: never.
    """

    def __init__(
        self, vehicle: PlantVehicle, firmware: SteppedFirmware, link: TransportLink, delivery: Delivery | None = None
    ) -> None:
        super().__init__(vehicle, delivery, BetaflightSitl(vehicle, self._exchange, firmware.firmware.release))
        self._firmware, self._link = firmware, link
        self.disarmed_at: float | None = None
        self.after_step: Callable[[], None] = lambda: None

    def _exchange(self, state: bytes) -> None:
        turned = self.plant.vehicle.armed
        for packet in self._firmware.exchange(state):
            self.plant.take(packet)
        if turned and not self.plant.vehicle.armed and self.disarmed_at is None:
            self.disarmed_at = self.elapsed
        self.after_step()

    def wait_until_ready(self, rate: float = 50.0) -> None:
        """Send disarmed commands until the firmware has found its level and its radio, and would arm."""
        for _ in range(round(READY_AFTER * rate)):
            self._link.send(at_rest())
            self.plant.advance_to(self.plant.time + 1.0 / rate)
        self.enable_after += self.elapsed

    @property
    def refusal(self) -> str:
        """Why the firmware does not follow commands, as far as the link knows."""
        return self._link.refusal

    def listen(self) -> list[Reading]:
        """Return the link's voltage readings."""
        return self._link.listen()

    def send(self, command: Command) -> bytes:
        """Send a command by the link."""
        return self._link.send(command)
