"""Simulates the effects of motion capture and a network on poses: sampling, noise, delay and loss."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.pose import PosePacket, encode_pose
from dreamer_racing.hil.vehicle import Pose
from dreamer_racing.settings import NOT_NEGATIVE, SHARE, Range, setting


@dataclass
class Delivery:
    """Sampling, delay, loss and noise of poses between the vehicle and their receiver."""

    rate: float = setting(200.0, Range(10, 1000))  # Hz, at which poses are measured
    latency: float = setting(0.0, Range(0, 1))  # s, from a measurement to its departure
    jitter: float = setting(0.0, Range(0, 1))  # s, more latency, uniform in [0, jitter]: packets may overtake others
    packet_loss: float = setting(0.0, SHARE)  # share of packets that are lost, independently of each other
    position_noise: float = setting(0.0, Range(0, 1))  # m, standard deviation along each axis
    attitude_noise: float = setting(0.0, Range(0, 1))  # rad, standard deviation about each body axis
    clock_offset: float = setting(0.0, Range(-1e9, 1e9))  # s, clock of the timestamps minus that of the physics
    seed: int = setting(0, NOT_NEGATIVE)  # seed of noise, jitter and loss


class PoseDelivery:
    """Delays pose packets until they are due.

    Attributes:
        sent: Number of packets that were sent.
        dropped: Number of packets that were lost.
    """

    def __init__(self, delivery: Delivery) -> None:
        self._delivery = delivery
        self._random = np.random.default_rng(delivery.seed)
        self._measured = 0
        self._waiting: list[tuple[float, int, bytes]] = []  # heap of times of departure, sequence numbers and packets
        self.sent = self.dropped = 0

    @property
    def next_measurement(self) -> float:
        """When the next pose is to be measured, s of physics time."""
        return self._measured / self._delivery.rate

    @property
    def next_departure(self) -> float:
        """When the next packet is to be sent, s of physics time; infinite if none is waiting."""
        return self._waiting[0][0] if self._waiting else math.inf

    def measure(self, pose: Pose, time: float) -> None:
        """Measure the pose that is due at a time, s of physics time, and queue or lose its packet."""
        sequence, self._measured = self._measured, self._measured + 1
        delivery, random = self._delivery, self._random
        draws = random.standard_normal(6)
        lost, delay = random.random() < delivery.packet_loss, delivery.latency + delivery.jitter * random.random()
        if lost:
            self.dropped += 1
            return
        packet = PosePacket(
            sequence,
            pose.time + delivery.clock_offset,
            pose.position + delivery.position_noise * draws[:3],
            turn(pose.attitude, delivery.attitude_noise * draws[3:]),
            pose.linear_velocity,
            pose.body_rates,
        )
        heapq.heappush(self._waiting, (time + delay, sequence, encode_pose(packet)))

    def depart(self, time: float) -> list[bytes]:
        """Return the packets to be sent by a time, s of physics time, in order of departure."""
        leaving = []
        while self.next_departure <= time:
            leaving.append(heapq.heappop(self._waiting)[2])
        self.sent += len(leaving)
        return leaving
