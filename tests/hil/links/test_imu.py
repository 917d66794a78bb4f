"""What flight controllers tell of their IMU: vectors by hand, one of the firmware itself, and what is none."""

from __future__ import annotations

import math
import socket
import struct
from functools import reduce
from operator import xor

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.imu import PACKET_SIZE, decode_imu, encode_imu, unlike_rest
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.mavlink import MavlinkTelemetry
from dreamer_racing.hil.links.msp import MspTelemetry
from dreamer_racing.hil.links.udp import PacketTelemetry, UdpLink
from dreamer_racing.hil.vehicle import at_rest

RATES, FORCE = (0.5, -1.0, 2.0), (1.0, -2.0, 9.81)
"""Of a sample: rad/s and m/s², FLU."""


def raw_imu(counts: float = 512.0) -> bytes:
    """An MSP_RAW_IMU of that sample, as a Betaflight writes it."""
    force = (round(counts * each / GRAVITY) for each in FORCE)
    rates = (round(16.4 * math.degrees(each)) for each in RATES)
    frame = b"$M>" + bytes([18, 102]) + struct.pack("<9h", *force, *rates, 0, 0, 0)
    return frame + bytes([reduce(xor, frame[3:])])


@pytest.mark.parametrize("counts", [512.0, 256.0])
def test_msp_tells_what_the_imu_tells(counts: float) -> None:
    telemetry = MspTelemetry(counts)
    data = b"noise" + raw_imu(counts)
    assert [telemetry.read(data[index : index + 1]) for index in range(len(data))] == [[]] * len(data)
    (sample,) = telemetry.felt
    assert np.allclose(sample[:3], RATES, atol=0.002)
    assert np.allclose(sample[3:], FORCE, atol=0.02)


def test_an_answer_of_the_firmware_itself() -> None:
    """A 4.6 that was built for a computer, told body rates (1, 2, 3) rad/s and a force of (-1, -2, 9.81) m/s²."""
    counts = (-26, -52, 256, 939, 1879, 2818, 0, 0, 0)
    frame = b"$M>" + bytes([18, 102]) + struct.pack("<9h", *counts)
    telemetry = MspTelemetry(256.0)
    telemetry.read(frame + bytes([reduce(xor, frame[3:])]))
    assert np.allclose(telemetry.felt[0], (1.0, 2.0, 3.0, -1.0, -2.0, GRAVITY), atol=0.01)


@pytest.mark.parametrize("frame", [b"$M!\x00ff", b"$M>\x04f" + bytes(4) + b"b"], ids=["refused", "short"])
def test_msp_without_an_imu_is_rejected(frame: bytes) -> None:
    telemetry = MspTelemetry()
    assert telemetry.read(frame) == []
    assert (telemetry.felt, telemetry.rejected) == ([], 1)


def test_mavlink_tells_what_the_imu_tells() -> None:
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    sender = common.MAVLink(None, 1, 1)
    (x, y, z), (along, left, up) = RATES, FORCE
    frd = (along, -left, -up, x, -y, -z)
    highres = common.MAVLink_highres_imu_message(0, *frd, 0, 0, 0, 0, 0, 0, 0, 0)
    scaled = [round(1e3 * each / 9.80665) for each in frd[:3]] + [round(1e3 * each) for each in frd[3:]]
    telemetry = MavlinkTelemetry()
    for message in (highres, common.MAVLink_scaled_imu_message(0, *scaled, 0, 0, 0)):
        assert telemetry.read(bytes(message.pack(sender))) == []
    assert np.allclose(telemetry.felt, [(*RATES, *FORCE)] * 2, atol=0.01)
    telemetry.felt.clear()
    telemetry.read(bytes(highres.pack(common.MAVLink(None, 7, 1))))
    assert telemetry.felt == []


def test_a_packet_of_the_plant_and_what_is_none() -> None:
    sample = np.array((*RATES, *FORCE))
    packet = encode_imu(3, 1.5, sample)
    decoded = decode_imu(packet)
    assert len(packet) == PACKET_SIZE and decoded is not None and decoded.tolist() == sample.tolist()
    for broken in (
        packet[:-1],
        b"DRX1" + packet[4:],
        packet[:20] + b"\x01" + packet[21:],
        encode_imu(0, 0.0, sample * 1e6),
    ):
        assert decode_imu(broken) is None
    telemetry = PacketTelemetry()
    assert telemetry.read(packet) == telemetry.read(b"") == []
    assert (len(telemetry.felt), telemetry.rejected) == (1, 1)


def test_a_link_gives_samples_once_with_their_time_of_arrival() -> None:
    vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    vehicle.bind(("127.0.0.1", 0))
    vehicle.settimeout(5.0)
    link = UdpLink("127.0.0.1", vehicle.getsockname()[1], imu=True)
    link.send(at_rest())
    address = vehicle.recvfrom(100)[1]
    sample = np.array((*RATES, *FORCE))
    for _ in range(2):
        vehicle.sendto(encode_imu(0, 0.0, sample), address)
    assert link.feel() == [], "before it has listened"
    assert link.listen() == []
    felt = link.feel()
    assert [reading.sample.tolist() for reading in felt] == [sample.tolist()] * 2
    assert felt[0].time <= felt[1].time
    assert link.feel() == []
    link.close()
    vehicle.close()


@pytest.mark.parametrize("name", ["crsf", "sbus"])
def test_links_that_hear_none_are_refused(name: str) -> None:
    with pytest.raises(
        ValueError, match=f"link={name} does not bring back what the IMU tells.*: the links that do are"
    ):
        make_link(LinkConfig(name, device="/dev/null", imu=True))


def test_what_stands_still_weighs_its_weight() -> None:
    assert unlike_rest(np.array((0.0, 0.0, 0.0, 0.5, -0.5, 9.6))) is None
    words = unlike_rest(np.array((0.0, 0.0, 0.0, 0.0, 0.0, 4.9)))
    assert words is not None and "shows 4.9 m/s² where it stands" in words
