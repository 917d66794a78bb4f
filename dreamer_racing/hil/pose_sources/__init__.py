"""Sources of poses, by name; docs/hil_wiring.md has a table of them.

All give poses in the frames of `Pose`, stamped by the sender's clock. Velocities that a message lacks are estimated
from successive poses.
"""

from __future__ import annotations

from dreamer_racing.hil.inlet import UdpInlet
from dreamer_racing.hil.links.serial_port import SerialPort, serial_settings
from dreamer_racing.hil.pose import PoseSource, UdpPose
from dreamer_racing.hil.pose_sources import mavlink, ros2
from dreamer_racing.hil.pose_sources.messages import SMOOTHING
from dreamer_racing.settings import Range, check_choice, check_setting, given

POSE_SOURCES = {"udp": (), "mavlink": tuple(mavlink.MESSAGES), "ros2": tuple(ros2.MESSAGES)}
"""Types of messages that each source reads; the first one is its default."""

WITHOUT_VELOCITIES = ("VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP", "PoseStamped")
"""Messages without velocities, to which ``smoothing`` applies."""


def make_poses(
    name: str,
    host: str = "127.0.0.1",
    port: int | None = None,
    device: str | None = None,
    baud: int | None = None,
    topic: str | None = None,
    message: str | None = None,
    smoothing: float = SMOOTHING,
) -> PoseSource:
    """Make a pose source and open its port, device or topic.

    Args:
        name: One of `POSE_SOURCES`.
        host: Address to listen on over UDP; the default accepts poses from this machine only.
        port: UDP port to listen on; 0 for a free one.
        device: Path of a serial port; if given, ``mavlink`` listens to it and not to the UDP port.
        baud: Bits a second of the serial port; None: the protocol's default.
        topic: Topic of ROS 2.
        message: Message type of the pose; None: the source's first one.
        smoothing: s, time constant of velocities estimated from poses; 0: they are not smoothed.

    Raises:
        ValueError: There is no source of that name, or a setting that it needs is missing or impossible.
        OSError: Device or port cannot be used.
        ImportError: A package is missing; the message says how to get it.

    Example:
        >>> make_poses("udp", port=0).close()
    """
    check_choice("name", name, POSE_SOURCES)
    check_setting("smoothing", smoothing, Range(0, 1))
    if baud is not None:
        check_setting("baud", baud, Range(1), whole=True)
    user, known = f"the pose source {name}", POSE_SOURCES[name]
    if name == "udp":
        return UdpPose(given(port, "port", user), host)
    message = message or known[0]
    if message not in known:
        raise ValueError(f"message={message}: for {user}, must be one of {', '.join(known)}.")
    if name == "ros2":
        return ros2.Ros2Pose(given(topic, "topic", user), message, smoothing)
    if device is not None:
        return mavlink.MavlinkPose(SerialPort(device, serial_settings("mavlink", baud)), message, smoothing)
    return mavlink.MavlinkPose(UdpInlet(given(port, "port or device", user), host), message, smoothing)
