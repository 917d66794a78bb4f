"""Links to vehicles, by name.

| name | transport | sends | needs | battery from | IMU from |
|---|---|---|---|---|---|
| ``udp``, ``simulated`` | UDP | setpoints in SI units | port | | `hil.imu` |
| ``betaflight_sitl`` | UDP, and TCP for MSP | channels | rates, thrust | | RAW_IMU, requested by MSP |
| ``crsf`` | serial port | channels | device, rates, thrust | BATTERY_SENSOR | |
| ``sbus`` | serial port | channels | device, rates, thrust | | |
| ``msp`` | serial or TCP | channels | device or port, rates, thrust | BATTERY_STATE, requested | RAW_IMU |
| ``msp_override`` | likewise | the four sticks | likewise | likewise | likewise |
| ``mavlink`` | UDP or serial | rates, motor command | port or device, thrust | BATTERY_STATUS, SYS_STATUS | `mavlink` |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from dreamer_racing.hil.links.crsf import CrsfTelemetry, encode_crsf
from dreamer_racing.hil.links.link import ChannelLink, Transport, TransportLink
from dreamer_racing.hil.links.mavlink import MavlinkLink
from dreamer_racing.hil.links.msp import (
    G_COUNTS,
    G_COUNTS_SITL,
    IMU_REQUEST,
    MSP_REQUEST,
    OVERRIDE_REQUEST,
    MspTelemetry,
    encode_msp,
    encode_sticks,
)
from dreamer_racing.hil.links.sbus import encode_sbus
from dreamer_racing.hil.links.serial_port import PROTOCOLS, SerialPort, SerialSettings
from dreamer_racing.hil.links.sitl import MSP_PORT, RC_PORT, SitlTransport, encode_sitl
from dreamer_racing.hil.links.tcp import SerialOverTcp
from dreamer_racing.hil.links.telemetry import Telemetry
from dreamer_racing.hil.links.udp import UdpLink, UdpTransport
from dreamer_racing.hil.sticks import CHANNELS, FIRST_SWITCH, RateMap, ThrustMap
from dreamer_racing.settings import check_choice, given


@dataclass(frozen=True)
class LinkConfig:
    """The choice of a link, and its settings."""

    name: str  # one of `LINKS`
    host: str = "127.0.0.1"  # host to send to over UDP or TCP
    # UDP port, for `betaflight_sitl` 9004 unless given; for `msp` and `msp_override` without a device the TCP port of a
    # firmware on this machine
    port: int | None = None
    device: str | None = None  # a serial port
    baud: int | None = None  # bits a second of the serial port; by default the protocol's
    rates: RateMap | None = None
    thrust: ThrustMap | None = None
    arm_channel: int = FIRST_SWITCH  # index of the channel that arms, 4 for AUX1
    rate: float | None = None  # commands a second, to refuse a serial port that is too slow for them; None: not checked
    imu: bool = False  # whether to receive IMU samples
    serial_port: int = MSP_PORT  # for `betaflight_sitl`: TCP port of the firmware's MSP

    def __post_init__(self) -> None:
        if self.arm_channel not in range(FIRST_SWITCH, CHANNELS):
            raise ValueError(
                f"arm_channel={self.arm_channel}: must be {FIRST_SWITCH} (AUX1) to {CHANNELS - 1} (AUX12); lower ones "
                "are the sticks."
            )


def make_link(config: LinkConfig) -> TransportLink:
    """Make a link and open its transport.

    Raises:
        ValueError: There is no link of that name, a setting that it needs is missing or impossible, or a serial port is
            too slow for that many commands.
        OSError: Device or host cannot be used.
        ImportError: A package is missing; the message says how to install it.

    Example:
        >>> make_link(LinkConfig("udp", port=9100)).close()
    """
    check_choice("name", config.name, LINKS)
    if config.device is not None and config.name not in PROTOCOLS:
        raise ValueError(
            f"device={config.device} is for {', '.join(PROTOCOLS)}, but link={config.name} uses UDP: choose one of "
            "those, or leave device= out."
        )
    if config.imu and config.name not in IMU_LINKS:
        raise ValueError(
            f"link={config.name} does not return IMU samples, which the actor needs: must be one of "
            f"{', '.join(IMU_LINKS)}."
        )
    link = LINKS[config.name](config)
    try:
        _check_speed(link, config)
    except ValueError:
        link.close()
        raise
    return link


def _check_speed(link: TransportLink, config: LinkConfig) -> None:
    """Refuse a serial port so slow that commands would queue up and be dropped."""
    if config.device is None or config.rate is None:
        return
    settings = _serial_settings(config)
    size = link.longest
    most = 1.0 / settings.seconds(size)
    if config.rate > most:
        raise ValueError(
            f"baud={settings.baud}: a command of {size} bytes takes {1e3 * settings.seconds(size):.1f} ms on the wire, "
            f"so at most {most:.0f} can be sent in a second, but the actor gives {config.rate:g}: choose a higher "
            "baud= on both sides."
        )


def _udp(config: LinkConfig) -> TransportLink:
    return UdpLink(config.host, _port(config), config.imu)


def _betaflight_sitl(config: LinkConfig) -> TransportLink:
    rates, thrust = _maps(config)
    serial = SerialOverTcp(config.serial_port, config.host)
    transport = SitlTransport(_datagrams(config, RC_PORT), serial, config.imu)
    return ChannelLink(transport, encode_sitl, rates, thrust, config.arm_channel, MspTelemetry(G_COUNTS_SITL))


def _radio(
    encode: Callable[[Sequence[float]], bytes], telemetry: Callable[[], Telemetry | None] = lambda: None
) -> Callable[[LinkConfig], TransportLink]:
    """Return a factory of links that act as a radio's receiver at a serial port."""

    def make(config: LinkConfig) -> TransportLink:
        rates, thrust = _maps(config)
        return ChannelLink(_serial_port(config), encode, rates, thrust, config.arm_channel, telemetry())

    return make


def _msp(config: LinkConfig, override: bool = False) -> TransportLink:
    """Make the link to a flight controller whose only receiver is MSP, or whose receiver's sticks MSP overrides."""
    rates, thrust = _maps(config)
    simulated = config.device is None and config.port is not None
    wire = SerialOverTcp(_port(config), config.host) if simulated else _serial_port(config)
    telemetry = MspTelemetry(G_COUNTS_SITL if simulated else G_COUNTS, override)
    encode, request = (encode_sticks, OVERRIDE_REQUEST) if override else (encode_msp, MSP_REQUEST)
    always = IMU_REQUEST if config.imu else b""
    return ChannelLink(wire, encode, rates, thrust, config.arm_channel, telemetry, request, always)


def _mavlink(config: LinkConfig) -> TransportLink:
    thrust = given(config.thrust, "thrust", f"the link {config.name}")
    return MavlinkLink(_serial_port(config) if config.device is not None else _datagrams(config), thrust)


LINKS: dict[str, Callable[[LinkConfig], TransportLink]] = {
    "udp": _udp,
    "simulated": _udp,
    "betaflight_sitl": _betaflight_sitl,
    "crsf": _radio(encode_crsf, CrsfTelemetry),
    "sbus": _radio(encode_sbus),
    "msp": _msp,
    "msp_override": partial(_msp, override=True),
    "mavlink": _mavlink,
}
"""Factory of each link, by name."""

BATTERY_LINKS = ("crsf", "msp", "msp_override", "mavlink")
"""Links that receive the battery's voltage."""

IMU_LINKS = ("udp", "simulated", "betaflight_sitl", "msp", "msp_override", "mavlink")
"""Links that can receive IMU samples."""


def _maps(config: LinkConfig) -> tuple[RateMap, ThrustMap]:
    return given(config.rates, "rates", f"the link {config.name}"), given(
        config.thrust, "thrust", f"the link {config.name}"
    )


def _port(config: LinkConfig, default: int | None = None) -> int:
    port = given(default if config.port is None else config.port, "port", f"the link {config.name}")
    if not 1 <= port <= 65535:
        raise ValueError(f"port={port}: must be at least 1 and at most 65535.")
    return port


def _datagrams(config: LinkConfig, default_port: int | None = None) -> Transport:
    return UdpTransport(config.host, _port(config, default_port))


def _serial_port(config: LinkConfig) -> Transport:
    return SerialPort(given(config.device, "device", f"the link {config.name}"), _serial_settings(config))


def _serial_settings(config: LinkConfig) -> SerialSettings:
    settings = PROTOCOLS[config.name]
    return settings if config.baud is None else settings._replace(baud=config.baud)
