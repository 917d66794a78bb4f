"""What a vehicle tells: telemetry and the IMU."""

from __future__ import annotations

import math
import socket
import struct

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.hil.imu import check_at_rest, decode_imu, encode_imu
from dreamer_racing.hil.links import LinkConfig, make_link
from dreamer_racing.hil.links.crsf import CrsfTelemetry, crc8, encode_crsf
from dreamer_racing.hil.links.link import ASK_EVERY, ChannelLink
from dreamer_racing.hil.links.mavlink import MavlinkTelemetry
from dreamer_racing.hil.links.msp import BATTERY_REQUEST, MspTelemetry, encode_msp
from dreamer_racing.hil.links.udp import PacketTelemetry, UdpLink, UdpTransport
from dreamer_racing.hil.vehicle import at_rest
from tests.hil.links.frames import RATES, THRUST, msp_answer


def crsf(payload: str, kind: int = 0x08, address: int = 0xC8) -> bytes:
    body = bytes([kind]) + bytes.fromhex(payload)
    return bytes([address, len(body) + 1]) + body + bytes([crc8(body)])


def msp(payload: str, code: int = 130, kind: bytes = b">") -> bytes:
    return msp_answer(code, bytes.fromhex(payload), kind)


CRSF_252 = crsf("00fc 00bd 000897 64")  # the examples of the wiki: 25.2 V, 18.9 A, 2199 mAh, 100 %
MSP_1523 = msp("04 dc05 98 6400 d007 00 f305")  # 4 cells, 1500 mAh, 15.2 V, 100 mAh, 20 A, no alert, 15.23 V
FRAMES = {"crsf": (CrsfTelemetry, CRSF_252, 25.2), "msp": (MspTelemetry, MSP_1523, 15.23)}


def test_frames_by_hand():
    """The CRC by long division is that of `test_udp`; the XOR: 0B^82=89, ^04=8D, ^DC^05=54, ^98=CC, ^64=A8,
    ^D0^07=7F, ^F3^05=89."""
    assert CRSF_252[:-1] == bytes.fromhex("c80a0800fc00bd00089764") and len(CRSF_252) == 12
    assert b"$M>" + bytes.fromhex("0b82 04dc0598 6400 d007 00 f305 89") == MSP_1523
    assert b"$M<" + bytes.fromhex("008282") == BATTERY_REQUEST


def test_crsf_comes_with_the_address_of_whom_it_is_for():
    for address in (0xC8, 0xEA, 0xEC, 0xEE):
        assert CrsfTelemetry().read(crsf("0094 0000 000000 32", address=address)) == [14.8]


@pytest.mark.parametrize("name", FRAMES)
def test_a_stream_may_be_cut_anywhere(name):
    make, frame, voltage = FRAMES[name]
    telemetry = make()
    heard = [value for byte in 3 * frame for value in telemetry.read(bytes([byte]))]
    assert heard == 3 * [voltage] and telemetry.rejected == 0


@pytest.mark.parametrize("name", FRAMES)
def test_after_garbage_and_half_a_frame_the_next_one_is_heard(name):
    make, frame, voltage = FRAMES[name]
    telemetry = make()
    telemetry.read(b"\x00\xff$" + frame[:-3])
    heard = telemetry.read(40 * frame)
    assert len(heard) >= 39 and set(heard) == {voltage} and 1 <= telemetry.rejected <= 8


@pytest.mark.parametrize(
    ("make", "frame"),
    [
        (CrsfTelemetry, encode_crsf((1500.0,) * 16)),  # our own, on a line with one wire
        (CrsfTelemetry, crsf("0102030405060708090a", kind=0x14)),  # link statistics
        (MspTelemetry, msp("", code=200)),  # SET_RAW_RC was taken
        (MspTelemetry, msp("01", code=110)),
    ],
)
def test_other_frames_are_passed_over(make, frame):
    telemetry = make()
    assert telemetry.read(frame) == [] and telemetry.rejected == 0


@pytest.mark.parametrize(
    ("make", "frame"),
    [
        (CrsfTelemetry, crsf("00fc")),  # too short
        (MspTelemetry, msp("04 dc05 98 6400 d007 00")),  # of a release before 4.0
        (MspTelemetry, msp("00 dc05 98 6400 d007 00 f305")),  # no battery
        (MspTelemetry, msp("", kind=b"!")),  # the flight controller does not know the question
        (CrsfTelemetry, CRSF_252[:-1] + b"\x00"),
        (MspTelemetry, MSP_1523[:-1] + b"\x00"),
    ],
)
def test_frames_that_say_no_voltage_are_counted(make, frame):
    telemetry = make()
    assert telemetry.read(frame) == [] and telemetry.rejected >= 1


@pytest.mark.parametrize("name", FRAMES)
def test_noise_and_damage(name):
    """Nothing is raised, buffers stay small, and damaged frames are counted and silent, but for 1 checksum in 256."""
    make, frame, _ = FRAMES[name]
    generator, telemetry = np.random.default_rng(0), make()
    for _ in range(2000):
        telemetry.read(generator.bytes(int(generator.integers(0, 64))))
        assert len(telemetry._frames._buffer) < 262
    assert telemetry.rejected > 0
    telemetry, heard = make(), []
    for _ in range(1000):
        damaged = bytearray(frame)
        damaged[generator.integers(3, len(frame))] ^= 1 << generator.integers(0, 8)
        heard += telemetry.read(bytes(damaged))
    assert len(heard) < 10 and telemetry.rejected >= 900


def test_msp_asks_with_the_first_command_and_every_fifth():
    link = ChannelLink(None, encode_msp, RATES, THRUST, telemetry=MspTelemetry(), request=BATTERY_REQUEST)
    asked = [link.encode(at_rest()).endswith(BATTERY_REQUEST) for _ in range(2 * ASK_EVERY)]
    assert asked == [True, *[False] * 4] * 2


class Autopilot:
    """Sends MAVLink to a link over loopback."""

    def __init__(self, listener: socket.socket) -> None:
        self.common = pytest.importorskip("pymavlink.dialects.v20.common")
        self.socket = listener
        self.link = make_link(LinkConfig("mavlink", port=listener.getsockname()[1], thrust=THRUST))
        self.link.send(at_rest())
        self.address = self.socket.recvfrom(2048)[1]

    def battery(self, *cells: int, id: int = 0, ext: tuple[int, ...] = (0, 0, 0, 0)) -> object:
        voltages = [*cells, *[65535] * (10 - len(cells))]
        return self.common.MAVLink_battery_status_message(id, 0, 0, 0, voltages, 0, 0, 0, 0, 0, 0, ext)

    def system(self, millivolts: int) -> object:
        return self.common.MAVLink_sys_status_message(0, 0, 0, 0, millivolts, 0, 0, 0, 0, 0, 0, 0, 0)

    def say(self, message: object, system: int = 1) -> list[float]:
        return self.say_bytes(message.pack(self.common.MAVLink(None, system, 1)))

    def say_bytes(self, data: bytes) -> list[float]:
        self.socket.sendto(data, self.address)
        return [reading.voltage for reading in self.link.listen()]


@pytest.fixture
def autopilot(listener):
    pilot = Autopilot(listener)
    yield pilot
    pilot.link.close()


def test_mavlink_over_loopback(autopilot):
    assert autopilot.say(autopilot.battery(3810, 3800, 3790, 3800)) == [15.2]
    assert autopilot.say(autopilot.battery(15_300)) == [15.3]  # only known as a whole
    assert autopilot.say(autopilot.battery(*[3700] * 10, ext=(3700, 3700, 0, 0))) == [pytest.approx(44.4)]
    assert autopilot.say(autopilot.system(14_900)) == [14.9]
    assert autopilot.link.rejected == 0


def test_mavlink_that_is_not_of_this_battery(autopilot):
    assert autopilot.say(autopilot.battery(15_300), system=2) == []
    assert autopilot.say(autopilot.battery(5_000, id=1)) == []
    assert autopilot.link.rejected == 0
    assert autopilot.say(autopilot.battery()) == [] and autopilot.say(autopilot.system(65535)) == []
    assert autopilot.link.rejected == 2


def test_mavlink_that_is_damaged_is_counted(autopilot):
    data = bytearray(autopilot.system(14_900).pack(autopilot.common.MAVLink(None, 1, 1)))
    data[12] ^= 1
    assert autopilot.say_bytes(bytes(data)) == [] and autopilot.link.rejected >= 1
    assert autopilot.say_bytes(b"nonsense") == []
    assert 14.9 in [autopilot.say(autopilot.system(14_900)) for _ in range(20)][-1]


def test_mavlink_noise(autopilot):
    """Nothing is raised by noise, nor by messages with damage or with noise for a payload."""
    generator = np.random.default_rng(0)
    telemetry, valid = MavlinkTelemetry(), autopilot.battery(15_300).pack(autopilot.common.MAVLink(None, 1, 1))
    heard = []
    for _ in range(3000):
        noise = generator.bytes(int(generator.integers(0, 80)))
        damaged = bytearray(valid)
        damaged[generator.integers(0, len(valid))] ^= 1 << generator.integers(0, 8)
        for data in (noise, b"\xfd" + noise, bytes(damaged)):
            heard += telemetry.read(data)
    assert len(heard) < 10 and telemetry.rejected > 1000


def test_strangers_are_not_heard(autopilot):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.1", 0))
        stranger.sendto(autopilot.system(14_900).pack(autopilot.common.MAVLink(None, 1, 1)), autopilot.address)
    assert autopilot.link.listen() == []


def test_nobody_there_is_still_counted_when_it_was_reading_that_found_out(listener):
    transport = UdpTransport(*listener.getsockname())
    listener.close()
    assert transport.write(b"one")
    assert list(transport.read()) == []
    assert not transport.write(b"two")
    transport.close()


# What flight controllers tell of their IMU: vectors by hand, one of the firmware itself, and what is none.


TURNING, FORCE = (0.5, -1.0, 2.0), (1.0, -2.0, 9.81)
"""Of a sample: rad/s and m/s², FLU."""


def raw_imu(counts: float = 512.0) -> bytes:
    """An MSP_RAW_IMU of that sample, as a Betaflight writes it."""
    force = (round(counts * each / GRAVITY) for each in FORCE)
    rates = (round(16.4 * math.degrees(each)) for each in TURNING)
    return msp_answer(102, struct.pack("<9h", *force, *rates, 0, 0, 0))


@pytest.mark.parametrize("counts", [512.0, 256.0])
def test_msp_tells_what_the_imu_tells(counts: float) -> None:
    telemetry = MspTelemetry(counts)
    data = b"noise" + raw_imu(counts)
    assert [telemetry.read(data[index : index + 1]) for index in range(len(data))] == [[]] * len(data)
    (sample,) = telemetry.imu_samples
    assert np.allclose(sample[:3], TURNING, atol=0.002)
    assert np.allclose(sample[3:], FORCE, atol=0.02)


def test_an_answer_of_the_firmware_itself() -> None:
    """A 4.6 that was built for a computer, told body rates (1, 2, 3) rad/s and a force of (-1, -2, 9.81) m/s²."""
    counts = (-26, -52, 256, 939, 1879, 2818, 0, 0, 0)
    telemetry = MspTelemetry(256.0)
    telemetry.read(msp_answer(102, struct.pack("<9h", *counts)))
    assert np.allclose(telemetry.imu_samples[0], (1.0, 2.0, 3.0, -1.0, -2.0, GRAVITY), atol=0.01)


@pytest.mark.parametrize("frame", [b"$M!\x00ff", b"$M>\x04f" + bytes(4) + b"b"], ids=["refused", "short"])
def test_msp_without_an_imu_is_rejected(frame: bytes) -> None:
    telemetry = MspTelemetry()
    assert telemetry.read(frame) == []
    assert (telemetry.imu_samples, telemetry.rejected) == ([], 1)


def test_mavlink_tells_what_the_imu_tells() -> None:
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    sender = common.MAVLink(None, 1, 1)
    (x, y, z), (along, left, up) = TURNING, FORCE
    frd = (along, -left, -up, x, -y, -z)
    highres = common.MAVLink_highres_imu_message(0, *frd, 0, 0, 0, 0, 0, 0, 0, 0)
    scaled = [round(1e3 * each / 9.80665) for each in frd[:3]] + [round(1e3 * each) for each in frd[3:]]
    telemetry = MavlinkTelemetry()
    for message in (highres, common.MAVLink_scaled_imu_message(0, *scaled, 0, 0, 0)):
        assert telemetry.read(bytes(message.pack(sender))) == []
    assert np.allclose(telemetry.imu_samples, [(*TURNING, *FORCE)] * 2, atol=0.01)
    telemetry.imu_samples.clear()
    telemetry.read(bytes(highres.pack(common.MAVLink(None, 7, 1))))
    assert telemetry.imu_samples == []


def test_a_packet_of_the_plant_and_what_is_none() -> None:
    sample = np.array((*TURNING, *FORCE))
    packet = encode_imu(3, 1.5, sample)
    decoded = decode_imu(packet)
    assert len(packet) == 68 and decoded is not None and decoded.tolist() == sample.tolist()
    for broken in (packet[:-1], encode_imu(0, 0.0, sample * 1e6)):  # those with a wrong byte are in `test_fuzz`
        assert decode_imu(broken) is None
    telemetry = PacketTelemetry()
    assert telemetry.read(packet) == telemetry.read(b"") == []
    assert (len(telemetry.imu_samples), telemetry.rejected) == (1, 1)


def test_a_link_gives_samples_once_with_their_time_of_arrival(listener: socket.socket) -> None:
    link = UdpLink(*listener.getsockname(), imu=True)
    link.send(at_rest())
    address = listener.recvfrom(100)[1]
    sample = np.array((*TURNING, *FORCE))
    for _ in range(2):
        listener.sendto(encode_imu(0, 0.0, sample), address)
    assert link.read_imu() == [], "before it has listened"
    assert link.listen() == []
    samples = link.read_imu()
    assert [reading.sample.tolist() for reading in samples] == [sample.tolist()] * 2
    assert samples[0].time <= samples[1].time
    assert link.read_imu() == []
    link.close()


@pytest.mark.parametrize("name", ["crsf", "sbus"])
def test_links_that_hear_none_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"link={name} does not return IMU samples, .*: must be one of"):
        make_link(LinkConfig(name, device="/dev/null", imu=True))


def test_what_stands_still_weighs_its_weight() -> None:
    assert check_at_rest(np.array((0.0, 0.0, 0.0, 0.5, -0.5, 9.6))) is None
    words = check_at_rest(np.array((0.0, 0.0, 0.0, 0.0, 0.0, 4.9)))
    assert words is not None and "reads 4.9 m/s² at rest" in words
