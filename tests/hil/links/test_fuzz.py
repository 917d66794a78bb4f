"""Decoders are fed a hundred thousand strings each: they never raise, and what they let through is counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from dreamer_racing.hil.links.crsf import decode_crsf, encode_crsf
from dreamer_racing.hil.links.msp import decode_msp, encode_msp
from dreamer_racing.hil.links.sbus import decode_sbus, encode_sbus
from dreamer_racing.hil.links.udp import CommandPacket, decode_command, encode_command
from dreamer_racing.hil.vehicle import Command, Setpoint

SHARE = 20_000
"""Strings of each of five kinds."""


class Codec(NamedTuple):
    """What is fed, and how many strings of noise that begin like a frame (``header``) may pass for one."""

    encode: Callable[[np.ndarray], bytes]
    decode: Callable[[bytes], Any]
    header: int
    passing: int


def encode_numbers(values: np.ndarray) -> bytes:
    command = Command(bool(values[0] > 1500), Setpoint(values[1] / 100, values[2:5] / 100))
    return encode_command(CommandPacket(int(values[5]), float(values[6]), command))


CODECS = {
    "crsf": Codec(encode_crsf, decode_crsf, 3, 120),  # 8 bits of CRC: 78 expected
    "msp": Codec(encode_msp, decode_msp, 5, 120),  # 8 bits of checksum: 78 expected
    "sbus": Codec(encode_sbus, decode_sbus, 1, 20),  # 12 bits that are always 0: 5 expected
    "udp": Codec(encode_numbers, decode_command, 4, 0),  # 32 bits of CRC
}


@pytest.fixture(params=CODECS)
def codec(request):
    return request.param, CODECS[request.param]


@pytest.fixture
def frames(codec):
    """Valid frames to be damaged, and random numbers to do it with."""
    generator = np.random.default_rng(0)
    frames = [codec[1].encode(values) for values in generator.uniform(1000, 2000, (200, 16))]
    assert all(codec[1].decode(frame) is not None for frame in frames)
    return frames, generator


def test_noise(codec, frames):
    """Of any length, and of a frame's length with a frame's header."""
    name, (_, decode, header, passing) = codec
    valid, generator = frames
    size = len(valid[0])
    noise, tails = generator.bytes(2 * SHARE * size), generator.bytes(SHARE * size)
    lengths = generator.integers(0, 2 * size, SHARE).tolist()
    starts = range(0, len(noise), 2 * size)
    assert [n for n, length in zip(starts, lengths, strict=True) if decode(noise[n : n + length]) is not None] == []

    begin = valid[0][:header]
    passed = sum(decode(begin + tails[n + header : n + size]) is not None for n in range(0, len(tails), size))
    assert passed <= passing, f"{passed} of {SHARE} strings of noise passed for {name}"


def test_truncated(codec, frames):
    _, (_, decode, _, _) = codec
    valid, generator = frames
    lengths = generator.integers(0, len(valid[0]), SHARE).tolist()
    assert all(decode(valid[n % len(valid)][:length]) is None for n, length in enumerate(lengths))


def test_one_bit_flipped(codec, frames):
    """All are found, but for those in an SBUS frame's channels and flags, which no checksum guards."""
    name, (_, decode, _, _) = codec
    valid, generator = frames
    size = len(valid[0])
    bits = generator.integers(0, 8 * size, SHARE).tolist()
    passed = set()
    for n, bit in enumerate(bits):
        damaged = int.from_bytes(valid[n % len(valid)], "little") ^ 1 << bit
        if decode(damaged.to_bytes(size, "little")) is not None:
            passed.add(bit)
    assert passed == (set(range(8, 8 * 23 + 4)) if name == "sbus" else set())


def test_replayed(codec, frames):
    """A copy says what the original said; in UDP, with the sequence number by which it is known."""
    _, (_, decode, _, _) = codec
    valid, generator = frames
    said = [plain(decode(frame)) for frame in valid]
    order = generator.integers(0, len(valid), SHARE).tolist()
    assert all(plain(decode(valid[index])) == said[index] for index in order)


def plain(decoded: Any) -> Any:
    """What a frame says, in a form that compares."""
    return encode_command(decoded) if isinstance(decoded, CommandPacket) else decoded
