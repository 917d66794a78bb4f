"""Poses from an autopilot (PX4, ArduPilot) or a motion-capture system that speaks MAVLink.

| message | attitude | velocity | body rates |
|---|---|---|---|
| ``ODOMETRY`` | included | included: body FRD, or the frame of the position | included |
| ``LOCAL_POSITION_NED`` | the newest ``ATTITUDE_QUATERNION`` | included | of the attitude's message |
| ``VISION_POSITION_ESTIMATE`` | included, as angles | estimated from poses | estimated from poses |
| ``ATT_POS_MOCAP`` | included | estimated from poses | estimated from poses |

MAVLink's world is NED (x north, y east, z down), or FRD (x where forward was at the start, y to its right, z down); its
body is FRD (x forward, y right, z down). Our world has the same x and its z up: a track's x axis points north, its y
axis west. MAVLink's world and ours, its body and ours, differ by half a turn about x, so that

- a vector (x, y, z) becomes (x, −y, −z), be it a position, a velocity, or body rates;
- an attitude (w, x, y, z), FRD → NED, becomes (w, x, −y, −z), FLU → z up: the axis of a rotation is a vector.

The message type is a setting, because an autopilot may send several, each with its own delay and origin. The port is
for one vehicle: senders are not checked. Timestamps are those of the messages, mostly since the autopilot's start.

Reference: mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from dreamer_racing.hil.attitude import turn
from dreamer_racing.hil.inlet import Inlet
from dreamer_racing.hil.links.mavlink import import_messages
from dreamer_racing.hil.pose import PosePacket, make_packet, plausible
from dreamer_racing.hil.pose_sources.messages import SMOOTHING, Measurement, MessagePose

LOCAL_NED, BODY_FRD, LOCAL_FRD = 1, 12, 20  # values of MAV_FRAME

PAIR_WITHIN = 0.05
"""s between a position and an attitude up to which they form a pose [choice]: autopilots send both at 20 Hz or more."""

_LEVEL = np.array((1.0, 0.0, 0.0, 0.0))


class MavlinkPose(MessagePose):
    """Reads poses from MAVLink messages, of version 1 or 2, by an inlet that is closed with it.

    Messages of other types than the chosen one of `MESSAGES` are ignored and not counted.

    Raises:
        ImportError: pymavlink is not installed.
    """

    def __init__(self, inlet: Inlet, message: str = "ODOMETRY", smoothing: float = SMOOTHING) -> None:
        super().__init__(smoothing)
        self._common = import_messages("The pose source mavlink")
        self._inlet, self._wanted = inlet, message
        self._read = MESSAGES[message]
        self._parser = self._make_parser()
        self._attitude: PosePacket | None = None  # the newest ATTITUDE_QUATERNION

    def listen(self) -> Iterator[tuple[float, Measurement | None]]:
        """Yield the wanted messages, and None for damaged data."""
        for arrival, data in self._inlet.read():
            for message in self._parse(data):
                kind = "BAD_DATA" if message is None else message.get_type()
                if kind == "ATTITUDE_QUATERNION":
                    self._attitude = _read_attitude(message)
                elif kind == self._wanted:
                    yield arrival, self._read(message, self._attitude)
                elif kind == "BAD_DATA":
                    yield arrival, None

    def close(self) -> None:
        """Close the inlet."""
        self._inlet.close()

    def _parse(self, data: bytes) -> list[Any]:
        """Return the messages in a chunk of bytes, and None for a datagram that ends within one, or holds none."""
        if not self._inlet.whole:
            return self._parser.parse_buffer(data) or []
        parser = self._make_parser()  # an incomplete datagram must not swallow the next one
        messages = parser.parse_buffer(data) or []
        return [*messages, None] if parser.buf_len() or not messages else messages

    def _make_parser(self) -> Any:
        parser = self._common.MAVLink(None)
        parser.robust_parsing = True  # damaged messages come out as BAD_DATA
        return parser


def _read_odometry(message: Any, attitude: PosePacket | None) -> Measurement | None:
    known = message.frame_id in (LOCAL_NED, LOCAL_FRD) and message.child_frame_id in (BODY_FRD, message.frame_id)
    if not known or message.quality < 0:  # below 0: the estimator has failed
        return None
    return Measurement(
        1e-6 * message.time_usec,
        _half_turn(message.x, message.y, message.z),
        _half_turn_of_attitude(message.q),
        _half_turn(message.vx, message.vy, message.vz),
        _half_turn(message.rollspeed, message.pitchspeed, message.yawspeed),
        in_body=message.child_frame_id == BODY_FRD,
    )


def _read_position(message: Any, attitude: PosePacket | None) -> Measurement | None:
    """Return the position with the newest attitude, which is extrapolated to the time of the position."""
    stamp = 1e-3 * message.time_boot_ms
    if attitude is None or abs(stamp - attitude.stamp) > PAIR_WITHIN:
        return None
    return Measurement(
        stamp,
        _half_turn(message.x, message.y, message.z),
        turn(attitude.attitude, (stamp - attitude.stamp) * attitude.body_rates),
        _half_turn(message.vx, message.vy, message.vz),
        attitude.body_rates,
    )


def _read_vision(message: Any, attitude: PosePacket | None) -> Measurement | None:
    angles = _half_turn(message.roll, message.pitch, message.yaw)
    if not plausible(angles):
        return None
    seen = _LEVEL
    for axis in (2, 1, 0):  # first yaw, then pitch about the new y axis, then roll about the new x axis
        seen = turn(seen, angles * (np.arange(3) == axis))
    return Measurement(1e-6 * message.usec, _half_turn(message.x, message.y, message.z), seen)


def _read_mocap(message: Any, attitude: PosePacket | None) -> Measurement | None:
    position = _half_turn(message.x, message.y, message.z)
    return Measurement(1e-6 * message.time_usec, position, _half_turn_of_attitude(message.q))


MESSAGES: dict[str, Callable[[Any, PosePacket | None], Measurement | None]] = {
    "ODOMETRY": _read_odometry,
    "LOCAL_POSITION_NED": _read_position,
    "VISION_POSITION_ESTIMATE": _read_vision,
    "ATT_POS_MOCAP": _read_mocap,
}
"""Reader of each message type, which gets the message and the newest separate attitude."""


def _read_attitude(message: Any) -> PosePacket | None:
    """Return attitude and body rates of an ATTITUDE_QUATERNION; None if they are implausible."""
    attitude = _half_turn_of_attitude((message.q1, message.q2, message.q3, message.q4))
    rates = _half_turn(message.rollspeed, message.pitchspeed, message.yawspeed)
    if not plausible(attitude, rates):
        return None
    return make_packet(0, 1e-3 * message.time_boot_ms, np.zeros(3), attitude, np.zeros(3), rates)


def _half_turn(x: float, y: float, z: float) -> np.ndarray:
    """Convert a vector from NED or FRD to our world or body frame."""
    return np.array((x, -y, -z))


def _half_turn_of_attitude(attitude: Sequence[float]) -> np.ndarray:
    """Convert an attitude (4,) wxyz from FRD → NED to FLU → z up."""
    w, x, y, z = attitude
    return np.array((w, x, -y, -z))
