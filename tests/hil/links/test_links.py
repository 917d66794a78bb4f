"""Links by name: each is made and heard, and what is missing is named."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

from dreamer_racing.hil.links import LINKS, LinkConfig, make_link
from dreamer_racing.hil.links.udp import decode_command
from dreamer_racing.hil.sticks import RateMap, ThrustMap
from dreamer_racing.hil.vehicle import at_rest

RATES = RateMap(roll=10.0, pitch=10.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)


@pytest.fixture
def listener():
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listening.bind(("127.0.0.1", 0))
    listening.settimeout(5.0)
    yield listening
    listening.close()


def hears_command(data):
    return decode_command(data).command.armed is False


def hears_mavlink(data):
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    return len(common.MAVLink(None).parse_buffer(data)) == 1


@pytest.mark.parametrize(
    ("name", "hears"),
    [
        ("udp", hears_command),
        ("simulated", hears_command),
        ("mavlink", hears_mavlink),
    ],
)
def test_links_over_udp(listener, name, hears):
    link = make_link(LinkConfig(name, port=listener.getsockname()[1], rates=RATES, thrust=THRUST))
    sent = link.send(at_rest())
    assert listener.recv(200) == sent and hears(sent)
    link.close()


def test_ports_of_the_firmware(monkeypatch):
    opened = []
    monkeypatch.setattr("dreamer_racing.hil.links.UdpTransport", lambda *address: opened.append(address))
    monkeypatch.setattr("dreamer_racing.hil.links.SerialOverTcp", lambda *address: opened.append(address))
    make_link(LinkConfig("betaflight_sitl", rates=RATES, thrust=THRUST))
    assert opened == [(5761, "127.0.0.1"), ("127.0.0.1", 9004)]


def test_the_arm_channel_is_the_one_chosen():
    link = make_link(LinkConfig("betaflight_sitl", rates=RATES, thrust=THRUST, arm_channel=7))
    sent = link.encode(at_rest()._replace(armed=True))
    assert [int.from_bytes(sent[8 + 2 * n : 10 + 2 * n], "little") for n in (4, 7)] == [1000, 2000]
    link.close()


def test_unknown_links():
    with pytest.raises(ValueError, match=f"name=carrier_pigeon: the links are {', '.join(LINKS)}"):
        make_link(LinkConfig("carrier_pigeon"))


@pytest.mark.parametrize(
    ("config", "field"),
    [
        (LinkConfig("udp"), "port"),
        (LinkConfig("mavlink", thrust=THRUST), "port"),
        (LinkConfig("mavlink", port=14540), "thrust"),
        (LinkConfig("betaflight_sitl", thrust=THRUST), "rates"),
        (LinkConfig("betaflight_sitl", rates=RATES), "thrust"),
        *[(LinkConfig(name, rates=RATES, thrust=THRUST), "device") for name in ("crsf", "sbus", "msp", "msp_override")],
        *[
            (LinkConfig(name, device="/dev/ttyUSB0", thrust=THRUST), "rates")
            for name in ("crsf", "sbus", "msp", "msp_override")
        ],
    ],
)
def test_what_is_missing_is_named(config, field):
    with pytest.raises(ValueError, match=f"{field} is not given: the link {config.name} needs it"):
        make_link(config)


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_ports_that_are_none(port):
    with pytest.raises(ValueError, match=f"port={port}: must be at least 1 and at most 65535"):
        make_link(LinkConfig("udp", port=port))


def test_a_stick_arms_nothing():
    with pytest.raises(ValueError, match="arm_channel=2"):
        LinkConfig("crsf", arm_channel=2)


def test_without_pymavlink(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(ImportError, match=r"pip install .*\[hil\]'"):
        make_link(LinkConfig("mavlink", port=14540, thrust=THRUST))


def test_what_flies_needs_neither_torch_nor_the_packages_of_other_links():
    program = (
        "import sys, dreamer_racing.hil.links as links; links.make_link(links.LinkConfig('udp', port=9100)).close(); "
        "print([name for name in ('torch', 'serial', 'pymavlink') if name in sys.modules])"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"
