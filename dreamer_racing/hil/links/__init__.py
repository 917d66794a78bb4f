"""Links to vehicles, by name; docs/hil_wiring.md has a table of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

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
from dreamer_racing.hil.links.serial_port import PROTOCOLS, SerialPort, serial_settings
from dreamer_racing.hil.links.sitl import MSP_PORT, RC_PORT, SerialOverTcp, SitlTransport, encode_sitl
from dreamer_racing.hil.links.udp import UdpLink, UdpTransport
from dreamer_racing.hil.sticks import CHANNELS, FIRST_SWITCH, RateMap, ThrustMap
from dreamer_racing.settings import Range, check_choice, check_settings, given, setting


@dataclass(frozen=True)
class LinkConfig:
    """The choice of a link, and its settings.

    Attributes:
        name: One of `LINKS`.
        host: To send to over UDP or TCP.
        port: UDP port, for ``betaflight_sitl`` 9004 unless given; for ``msp`` and ``msp_override`` without a device the
            TCP port of a firmware on this machine.
        device: A serial port.
        baud: Bits a second of the serial port; None: the protocol's default.
        rates: Body rates at full stick, of links that send channels.
        thrust: From thrust to throttle, of links that send that.
        arm_channel: Index of the channel that arms, 4 for AUX1.
        rate: Commands a second, to refuse a serial port that is too slow for them; None: not checked.
        imu: Whether to receive IMU samples.
        serial_port: For ``betaflight_sitl``: TCP port of the firmware's MSP.
    """

    name: str
    host: str = "127.0.0.1"
    port: int | None = setting(None, Range(1, 65535))
    device: str | None = None
    baud: int | None = setting(None, Range(1))
    rates: RateMap | None = None
    thrust: ThrustMap | None = None
    arm_channel: int = FIRST_SWITCH
    rate: float | None = None
    imu: bool = False
    serial_port: int = MSP_PORT

    def __post_init__(self) -> None:
        check_settings(self)
        if self.arm_channel not in range(FIRST_SWITCH, CHANNELS):
            raise ValueError(
                f"arm_channel={self.arm_channel}: must be {FIRST_SWITCH} (AUX1) to {CHANNELS - 1} (AUX12); lower ones "
                "are the sticks."
            )

    def need(self, field: str) -> Any:
        """Return a setting that the link cannot do without."""
        return given(getattr(self, field), field, f"the link {self.name}")


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
    settings, size = serial_settings(config.name, config.baud), link.longest
    most = 1.0 / settings.seconds(size)
    if config.rate > most:
        raise ValueError(
            f"baud={settings.baud}: a command of {size} bytes takes {1e3 * settings.seconds(size):.1f} ms on the wire, "
            f"so at most {most:.0f} can be sent in a second, but the actor gives {config.rate:g}: choose a higher "
            "baud= on both sides."
        )


def _udp(config: LinkConfig) -> TransportLink:
    return UdpLink(config.host, config.need("port"), config.imu)


def _betaflight_sitl(config: LinkConfig) -> TransportLink:
    rates, thrust = _maps(config)
    serial = SerialOverTcp(config.serial_port, config.host)
    transport = SitlTransport(UdpTransport(config.host, config.port or RC_PORT), serial, config.imu)
    return ChannelLink(transport, encode_sitl, rates, thrust, config.arm_channel, MspTelemetry(G_COUNTS_SITL))


def _crsf(config: LinkConfig) -> TransportLink:
    rates, thrust = _maps(config)
    return ChannelLink(_serial_port(config), encode_crsf, rates, thrust, config.arm_channel, CrsfTelemetry())


def _sbus(config: LinkConfig) -> TransportLink:
    rates, thrust = _maps(config)
    return ChannelLink(_serial_port(config), encode_sbus, rates, thrust, config.arm_channel)


def _msp(config: LinkConfig, override: bool = False) -> TransportLink:
    """Make the link to a flight controller whose only receiver is MSP, or whose receiver's sticks MSP overrides."""
    rates, thrust = _maps(config)
    simulated = config.device is None and config.port is not None
    wire = SerialOverTcp(config.need("port"), config.host) if simulated else _serial_port(config)
    telemetry = MspTelemetry(G_COUNTS_SITL if simulated else G_COUNTS, override)
    encode, request = (encode_sticks, OVERRIDE_REQUEST) if override else (encode_msp, MSP_REQUEST)
    always = IMU_REQUEST if config.imu else b""
    return ChannelLink(wire, encode, rates, thrust, config.arm_channel, telemetry, request, always)


def _mavlink(config: LinkConfig) -> TransportLink:
    thrust = config.need("thrust")
    if config.device is not None:
        return MavlinkLink(_serial_port(config), thrust)
    return MavlinkLink(UdpTransport(config.host, config.need("port")), thrust)


LINKS: dict[str, Callable[[LinkConfig], TransportLink]] = {
    "udp": _udp,
    "simulated": _udp,
    "betaflight_sitl": _betaflight_sitl,
    "crsf": _crsf,
    "sbus": _sbus,
    "msp": _msp,
    "msp_override": partial(_msp, override=True),
    "mavlink": _mavlink,
}
"""Factory of each link, by name."""

BATTERY_LINKS = ("crsf", "msp", "msp_override", "mavlink")  # links that receive the battery's voltage
IMU_LINKS = ("udp", "simulated", "betaflight_sitl", "msp", "msp_override", "mavlink")  # that can receive IMU samples


def _maps(config: LinkConfig) -> tuple[RateMap, ThrustMap]:
    return config.need("rates"), config.need("thrust")


def _serial_port(config: LinkConfig) -> Transport:
    return SerialPort(config.need("device"), serial_settings(config.name, config.baud))
