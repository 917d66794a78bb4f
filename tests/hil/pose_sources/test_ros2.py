"""Poses from ROS 2, and what makes a source by its name."""

from __future__ import annotations

import math
import re
import sys
from contextlib import closing
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.pose import UdpPose
from dreamer_racing.hil.pose_sources import make_poses, ros2

HALF = math.sqrt(0.5)
LEVEL, YAW_LEFT = (0, 0, 0, 1), (0, 0, HALF, HALF)  # xyzw
TOPIC = "/vrpn_mocap/drone/pose"


class FakeRos(ModuleType):
    """As much of rclpy as is used; messages wait in ``waiting`` until they are spun."""

    def __init__(self) -> None:
        super().__init__("rclpy")
        self.calls: list[str] = []
        self.waiting: list[object] = []
        self.subscriptions: list[tuple] = []

    def init(self, *, args, signal_handler_options):
        assert (args, signal_handler_options) == ([], "no signals")
        self.calls.append("init")

    def create_node(self, name, *, start_parameter_services):
        self.calls.append("create_node")
        destroy_node = lambda: self.calls.append("destroy_node")  # noqa: E731
        return SimpleNamespace(create_subscription=self._subscribe, destroy_node=destroy_node)

    def _subscribe(self, kind, topic, callback, profile):
        self.subscriptions.append((kind, topic, callback, profile))

    def spin_once(self, node, *, timeout_sec):
        assert timeout_sec == 0  # None would wait for ever
        if self.waiting:
            self.subscriptions[0][2](self.waiting.pop(0))

    def shutdown(self):
        self.calls.append("shutdown")


def install(patch: pytest.MonkeyPatch) -> FakeRos:
    """Put the stand-in where Python finds it."""
    fake = FakeRos()
    modules = {
        "rclpy": fake,
        "rclpy.signals": SimpleNamespace(SignalHandlerOptions=SimpleNamespace(NO="no signals")),
        "rclpy.qos": SimpleNamespace(qos_profile_sensor_data="best effort"),
        "geometry_msgs": ModuleType("geometry_msgs"),
        "geometry_msgs.msg": SimpleNamespace(PoseStamped="PoseStamped"),
        "nav_msgs": ModuleType("nav_msgs"),
        "nav_msgs.msg": SimpleNamespace(Odometry="Odometry"),
    }
    for name, module in modules.items():
        patch.setitem(sys.modules, name, module)
    return fake


@pytest.fixture
def ros(monkeypatch):
    return install(monkeypatch)


def header(seconds):
    whole = math.floor(seconds)
    return SimpleNamespace(stamp=SimpleNamespace(sec=whole, nanosec=round(1e9 * (seconds - whole))))


def vector(numbers):
    return SimpleNamespace(**dict(zip("xyz", numbers, strict=True)))


def pose(position, attitude):
    return SimpleNamespace(
        position=vector(position), orientation=SimpleNamespace(**dict(zip("xyzw", attitude, strict=True)))
    )


def pose_stamped(seconds, position=(0, 0, 0), attitude=LEVEL):
    return SimpleNamespace(header=header(seconds), pose=pose(position, attitude))


def odometry(seconds, position=(0, 0, 0), attitude=LEVEL, linear=(0, 0, 0), angular=(0, 0, 0)):
    twist = SimpleNamespace(linear=vector(linear), angular=vector(angular))
    return SimpleNamespace(
        header=header(seconds), pose=SimpleNamespace(pose=pose(position, attitude)), twist=SimpleNamespace(twist=twist)
    )


def hear(ros, source, *messages):
    ros.waiting.extend(messages)
    return [received.packet for received in source.poll()]


def test_a_motion_capture(ros):
    """At 2 m/s to the left, at 10 rad/s to the left, with a clock of its own: seconds since 1970."""
    source = make_poses("ros2", topic=TOPIC, smoothing=0.0)
    assert [subscription[:2] for subscription in ros.subscriptions] == [("PoseStamped", TOPIC)]
    assert ros.subscriptions[0][3] == "best effort"
    angles = 0.05 * np.arange(3)
    messages = [
        pose_stamped(1.7e9 + 0.01 * n, (0, 0.02 * n, 1), (0, 0, math.sin(angle), math.cos(angle)))
        for n, angle in enumerate(angles)
    ]
    packets = hear(ros, source, *messages)
    assert [packet.sequence for packet in packets] == [0, 1] and source.rejected == 1
    assert packets[1].stamp == pytest.approx(1.7e9 + 0.02, abs=1e-6)
    assert packets[1].position.tolist() == [0, 0.04, 1]
    assert np.allclose(packets[1].attitude, (math.cos(0.1), 0, 0, math.sin(0.1)))
    assert np.allclose(packets[1].linear_velocity, (0, 2, 0), atol=1e-3)
    assert np.allclose(packets[1].body_rates, (0, 0, 10), atol=1e-2)


def test_odometry_has_twists_of_the_body(ros):
    """Heading left, forward is to the left."""
    source = make_poses("ros2", topic="/odom", message="Odometry")
    assert ros.subscriptions[0][0] == "Odometry"
    (packet,) = hear(ros, source, odometry(5.25, (1, 2, 3), YAW_LEFT, (4, 0, 0.5), (0.1, 0.2, 0.3)))
    assert packet.stamp == 5.25 and packet.position.tolist() == [1, 2, 3]
    assert np.allclose(packet.attitude, (HALF, 0, 0, HALF))
    assert np.allclose(packet.linear_velocity, (0, 4, 0.5))
    assert packet.body_rates.tolist() == [0.1, 0.2, 0.3]


def test_a_flood_does_not_stop_the_loop(ros):
    source = make_poses("ros2", topic="/odom", message="Odometry")
    assert len(hear(ros, source, *(odometry(0.001 * n) for n in range(1, 1001)))) == ros2.Ros2Pose._MOST
    assert len(source.poll()) == ros2.Ros2Pose._MOST
    assert ros.waiting


def test_closing_gives_everything_back_once(ros):
    source = make_poses("ros2", topic=TOPIC)
    source.close()
    source.close()
    assert ros.calls == ["init", "create_node", "destroy_node", "shutdown"]


ANY = st.one_of(st.floats(), st.floats(-1, 1), st.sampled_from([0.0, 1e308, -1e308, 5e-324]))
TIMES = st.one_of(st.integers(-(2**31), 2**31 - 1), st.floats(0, 1), st.sampled_from([0.0, 0.01, 5e-324]))


@given(
    messages=st.lists(
        st.tuples(TIMES, st.lists(ANY, min_size=9, max_size=9), st.sampled_from([None, LEVEL, (0, 0, 0, 0)])),
        max_size=8,
    )
)
@pytest.mark.parametrize("name", ["PoseStamped", "Odometry"])
def test_any_numbers_are_a_finite_pose_or_none(name, messages):
    with pytest.MonkeyPatch.context() as patch, np.errstate(over="raise", invalid="raise", divide="raise"):
        fake = install(patch)
        source = make_poses("ros2", topic=TOPIC, message=name)
        sent = []
        for seconds, numbers, attitude in messages:
            posed = seconds, numbers[:3], attitude or numbers[3:7]
            twisted = numbers[3:6], numbers[6:]
            sent.append(pose_stamped(*posed) if name == "PoseStamped" else odometry(*posed, *twisted))
        packets = hear(fake, source, *sent)
    assert len(packets) + source.rejected == len(messages)
    assert all(np.isfinite(np.concatenate(packet[2:])).all() and math.isfinite(packet.stamp) for packet in packets)


@pytest.mark.parametrize(
    ("missing", "message", "named"),
    [
        (
            "rclpy",
            "PoseStamped",
            "needs rclpy, which comes with ROS 2, not from pip: apt install ros-$ROS_DISTRO-rclpy;",
        ),
        ("geometry_msgs.msg", "PoseStamped", "needs geometry_msgs, .*apt install ros-$ROS_DISTRO-geometry-msgs;"),
        ("nav_msgs.msg", "Odometry", "needs nav_msgs, .*apt install ros-$ROS_DISTRO-nav-msgs;"),
    ],
)
def test_what_is_missing_is_named(ros, monkeypatch, missing, message, named):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match="The pose source ros2 " + named.replace("$", r"\$")):
        make_poses("ros2", topic=TOPIC, message=message)
    assert ros.calls == []


# Sources by name, and what is refused.


def test_udp_is_the_pose_packet():
    with closing(make_poses("udp", port=0)) as poses:
        assert isinstance(poses, UdpPose)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "vicon"}, "name=vicon: must be one of udp, mavlink, ros2."),
        ({"name": "udp"}, "port is not given: the pose source udp needs it."),
        ({"name": "mavlink"}, "port or device is not given: the pose source mavlink needs it."),
        ({"name": "ros2"}, "topic is not given: the pose source ros2 needs it."),
        (
            {"name": "mavlink", "port": 0, "message": "HEARTBEAT"},
            "message=HEARTBEAT: for the pose source mavlink, must be one of "
            "ODOMETRY, LOCAL_POSITION_NED, VISION_POSITION_ESTIMATE, ATT_POS_MOCAP.",
        ),
        (
            {"name": "ros2", "topic": "/pose", "message": "Imu"},
            "message=Imu: for the pose source ros2, must be one of PoseStamped, Odometry.",
        ),
    ],
)
def test_what_is_missing_or_unknown_is_named(settings, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make_poses(**settings)


def test_a_smoothing_that_is_no_time_is_refused():
    with pytest.raises(ValueError, match="smoothing=nan: must be at least 0 and at most 1"):
        make_poses("udp", port=0, smoothing=math.nan)
