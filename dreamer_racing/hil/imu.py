"""Samples of a flight controller's gyro and accelerometer, and the UDP packet in which a plant sends them.

A sample is (6,): body rates in rad/s, then specific force in m/s², +9.81 upwards at rest; body frame FLU. The packet,
68 bytes (`hil.packets`): ``b"DRI1"``, sequence number u32, the sender's time f64 (s), and six f64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.packets import PacketFormat

PACKET = PacketFormat(b"DRI1", "Id6d")

LARGEST = 1e4  # rad/s or m/s² beyond which a number is no measurement of a drone [choice]

AT_REST = 0.25
"""Share by which the specific force of a resting vehicle may differ from gravity [choice]; a wrong scale is off by at
least a half."""


class ImuReading(NamedTuple):
    """A sample and when it arrived."""

    time: float  # s, `time.monotonic`
    sample: np.ndarray  # (6,) body rates, rad/s, and specific force, m/s², FLU


def make_sample(rates: tuple[float, ...], force: tuple[float, ...]) -> np.ndarray | None:
    """Return a sample (6,); None if a number is not plausible."""
    sample = np.array((*rates, *force), float)
    return sample if bool((np.abs(sample) <= LARGEST).all()) else None


def encode_imu(sequence: int, stamp: float, sample: np.ndarray) -> bytes:
    """Return the bytes of a packet."""
    return PACKET.pack(sequence % 2**32, stamp, *sample)


def decode_imu(data: bytes) -> np.ndarray | None:
    """Return the sample in a packet; None if it has another size or kind, is damaged, or is not plausible."""
    content = PACKET.unpack(data)
    return None if content is None else make_sample(content[2:5], content[5:])


def check_at_rest(sample: np.ndarray) -> str | None:
    """Return why a sample cannot be that of a resting vehicle, in words; None if it can."""
    force = float(np.linalg.norm(sample[3:]))
    if math.isfinite(force) and abs(force - GRAVITY) <= AT_REST * GRAVITY:
        return None
    return (
        f"its accelerometer reads {force:.3g} m/s² at rest, not {GRAVITY}: is it calibrated, or does its message use "
        "another scale?"
    )
