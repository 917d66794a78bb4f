"""Sources by name, and what is refused."""

from __future__ import annotations

import math
import re
import socket

import numpy as np
import pytest

from dreamer_racing.hil.pose import PosePacket, UdpPose, encode_pose
from dreamer_racing.hil.pose_sources import PoseConfig, make_poses


def test_udp_is_the_pose_packet():
    poses = make_poses(PoseConfig("udp", port=0))
    assert isinstance(poses, UdpPose)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(encode_pose(PosePacket(7, 1.0, np.zeros(3), level, np.zeros(3), np.zeros(3))), poses.address)
    assert [received.packet.sequence for received in poses.poll()] == [7]
    poses.close()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (PoseConfig("vicon"), "name=vicon: the pose sources are udp, mavlink, ros2."),
        (PoseConfig("udp"), "port is not given: the pose source udp needs it."),
        (PoseConfig("mavlink"), "port or device is not given: the pose source mavlink needs it."),
        (PoseConfig("ros2"), "topic is not given: the pose source ros2 needs it."),
        (
            PoseConfig("mavlink", port=0, message="HEARTBEAT"),
            "message=HEARTBEAT: the pose source mavlink knows "
            "ODOMETRY, LOCAL_POSITION_NED, VISION_POSITION_ESTIMATE, ATT_POS_MOCAP.",
        ),
        (
            PoseConfig("ros2", topic="/pose", message="Imu"),
            "message=Imu: the pose source ros2 knows PoseStamped, Odometry.",
        ),
    ],
)
def test_what_is_missing_or_unknown_is_named(config, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make_poses(config)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"port": 65536}, "port=65536: must be at least 0 and at most 65535."),
        ({"baud": 0}, "baud=0: must be at least 1."),
        ({"smoothing": -0.1}, "smoothing=-0.1: must be at least 0 and at most 1."),
        ({"smoothing": math.nan}, "smoothing=nan: must be at least 0 and at most 1."),
    ],
)
def test_numbers_out_of_range_are_named(setting, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        PoseConfig("mavlink", **setting)


@pytest.mark.parametrize("name", ["udp", "mavlink"])
def test_a_port_in_use_is_said(name):
    if name == "mavlink":
        pytest.importorskip("pymavlink")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match=rf"cannot listen on 127.0.0.1:{other.getsockname()[1]}: .*in use"):
            make_poses(PoseConfig(name, port=other.getsockname()[1]))
