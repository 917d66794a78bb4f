"""Runs flight loop and plant in one process, without sockets or a clock, as fast as they compute.

Packets, and the code that reads them, are those of a real flight; only time is that of the plant's physics.
"""

from __future__ import annotations

from dreamer_racing.hil.battery import Reading
from dreamer_racing.hil.chain import FlightChain
from dreamer_racing.hil.imu import ImuReading
from dreamer_racing.hil.links.udp import CommandPacket, encode_command
from dreamer_racing.hil.loop import FlightLoop
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import Received, decode_pose
from dreamer_racing.hil.recording import FlightRecorder
from dreamer_racing.hil.vehicle import Command
from dreamer_racing.plant.commands import CommandReceiver, Controls
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.process import Plant
from dreamer_racing.plant.vehicle import PlantVehicle

CLOCK_OFFSET = 1000.0
"""s, by the loop's clock, when the plant's physics began: not 0, so that mixing up the clocks shows."""

ENABLE_AFTER = 0.5  # s after which the operator gives the enable [choice]


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
