"""Sources of poses, by name.

| name | transport | message | needs |
|---|---|---|---|
| ``udp`` | UDP | the packet of `hil.pose` | port |
| ``mavlink`` | UDP, or serial port | ODOMETRY unless another is named | port or device |
| ``ros2`` | ROS 2 | PoseStamped unless Odometry is named | topic, and an installed ROS 2 |

All give poses in the frames of `Pose`, stamped by the sender's clock. Velocities that a message lacks are estimated
from successive poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from dreamer_racing.hil.inlet import Inlet, UdpInlet
from dreamer_racing.hil.links.serial_port import PROTOCOLS, SerialPort
from dreamer_racing.hil.pose import PoseSource, UdpPose
from dreamer_racing.hil.pose_sources import mavlink, ros2
from dreamer_racing.hil.pose_sources.mavlink import MavlinkPose
from dreamer_racing.hil.pose_sources.messages import SMOOTHING
from dreamer_racing.hil.pose_sources.ros2 import Ros2Pose
from dreamer_racing.settings import Range, check_choice, check_settings, given, setting


@dataclass(frozen=True)
class PoseConfig:
    """The choice of a pose source, and its settings."""

    name: str  # one of `POSE_SOURCES`
    host: str = "127.0.0.1"  # address to listen on over UDP; the default accepts poses from this machine only
    port: int | None = setting(None, Range(0, 65535))  # UDP port to listen on; 0 for a free one
    device: str | None = None  # path of a serial port; if given, `mavlink` listens to it and not to the UDP port
    baud: int | None = setting(None, Range(1))  # bits a second of the serial port; by default the protocol's
    topic: str | None = None  # topic of ROS 2
    message: str | None = None  # message type of the pose; by default the source's first one
    # s, time constant of velocities estimated from poses; 0: they are not smoothed
    smoothing: float = setting(SMOOTHING, Range(0, 1))

    def __post_init__(self) -> None:
        check_settings(self)


def make_poses(config: PoseConfig) -> PoseSource:
    """Make a pose source and open its port, device or topic.

    Raises:
        ValueError: There is no source of that name, or a setting that it needs is missing or impossible.
        OSError: Device or port cannot be used.
        ImportError: A package is missing; the message says how to get it.

    Example:
        >>> make_poses(PoseConfig("udp", port=0)).close()
    """
    check_choice("name", config.name, POSE_SOURCES)
    return POSE_SOURCES[config.name](config)


def _udp(config: PoseConfig) -> PoseSource:
    return UdpPose(given(config.port, "port", f"the pose source {config.name}"), config.host)


def _mavlink(config: PoseConfig) -> PoseSource:
    message = _message(config, mavlink.MESSAGES)
    return MavlinkPose(_inlet(config), message, config.smoothing)


def _ros2(config: PoseConfig) -> PoseSource:
    return Ros2Pose(
        given(config.topic, "topic", f"the pose source {config.name}"),
        _message(config, ros2.MESSAGES),
        config.smoothing,
    )


WITHOUT_VELOCITIES = ("VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP", "PoseStamped")
"""Messages without velocities, to which `PoseConfig.smoothing` applies."""

POSE_SOURCES: dict[str, Callable[[PoseConfig], PoseSource]] = {"udp": _udp, "mavlink": _mavlink, "ros2": _ros2}
"""Factory of each pose source, by name."""


def _message(config: PoseConfig, messages: Iterable[str]) -> str:
    """Return the configured message type; refuse one that the source does not know."""
    known = list(messages)
    message = known[0] if config.message is None else config.message
    if message not in known:
        raise ValueError(f"message={message}: for the pose source {config.name}, must be one of {', '.join(known)}.")
    return message


def _inlet(config: PoseConfig) -> Inlet:
    if config.device is None:
        return UdpInlet(given(config.port, "port or device", f"the pose source {config.name}"), config.host)
    settings = PROTOCOLS["mavlink"]
    return SerialPort(config.device, settings if config.baud is None else settings._replace(baud=config.baud))
