"""A flight without a clock: the loop's time is the plant's, and packets arrive when they are said to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.loop import FlightLoop
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import Received, make_packet
from dreamer_racing.hil.recording import FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.vehicle import Command, Pose
from dreamer_racing.plant.vehicle import PlantVehicle

POSE_PERIOD = 0.005  # s
BEGAN = 1000.0  # s, by the loop's clock


class SimulatedTime:
    """Clock, pose source, link and operator of a loop around a vehicle in the same process.

    Args:
        vehicle: To fly.
        loss: Share of pose packets that are lost.
        enable_after: s after which the operator gives the enable.
        event: Called with the time since the beginning before each pose; for faults.
    """

    def __init__(
        self,
        vehicle: PlantVehicle,
        loss: float = 0.0,
        enable_after: float = 0.5,
        event: Callable[[float], None] | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.time = BEGAN
        self.sent: list[tuple[float, Command]] = []
        self.rejected = 0
        self.silent = False  # whether poses have ceased
        self.killed = False
        self._event, self._loss, self._enable_after = event, loss, enable_after
        self._random = np.random.default_rng(0)
        self._queue: list[Received] = []
        self._sequence = 0

    def now(self) -> float:
        return self.time

    def sleep_until(self, deadline: float) -> None:
        while self.time + POSE_PERIOD <= deadline + 1e-9:
            if self._event is not None:
                self._event(self.time - BEGAN)
            self.vehicle.advance(POSE_PERIOD)
            self.time += POSE_PERIOD
            self._sequence += 1
            if not self.silent and self._random.random() >= self._loss:
                packet = make_packet(self._sequence, self.time, *self.vehicle.pose()[1:])
                assert packet is not None
                self._queue.append(Received(self.time, packet))
        if deadline > self.time:
            self.vehicle.advance(deadline - self.time)
            self.time = deadline

    def send(self, command: Command) -> bytes:
        self.sent.append((self.time - BEGAN, command))
        self.vehicle.command(command)
        return b"sent"

    def close(self) -> None:
        pass

    @property
    def poses(self) -> _Poses:
        return _Poses(self)

    @property
    def operator(self) -> _Operator:
        return _Operator(self)

    def take_poses(self) -> list[Received]:
        taken, self._queue = self._queue, []
        return taken

    def wanted(self) -> Operator:
        return Operator(self.time - BEGAN >= self._enable_after, self.killed)


class _Poses:
    rejected = 0

    def __init__(self, time: SimulatedTime) -> None:
        self.poll = time.take_poses

    def close(self) -> None:
        pass


class _Operator:
    def __init__(self, time: SimulatedTime) -> None:
        self.poll = time.wanted

    def close(self) -> None:
        pass


def limits_of(track: Track, **changed: object) -> SafetyLimits:
    low = track.bounds_low
    return SafetyLimits(
        **{
            "fence_low": (low[0], low[1], low[2] - 0.2),
            "fence_high": track.bounds_high,
            "start_position": track.start_position,
            "start_yaw_degrees": track.start_yaw_degrees,
            **changed,
        }
    )


def fly(
    flyer: Flyer,
    time: SimulatedTime,
    chain: FlightChain,
    recorder: FlightRecorder | None = None,
    duration: float | None = 30.0,
) -> str:
    loop = FlightLoop(chain, time.poses, time.operator, time, flyer.rate, recorder, clock=time)
    return loop.run(duration)


def make_chain(flyer: Flyer, track: Track, laps: int | None = 3, arm: bool = True, **limits: object) -> FlightChain:
    config = ChainConfig(limits_of(track, **limits), laps=laps, arm=arm)
    camera = None
    if flyer.camera is not None:
        from dreamer_racing.hil.camera import NoseCamera

        camera = NoseCamera(track, flyer.camera)
    return FlightChain(flyer, track, config, camera)


class Hover:
    """Asks to stay where it is."""

    rate = 50.0
    camera = None

    def __init__(self) -> None:
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int):
        from dreamer_racing.hil.vehicle import hover

        return hover()
