"""Reports on flights whose numbers are known: latencies, gates, laps and lags that were put into them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from dreamer_racing.envs.tracks import describe_track, load_track
from dreamer_racing.evaluation.trajectory import write_trajectory
from dreamer_racing.figures.hil import LATENCY, REPORT, TRACKING, TRAJECTORY, trajectory_of, write_report
from dreamer_racing.figures.hil_numbers import Response, read_flown, tracking_error
from dreamer_racing.hil import recording
from dreamer_racing.hil.chain import ChainConfig, FlightChain, Inputs, describe_inputs, describe_outputs
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received
from dreamer_racing.hil.recording import FILE, TRACK, Flight, FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint
from tests.flights import level_flight

CIRCLE = load_track("circle")  # gates of 4 m from the middle, at 0, 90, 180 and 270 degrees, flown anticlockwise
RADIUS, SPIN, ANGLE = 4.2, 2.0, -0.5  # m, rad/s, rad at the start
BEGAN, ENABLED, OFF = 100.0, 100.3, 101.0  # s: first tick, enable given, and when it flies off
PERIOD, SENT, AGE, WIRE, LAG = 0.02, 0.004, 0.005, 0.003, 0.06  # s
ACCUSTOMED = {"start_box": 0.6, "start_yaw_tolerance_degrees": 45.0}


ABOUT = {"track": "circle", TRACK: describe_track(CIRCLE)}


def gate_time(number: int) -> float:
    """When it passes its gate of that number, counted on over laps, from 0."""
    return OFF + (0.5 * math.pi * number - ANGLE) / SPIN


class Wobble(Flyer):
    """Asks for a constant thrust, and for a roll rate that swings."""

    rate = 1.0 / PERIOD
    camera = None

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        return Setpoint(12.0, np.array([3.0 * math.sin(9.0 * pose.time), math.cos(7.0 * pose.time), 0.0]))


@dataclass
class Flown:
    """Flies a circle through the chain: what the vehicle does is known, and its rates follow commands with a lag.

    The newest pose of each tick was measured `AGE` before it; `WIRE` of this it was under way.
    """

    folder: Path
    laps: int | None = 2
    arm: bool = True
    stamping: Stamping = Stamping.receive
    offset: float = 0.0  # s, of the sender's clock
    kill_at: float = math.inf
    about: dict[str, Any] = field(default_factory=lambda: ABOUT)
    sent: list[tuple[float, np.ndarray]] = field(default_factory=list)

    def fly(self, ticks: int = 600) -> Path:
        limits = SafetyLimits.of_track(CIRCLE, **ACCUSTOMED)
        config = ChainConfig(limits, self.stamping, WIRE, self.laps, self.arm, lift=0.0)  # it flies off by itself
        chain = FlightChain(Wobble(), CIRCLE, config)
        settings = {"actor": "wobble", "track": None, "stamping": self.stamping.value, "latency": WIRE}
        about = {"config": settings, "rate": 1.0 / PERIOD, "contract": {"camera": {"width_px": 64}}, **self.about}
        random = np.random.default_rng(0)
        with patch.object(recording, "WAITING_MOST", ticks + 1):  # it flies faster than a disk may write
            recorder = FlightRecorder(self.folder / FILE, about)
        with recorder:
            flew = False
            for index in range(ticks):
                now = BEGAN + PERIOD * index
                times = now - AGE - np.append(0.005 * np.arange(3, 0, -1) + random.uniform(-0.0025, 0.0025, 3), 0.0)
                received = [self._received(4 * index + number, time) for number, time in enumerate(times)]
                operator = Operator(now >= ENABLED - 1e-6, now >= self.kill_at)
                inputs = Inputs(now, received, operator, index in (40, 100))
                outputs = chain.tick(inputs)
                command = outputs.verdict.command
                took = {"jitter": 0.0005, "render": 0.001, "act": 0.002, "sent": 0.009 if index == 50 else SENT}
                message = {"in": describe_inputs(inputs), "out": describe_outputs(outputs), "took": took, "bytes": b""}
                recorder.tick(now, message)
                self.sent.append((now + took["sent"], command.setpoint.body_rates))
                flew = flew or command.armed
                if flew and not command.armed:
                    break
        return self.folder

    def _received(self, sequence: int, time: float) -> Received:
        turned = ANGLE + SPIN * max(time - OFF, 0.0)
        out = np.array([math.cos(turned), math.sin(turned), 0.0])
        along = np.array([-math.sin(turned), math.cos(turned), 0.0])
        half = 0.5 * (turned + 0.5 * math.pi)
        rates = next((rates for when, rates in reversed(self.sent) if when <= time - LAG), np.zeros(3))
        packet = PosePacket(
            sequence,
            time + self.offset,
            RADIUS * out + (0.0, 0.0, 1.35),
            np.array([math.cos(half), 0.0, 0.0, math.sin(half)]),
            RADIUS * SPIN * along * (time > OFF),
            rates + np.array([0.0, 0.5, 0.1]),
        )
        return Received(time + WIRE, packet)


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Path:
    return Flown(tmp_path_factory.mktemp("flight")).fly()


def draw_nothing(patch: pytest.MonkeyPatch) -> None:
    """Make figures, but do not draw them: that takes most of a report's time."""
    patch.setattr(Figure, "savefig", lambda self, path, **_: Path(path).touch())


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that look at no figure."""
    draw_nothing(monkeypatch)


def reported(folder: Path) -> dict[str, Any]:
    """What the report on a flight in a folder says."""
    return json.loads((folder / REPORT).read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def report(flown) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        write_report(flown)
    return reported(flown)


def test_a_report_is_of_the_track_that_was_flown(tmp_path, unseen):
    """Its name is that of another now."""
    write_report(Flown(tmp_path, about={"track": "kidney", TRACK: describe_track(CIRCLE)}).fly())
    report = reported(tmp_path)
    assert report["track"] == "circle" and len(report["gates"]) == 8 and report["problems"] == []


def test_a_track_that_is_damaged_in_the_recording_is_refused(tmp_path):
    Flown(tmp_path, about={"track": "circle", TRACK: {"gates": [1, 2]}}).fly()
    with pytest.raises(ValueError, match=r"flight.mcap: track_as_flown: gates\[0\] is 1, but must be a mapping"):
        write_report(tmp_path)


# --- numbers ---


def test_latencies_are_those_put_in(report):
    stages = report["latency"]["stages"]
    constant = {"jitter": 0.0005, "render": 0.001, "act": 0.002, "pose_age": AGE, "interval": PERIOD}
    for name, seconds in constant.items():
        assert list(stages[name].values()) == pytest.approx(3 * [1e3 * seconds], abs=1e-6), name
    assert (stages["sent"]["p50_ms"], stages["sent"]["max_ms"]) == pytest.approx((4.0, 9.0))
    assert (stages["end_to_end"]["p50_ms"], stages["end_to_end"]["max_ms"]) == pytest.approx((9.0, 14.0))
    assert report["latency"]["missed_deadlines"] == 2
    assert report["latency"]["of"] == "armed ticks"


@pytest.mark.parametrize("offset", [-5e4, 7e8])
def test_the_age_of_poses_stamped_by_their_sender(tmp_path, offset, unseen):
    write_report(Flown(tmp_path, stamping=Stamping.sender, offset=offset).fly(60))
    stages = reported(tmp_path)["latency"]["stages"]
    assert list(stages["pose_age"].values()) == pytest.approx(3 * [1e3 * AGE], abs=1e-3)


def test_gates_and_laps_are_those_flown(report):
    assert [gate["number"] for gate in report["gates"]] == [1, 2, 3, 4] * 2
    times = [gate["time_s"] for gate in report["gates"]]
    assert times == pytest.approx([gate_time(number) - ENABLED for number in range(8)], abs=1e-4)
    assert [gate["offset_m"] for gate in report["gates"]] == pytest.approx(8 * [RADIUS - 4.0], abs=1e-3)
    lap = 2 * math.pi / SPIN
    assert report["laps_s"]["flying"] == pytest.approx([lap], abs=1e-4)
    assert report["laps_s"]["race"] == pytest.approx([gate_time(3) - ENABLED, lap], abs=1e-4)
    assert report["ended"] == "finished" and report["problems"] == []


def test_the_summary_of_a_flight(report):
    assert (report["actor"], report["track"], report["rate_hz"]) == ("wobble", "circle", 50.0)
    assert report["armed_s"] == pytest.approx(gate_time(7) - ENABLED, abs=PERIOD)
    flown, speed = report["flown"], RADIUS * SPIN
    assert flown["gates"] == 8 and flown["speed_max"] == pytest.approx(speed, rel=1e-4)
    assert flown["distance_m"] == pytest.approx(speed * (gate_time(7) - OFF), abs=speed * PERIOD)


def test_rates_follow_with_the_lag_put_in(report):
    tracking = report["tracking"]
    roll, pitch, yaw = (tracking[f"body_rate_{axis}"] for axis in "xyz")
    assert roll["lag_ms"] == pytest.approx(1e3 * LAG, abs=1.5)
    assert roll["rms"] < 0.02 < 0.5 < roll["rms_without_lag"]
    assert pitch["lag_ms"] == pytest.approx(1e3 * LAG, abs=1.5) and pitch["rms"] == pytest.approx(0.5, abs=0.01)
    assert yaw == {"lag_ms": None, "rms": pytest.approx(0.1), "rms_without_lag": pytest.approx(0.1)}


def test_thrust_is_measured_from_velocities(report):
    """Level and at one height, so that it carries its weight whatever it was asked for."""
    error = report["tracking"]["collective_thrust"]
    assert error["lag_ms"] is None and error["rms"] == pytest.approx(12.0 - GRAVITY, abs=1e-6)


@pytest.mark.parametrize("lag", [0.0, 0.25])
def test_a_known_lag_is_found(lag):
    asked_time = np.arange(0.0, 5.0, 0.02)
    asked = np.random.default_rng(1).normal(size=len(asked_time))
    time = np.sort(np.random.default_rng(2).uniform(0.3, 4.9, 1500))
    held = asked[np.searchsorted(asked_time, time - lag, side="right") - 1]
    error = tracking_error(Response(asked_time, asked, time, held + 0.2))
    assert error["lag_ms"] == pytest.approx(1e3 * lag, abs=1.0) and error["rms"] == pytest.approx(0.2, abs=0.05)


def test_too_few_measurements_give_no_error():
    asked_time = np.arange(0.0, 1.0, 0.02)
    response = Response(asked_time, asked_time, np.linspace(0.0, 0.4, 40), np.zeros(40))
    assert tracking_error(response) is None
    assert tracking_error(response._replace(time=np.empty(0), measured=np.empty(0))) is None


# --- figures ---


def test_the_flight_beside_a_simulated_one(tmp_path, flown, figures):
    position = torch.stack((torch.linspace(-2.0, 2.0, 51), torch.zeros(51), torch.ones(51)), dim=1)
    velocity = torch.tensor([4.0, 0, 0]).expand(51, 3)
    simulated = level_flight(position, linear_velocity=velocity, outcome="timeout")
    write_trajectory(tmp_path / "straight.csv", simulated, "circle")
    lines = write_report(flown, tmp_path / "straight.csv")
    latency, beside, tracking = figures
    titles = [axes.get_title(loc="left") for axes in beside.axes[0:6:3]]
    assert titles[0] == "flown\ncircle: 8 gates in 6.46 s (finished)"
    assert titles[1] == "simulated (straight)\ncircle: 0 gates in 1.00 s (timeout)"
    ticks = reported(flown)["latency"]["ticks"]
    assert latency.axes[0].get_xlabel() == f"ms, of armed ticks (n = {ticks})" and ticks > 300
    assert latency.axes[0].get_xlim() == pytest.approx((0.1, 100.0))  # jitter of 0.5 ms, a period of 20
    assert [label.get_text() for label in latency.axes[0].get_yticklabels()][-1] == "end to end"
    assert tracking.axes[0].get_ylabel() == "thrust (m/s²)"
    assert tracking.axes[-1].get_xlabel().startswith("time since arming (s)")
    assert "against: up to 4.0 m/s, 4.0 on average, 0 gates in 1.00 s" in lines
    assert reported(flown)["against"]["distance_m"] == pytest.approx(4.0)
    for name in (LATENCY, TRAJECTORY, TRACKING):
        with Image.open(flown / name) as image:
            assert image.width > 700


def test_two_flights_beside_each_other(tmp_path, flown, figures):
    other = Flown(tmp_path / "other", kill_at=OFF + 1.0).fly()
    lines = write_report(other, flown)
    assert "ended: cut: kill" in lines[0] and any(line.startswith("against: up to 8.4 m/s") for line in lines)
    titles = [axes.get_title(loc="left").split("\n")[0] for axes in figures[1].axes[0:6:3]]
    assert titles == ["flown", f"other flight ({flown.name})"]


def test_a_trajectory_has_the_poses_that_the_flyer_chose_by(flown):
    flight = read_flown(flown)
    trajectory = trajectory_of(flight)
    assert trajectory.control_dt == pytest.approx(PERIOD) and len(trajectory.action) == len(trajectory.position) - 1
    moving = torch.nonzero(trajectory.speed > 1.0).flatten()
    radius = trajectory.position[moving, :2].norm(dim=1)
    assert radius.numpy() == pytest.approx(math.hypot(RADIUS, RADIUS * SPIN * AGE), rel=1e-4)  # straight on for 5 ms
    assert trajectory.target_gate.tolist()[0] == 0 and trajectory.outcome == "finished"


# --- flights that are none, or half of one ---


def test_a_flight_that_was_never_armed(tmp_path):
    for name in (TRAJECTORY, TRACKING):
        (tmp_path / name).write_text("of an earlier report")
    lines = write_report(Flown(tmp_path, arm=False).fly(50))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([FILE, REPORT, LATENCY])
    assert "armed for 0.00 s of 0.98 s, ended: never armed" in lines[0]
    report = reported(tmp_path)
    assert (report["gates"], report["latency"]["of"], report["figures"]) == ([], "all ticks", [LATENCY])
    assert report["latency"]["stages"]["sent"]["p50_ms"] == pytest.approx(4.0)
    assert not any(report["tracking"].values())
    with pytest.raises(ValueError, match="this flight was never armed, or for one tick only"):
        write_report(tmp_path, tmp_path)


@pytest.mark.parametrize("ticks", [1, 16, 17])
def test_flights_of_a_few_ticks(tmp_path, ticks):
    """The 16th is the first armed one."""
    lines = write_report(Flown(tmp_path).fly(ticks))
    report = reported(tmp_path)
    assert report["ticks"] == ticks and report["armed_s"] == pytest.approx(PERIOD * max(ticks - 16, 0))
    assert (tmp_path / TRAJECTORY).exists() == (ticks > 16)
    assert report["ended"] == ("never armed" if ticks == 1 else "recording stopped")
    assert lines[-1].startswith(f"written to {tmp_path}: report.json")


def test_a_flight_without_poses_and_one_without_ticks(tmp_path):
    chain = FlightChain(Wobble(), CIRCLE, ChainConfig(SafetyLimits.of_track(CIRCLE)))
    with FlightRecorder(tmp_path / FILE, ABOUT) as recorder:
        for index in range(5):
            inputs = Inputs(PERIOD * index, [], Operator(False, False), 0)
            took = dict.fromkeys(("jitter", "render", "act", "sent"), 0.0)
            outputs = describe_outputs(chain.tick(inputs))
            recorder.tick(0.0, {"in": describe_inputs(inputs), "out": outputs, "took": took})
    write_report(tmp_path / FILE)
    FlightRecorder(tmp_path / "no_ticks" / FILE, {"track": "circle"}).close()
    with pytest.raises(ValueError, match="the flight has no ticks"):
        write_report(tmp_path / "no_ticks")
    stages = reported(tmp_path)["latency"]["stages"]
    assert stages["pose_age"] is None and stages["end_to_end"] is None and stages["render"] is None


@pytest.mark.parametrize(
    ("about", "tick"),
    [
        ({}, {}),
        (ABOUT, {"in": 1}),
        (ABOUT, {"in": {"time": 0.0}, "out": {}, "took": {}}),
        ({**ABOUT, "config": [1]}, {}),
        ({**ABOUT, "config": {"stamping": "never"}}, {}),
        (ABOUT, None),
    ],
)
def test_other_content_is_refused(tmp_path, about, tick):
    with FlightRecorder(tmp_path / FILE, about) as recorder:
        recorder.tick(0.0, tick)
    with pytest.raises(ValueError, match="its content is not what recipes/hil.py writes"):
        write_report(tmp_path)


def test_times_out_of_order_are_refused(tmp_path, flown):
    flight = read_flown(flown)
    assert (np.diff(flight.time) > 0).all()
    with FlightRecorder(tmp_path / FILE, ABOUT) as recorder:
        for tick in reversed(Flight(flown).ticks[:3]):
            recorder.tick(0.0, tick)
    with pytest.raises(ValueError, match="times of ticks are not finite, or not in order"):
        write_report(tmp_path)


def test_a_flight_whose_loop_was_killed_or_that_is_damaged(tmp_path, flown, unseen):
    data = bytearray((flown / FILE).read_bytes())
    (tmp_path / FILE).write_bytes(data[: int(0.95 * len(data))])
    lines = write_report(tmp_path)
    assert "note: the file is incomplete: the loop was killed, or is still running" in lines
    data[len(data) // 2 : len(data) // 2 + 4000] = bytes(4000)
    (tmp_path / FILE).write_bytes(data)
    with pytest.raises(ValueError, match="is not a flight, or is damaged"):
        write_report(tmp_path)


def test_what_is_compared_with_must_be_there(tmp_path, flown):
    with pytest.raises(FileNotFoundError, match=r"against=.*nothing\.csv: there is no such file"):
        write_report(flown, tmp_path / "nothing.csv")
    (tmp_path / "metrics.csv").write_text("env_steps,loss\n1,2\n")
    with pytest.raises(ValueError, match="holds no trajectory"):
        write_report(flown, tmp_path / "metrics.csv")
    with pytest.raises(FileNotFoundError, match="There is no flight"):
        write_report(tmp_path / "nowhere")
