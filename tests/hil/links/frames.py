"""The links' frames as read by hand, and the maps of the drone that they are for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from operator import xor

from dreamer_racing.hil.links.crsf import encode_crsf
from dreamer_racing.hil.links.msp import encode_msp
from dreamer_racing.hil.links.sbus import encode_sbus
from dreamer_racing.hil.links.sitl import encode_sitl
from dreamer_racing.hil.sticks import RateMap, ThrustMap

RATES = RateMap(roll=10.0, pitch=10.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)
RESTING = (1500.0, 1500.0, 1000.0, 1500.0, *[1000.0] * 12)


def read_bits(data: bytes) -> list[float]:
    """Channels of 11 bits each, µs: one string of bits, in the order in which a wire has them."""
    bits = "".join(format(byte, "08b")[::-1] for byte in data)
    ticks = [int(bits[start : start + 11][::-1], 2) for start in range(0, 176, 11)]
    return [1500 + (tick - 992) * 1000 / 1600 for tick in ticks]


def read_words(data: bytes) -> list[float]:
    return [low + 256 * high for low, high in zip(data[::2], data[1::2], strict=True)]


CHANNEL_LINKS = {
    "crsf": (encode_crsf, lambda frame: read_bits(frame[3:25])),
    "sbus": (encode_sbus, lambda frame: read_bits(frame[1:23])),
    "msp": (encode_msp, lambda frame: read_words(frame[5:37])),
    "betaflight_sitl": (encode_sitl, lambda frame: read_words(frame[8:40])),
}
"""Encoder and reader of each link that sends 16 channels."""


def read_channels(name: str, frame: bytes) -> Sequence[float]:
    return CHANNEL_LINKS[name][1](frame)


def msp_answer(code: int, payload: bytes, kind: bytes = b">") -> bytes:
    """The flight controller's answer to a request; ``b"!"``: it does not know it."""
    body = bytes([len(payload), code]) + payload
    return b"$M" + kind + body + bytes([reduce(xor, body)])


class Recorder:
    """A transport that takes everything, or nothing, and gives what has arrived."""

    def __init__(self, *arrived: tuple[float, bytes], takes: bool = True) -> None:
        self.arrived, self.takes = list(arrived), takes
        self.sent: list[bytes] = []
        self.closed = False

    def write(self, data: bytes) -> bool:
        self.sent += [data] * self.takes
        return self.takes

    def read(self) -> Iterator[tuple[float, bytes]]:
        arrived, self.arrived = self.arrived, []
        return iter(arrived)

    def discard(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True
