"""Poses from a ROS 2 topic.

| message | velocity | body rates |
|---|---|---|
| ``PoseStamped`` (geometry_msgs), as ``/vrpn_mocap/<name>/pose`` | estimated from poses | estimated from poses |
| ``Odometry`` (nav_msgs) | included, body frame | included |

ROS's world is z up, its body FLU, as ours are (REP 103), but quaternions are xyzw. Twists are in the child frame, which
is taken to be the body; the message's own frame is taken to be the world. Timestamps are those of the headers.

A message's arrival time is when the loop reads it, up to a tick late: ``stamping=sender`` is more exact.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dreamer_racing.hil.pose_sources.messages import SMOOTHING, Measurement, MessagePose

NODE = "dreamer_racing_poses"


class Ros2Pose(MessagePose):
    """Subscribes to a topic with its own node.

    Raises:
        ImportError: rclpy or the messages' package is missing; the message says how to get it.
    """

    _MOST = 256  # messages read per call, so that a flood cannot stall the loop

    def __init__(self, topic: str, message: str = "PoseStamped", smoothing: float = SMOOTHING) -> None:
        super().__init__(smoothing)
        package, self._read = MESSAGES[message]
        self._rclpy, signals, qos, messages = map(_import, ("rclpy", "rclpy.signals", "rclpy.qos", package))
        self._heard: list[tuple[float, Any]] = []
        # The flight loop handles signals: Ctrl-C must disarm, not merely end ROS.
        self._rclpy.init(args=[], signal_handler_options=signals.SignalHandlerOptions.NO)
        self._node = self._rclpy.create_node(NODE, start_parameter_services=False)
        # Best effort: motion-capture systems publish so, and a lost pose sent again would be too late.
        self._node.create_subscription(getattr(messages, message), topic, self._hear, qos.qos_profile_sensor_data)

    def listen(self) -> Iterator[tuple[float, Measurement | None]]:
        """Yield the messages that have arrived."""
        for _ in range(self._MOST):
            before = len(self._heard)
            self._rclpy.spin_once(self._node, timeout_sec=0)
            if len(self._heard) == before:
                break
        heard, self._heard = self._heard, []
        for arrival, message in heard:
            yield arrival, self._read(message)

    def close(self) -> None:
        """Destroy the node."""
        if self._node is not None:
            self._node.destroy_node()
            self._rclpy.shutdown()
            self._node = None

    def _hear(self, message: Any) -> None:
        self._heard.append((time.monotonic(), message))


def _read_pose(message: Any) -> Measurement:
    return Measurement(_stamp(message), _vector(message.pose.position), _attitude(message.pose.orientation))


def _read_odometry(message: Any) -> Measurement:
    pose, twist = message.pose.pose, message.twist.twist
    return Measurement(
        _stamp(message),
        _vector(pose.position),
        _attitude(pose.orientation),
        _vector(twist.linear),
        _vector(twist.angular),
        in_body=True,
    )


MESSAGES: dict[str, tuple[str, Callable[[Any], Measurement]]] = {
    "PoseStamped": ("geometry_msgs.msg", _read_pose),
    "Odometry": ("nav_msgs.msg", _read_odometry),
}
"""Module and reader of each type of message, by its name."""


def _stamp(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _vector(vector: Any) -> np.ndarray:
    return np.array((vector.x, vector.y, vector.z), float)


def _attitude(quaternion: Any) -> np.ndarray:
    return np.array((quaternion.w, quaternion.x, quaternion.y, quaternion.z), float)


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise ImportError(
            f"The pose source ros2 needs {package}, which comes with ROS 2, not from pip: apt install "
            f"ros-$ROS_DISTRO-{package.replace('_', '-')}; source /opt/ros/$ROS_DISTRO/setup.bash in this terminal; "
            f"and use the Python that this ROS is built for ({error})."
        ) from error
