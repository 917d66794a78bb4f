"""Whole flights through the chain against the plant, in simulated time: flown, cut, stopped, and played back."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import time
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track, load_track
from dreamer_racing.hil.battery import BatteryConfig, Reading
from dreamer_racing.hil.camera import NoseCamera
from dreamer_racing.hil.chain import LIFT, ChainConfig, FlightChain, Inputs, Outputs, first_difference
from dreamer_racing.hil.flyer import ActorFlyer, Flyer
from dreamer_racing.hil.loop import DISARM_SECONDS, ENDING
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received, decode_pose
from dreamer_racing.hil.recording import FILE, Flight, FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits, State
from dreamer_racing.hil.vehicle import Command, Pose, Setpoint, hover
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import CLOCK_OFFSET, LockStep
from dreamer_racing.plant.pilot import PilotFlyer
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle

AGENTS = Path(__file__).parents[2] / "agents"
FIGURE8 = load_track("figure8")
CIRCLE = load_track("circle")


class Hover:
    """Asks to stay where it is."""

    rate = 50.0
    camera = None

    def __init__(self) -> None:
        self.resets = self.prepared = 0

    def reset(self) -> None:
        self.resets += 1

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        return hover()

    def prepare(self) -> None:
        self.prepared += 1


class Watched(LockStep):
    """Remembers what was sent, and lets something happen before each tick."""

    def __init__(self, track: Track, preset: str = "easy", delivery: Delivery | None = None, **mismatch: float) -> None:
        super().__init__(PlantVehicle(track, preset, Mismatch(**mismatch)), delivery)
        self.sent: list[tuple[float, Command]] = []
        self.happens = lambda elapsed: None

    @property
    def vehicle(self) -> PlantVehicle:
        return self.plant.vehicle

    def sleep_until(self, deadline: float) -> None:
        self.happens(self.elapsed)
        super().sleep_until(deadline)

    def send(self, command: Command) -> bytes:
        self.sent.append((self.elapsed, command))
        return super().send(command)


def chain_of(flyer: Flyer, plant: LockStep, laps: int | None = 3, arm: bool = True, **limits: object) -> FlightChain:
    track = plant.plant.vehicle.track
    config = ChainConfig(SafetyLimits.of_track(track, **limits), laps=laps, arm=arm)
    return FlightChain(flyer, track, config)


def fly_hovering(plant: Watched, duration: float = 30.0) -> str:
    return plant.fly(chain_of(Hover(), plant), Hover.rate, duration)


def test_a_wrong_pose_passes_no_gate():
    """Safety judges the newest of a tick; a wrong one before it would count a gate that was never passed."""
    gate = CIRCLE.gates[0]
    before, beyond = (np.array(gate.position) + side * np.array(gate.forward) for side in (-0.2, 0.2))
    beside = beyond + np.array([0.0, 0.0, 3.0])

    def passes_after(*ticks: list[np.ndarray]) -> int:
        chain = FlightChain(Hover(), CIRCLE, ChainConfig(SafetyLimits.of_track(CIRCLE)))
        level, still, operator = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), Operator(enable=False, kill=False)
        for index, bunch in enumerate(ticks):
            chain._flying = True
            poses = [
                PosePacket(10 * index + number, 0.0, place, level, still, still) for number, place in enumerate(bunch)
            ]
            now = 0.04 * (index + 1)
            outputs = chain.tick(Inputs(now, [Received(now, pose) for pose in poses], operator, 0))
        return outputs.passes

    assert passes_after([before], [beyond]) == 1
    assert passes_after([before], [before, beyond, before]) == 0
    assert passes_after([beside], [before], [beyond]) == 1, "one that comes back counts on"


def test_the_pilot_flies_three_laps_with_delay_and_loss():
    flyer = PilotFlyer(FIGURE8, "faithful")
    plant = Watched(FIGURE8, "faithful", Delivery(packet_loss=0.01), delay=0.02)
    chain = chain_of(flyer, plant, speed_max=25.0)
    assert plant.fly(chain, flyer.rate, 30.0) == "disarmed: the flight is over"
    assert [passed.gate for passed in chain.progress.passes] == [*range(6)] * 3
    assert plant.vehicle.gates_passed == 18 and len(plant.vehicle.lap_times) == 3
    # as the race itself saw them, to within the time between two poses
    laps = [later.time - earlier.time for earlier, later in pairwise(chain.progress.passes[5::6])]
    assert laps == pytest.approx(plant.vehicle.lap_times[1:], abs=0.03)


def test_a_shipped_agent_flies_by_its_images_and_its_flight_plays_back_bit_for_bit(tmp_path):
    flyer = ActorFlyer(AGENTS / "circle")
    plant = Watched(load_track(flyer.contract["source"]["track"]))
    chain = chain_of(flyer, plant, laps=1)
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        assert plant.fly(chain, flyer.rate, 30.0, recorder) == "disarmed: the flight is over"
    chain.close()
    assert plant.vehicle.gates_passed == 4
    again = chain_of(ActorFlyer(AGENTS / "circle"), plant, laps=1)
    flight = Flight(tmp_path)
    assert flight.whole and len(flight.ticks) > 50
    assert first_difference(again, flight.ticks) is None
    again.close()


def test_the_battery_is_heard_in_flight_reckoned_with_and_played_back(tmp_path):
    class Sagging(Watched):
        """Speaks of a battery that sinks, and once of a single cell."""

        reckoned: ClassVar[list[float]] = []

        def listen(self):
            return [Reading(self.now(), 3.9 if 1.0 < self.elapsed < 1.03 else 16.0 - 0.5 * self.elapsed)]

        def set_voltage(self, voltage):
            self.reckoned.append(voltage)

    def chain():
        config = ChainConfig(SafetyLimits.of_track(CIRCLE), arm=True, battery=BatteryConfig(voltage=16.0))
        return FlightChain(Hover(), CIRCLE, config)

    plant = Sagging(CIRCLE)
    flying = chain()
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        plant.fly(flying, 50.0, 2.0, recorder)
    assert flying.battery.implausible == 1 and 14.7 < plant.reckoned[-1] < plant.reckoned[0] == 16.0
    ticks = Flight(tmp_path).ticks
    assert [tick["out"]["voltage"] for tick in ticks] == plant.reckoned
    assert first_difference(chain(), ticks) is None
    ticks[7]["out"]["voltage"] = np.nextafter(ticks[7]["out"]["voltage"], 0.0)
    assert first_difference(chain(), ticks).startswith("tick 7: voltage was "), "bit for bit"


@pytest.mark.parametrize("phase", [0.005, 0.035])
def test_poses_are_lost_to_cut_within_200_ms_at_25_hz_by_an_actor_that_takes_30_ms(phase):
    """Whenever in a tick the last one was measured; what is cut does not wait for the actor."""
    plant = Watched(CIRCLE)

    class Slow(Hover):
        rate = 25.0

        def act(self, pose, image, target_gate):
            if plant.elapsed > 1.0:  # not while the chain is warmed up
                LockStep.sleep_until(plant, plant.now() + 0.03)
            return hover()

    poll, measured = plant.poses.poll, []

    def lose():
        received = [each for each in poll() if each.packet.stamp <= 2.0 + phase]
        measured.extend(each.packet.stamp for each in received)
        return received

    plant.poses.poll = lose
    assert plant.fly(chain_of(Slow(), plant), 25.0, 30.0).startswith("cut: the newest pose is ")
    last_armed = max(moment for moment, command in plant.sent if command.armed)
    cut = min(moment for moment, command in plant.sent if moment > last_armed)
    assert 0.15 < cut - measured[-1] <= 0.195


def test_a_slow_camera_is_drawn_at_its_frames_and_shown_between_them(monkeypatch):
    """The flight begins with a frame; the ticks of its loop, two to a frame, see the same one."""
    plant, drawn = Watched(CIRCLE), []

    class Seeing(Hover):
        camera = Camera(32, 32, rate=25.0)
        seen: ClassVar[list] = []

        def reset(self):
            self.seen.clear()

        def act(self, pose, image, target_gate):
            self.seen.append((pose, image))
            return Setpoint(GRAVITY + 0.5, np.zeros(3))

    see = NoseCamera.see
    monkeypatch.setattr(NoseCamera, "see", lambda self, pose: drawn.append(pose) or see(self, pose))
    flyer = Seeing()
    chain = FlightChain(flyer, CIRCLE, ChainConfig(SafetyLimits.of_track(CIRCLE), arm=True))
    loop = plant.fly(chain, 50.0, 2.0)
    poses, images = zip(*flyer.seen, strict=True)
    assert len(images) > 20, loop
    first = images[::2]
    assert all(one is other for one, other in zip(first, images[1::2], strict=False))
    assert not any(np.array_equal(one, other) for one, other in pairwise(first))
    assert [pose.time for pose in drawn[-len(first) :]] == [pose.time for pose in poses[::2]]
    assert np.array_equal(NoseCamera(CIRCLE, Seeing.camera).see(poses[0]), images[0])
    chain.close()
    Seeing.camera = Camera(32, 32, rate=30.0)
    with pytest.raises(ValueError, match=r"camera_rate=30 Hz: .* 25 or 50 are the nearest"):
        FlightChain(Seeing(), CIRCLE, ChainConfig(SafetyLimits.of_track(CIRCLE)))


@pytest.mark.parametrize("armed", [True, False])
def test_the_operators_kill_wins_at_once(armed):
    plant = Watched(CIRCLE)
    plant.enable_after = 0.5 if armed else 9.0

    def kill(elapsed: float) -> None:
        plant.killed = elapsed > 1.5

    plant.happens = kill
    fly_hovering(plant, 3.0)
    assert any(command.armed for _, command in plant.sent) == armed
    assert not any(command.armed for moment, command in plant.sent if moment > 1.53)


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_the_flight_with_a_second_of_disarm_frames(number):
    plant, sent = Watched(CIRCLE), []

    def interrupt(elapsed: float) -> None:
        if elapsed > 1.5 and not sent:
            sent.append(elapsed)
            os.kill(os.getpid(), number)

    plant.happens = interrupt
    assert fly_hovering(plant) == number.name
    frames = [(moment, command) for moment, command in plant.sent if moment > sent[0] + 0.03]
    assert not any(command.armed for _, command in frames)
    assert frames[-1][0] - frames[0][0] == pytest.approx(DISARM_SECONDS, abs=0.05)


def test_an_actor_that_hangs_is_disarmed_meanwhile_and_for_good():
    class Slept(Watched):
        """Time passes while the actor hangs; the plant's physics waits."""

        slept = 0.0

        def now(self):
            return super().now() + self.slept

        def sleep_until(self, deadline):
            super().sleep_until(deadline - self.slept)

    plant, meanwhile = Slept(CIRCLE), []

    class Hangs(Hover):
        def act(self, pose, image, target_gate):
            if plant.elapsed > 1.5 and not plant.slept:
                plant.slept, before = 0.21, len(plant.sent)  # more than limits.tick_max
                deadline = time.monotonic() + 5
                while len(plant.sent) < before + 3 and time.monotonic() < deadline:
                    ctypes.CDLL(None).usleep(10_000)  # in C, as a driver hangs
                meanwhile.extend(command.armed for _, command in plant.sent[before:])
            return hover()

    ended = plant.fly(chain_of(Hangs(), plant), 50.0, 30.0)
    assert ended == "cut: no command for more than 0.2 s: the watchdog disarmed the vehicle"
    assert meanwhile[:3] == [False] * 3
    last_armed = max(index for index, (_, command) in enumerate(plant.sent) if command.armed)
    assert len(plant.sent) - last_armed > 50


def test_whatever_breaks_the_vehicle_is_disarmed():
    class Broken(Hover):
        def act(self, pose, image, target_gate):
            if pose.time > CLOCK_OFFSET + 1.5:
                raise RuntimeError("out of order")
            return hover()

    plant = Watched(CIRCLE)
    with pytest.raises(RuntimeError, match="out of order"):
        plant.fly(chain_of(Broken(), plant), 50.0, 30.0)
    assert any(command.armed for _, command in plant.sent)
    assert [command.armed for _, command in plant.sent[-50:]] == [False] * 50


def test_a_terminal_that_is_stopped_does_not_keep_disarm_frames_back():
    """Ctrl+S: who writes to it waits. Here, until all disarm frames have gone out."""
    plant, waited = Watched(CIRCLE), []

    class Stopped(logging.Handler):
        def emit(self, record):
            deadline = time.monotonic() + 3
            while (not plant.sent or plant.sent[-1][0] < 2.45) and time.monotonic() < deadline:  # + DISARM_SECONDS
                time.sleep(0.001)
            waited.append((record.getMessage(), time.monotonic() < deadline))

    def kill(elapsed: float) -> None:
        plant.killed = elapsed > 1.5

    plant.happens = kill
    log, handler = logging.getLogger("dreamer_racing.hil.loop"), Stopped()
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        fly_hovering(plant)
    finally:
        log.removeHandler(handler)
        log.setLevel(logging.NOTSET)
    assert all(in_time for _, in_time in waited), waited
    assert any(said.startswith("cut: the operator killed") for said, _ in waited)


def test_what_speaks_against_arming_is_said_when_it_changes_and_not_with_every_enable(caplog):
    plant = Watched(CIRCLE)
    plant.happens = lambda elapsed: setattr(plant, "enable_after", 0.0 if int(elapsed / 0.3) % 2 else 9.0)
    with caplog.at_level(logging.INFO, "dreamer_racing.hil.loop"):
        ended = plant.fly(chain_of(Hover(), plant, arm=False), Hover.rate, 3.0)
    assert ended.startswith("3 s are over; not armed:") and "arm=true" in ended
    assert not any(command.armed for _, command in plant.sent)
    said = [record.getMessage() for record in caplog.records if record.getMessage().startswith("not armed")]
    assert 1 <= len(said) <= 3 and "arm=true" in said[-1]


def test_messages_that_are_no_poses_are_said_where_there_is_none(caplog):
    plant = Watched(CIRCLE)
    plant.poses.poll = list
    plant.happens = lambda elapsed: setattr(plant.poses, "rejected", int(10 * elapsed))
    with caplog.at_level(logging.INFO, "dreamer_racing.hil.loop"):
        ended = plant.fly(chain_of(Hover(), plant), Hover.rate, 1.0)
    said = [record.getMessage() for record in caplog.records if "there is no pose" in record.getMessage()]
    assert "messages" not in said[0] and said[-1].endswith("; 1 messages were not poses"), said
    assert ended.endswith(" messages were not poses")


def test_a_disk_that_is_full_does_not_end_a_flight():
    class Full:
        def tick(self, time, message):
            if time > CLOCK_OFFSET + 1.0:
                raise OSError(28, "No space left on device")

    plant = Watched(CIRCLE)
    assert plant.fly(chain_of(Hover(), plant), 50.0, 2.0, Full()) == "2 s are over"
    assert max(moment for moment, command in plant.sent if command.armed) > 2.4


@pytest.mark.parametrize(
    ("part", "said", "states", "words"),
    [
        ("poses", "the source of poses fails", ["flying", "hold", "cut"], "cut: the newest pose is "),
        ("operator", "the operator's switch fails", ["flying", "cut"], "cut: the operator does not give the enable"),
        ("link", "the link fails", ["flying", "cut"], "cut: the link has accepted no command for 0.1"),
    ],
)
def test_what_speaks_to_the_loop_and_breaks_in_flight_ends_it_as_any_other(part, said, states, words, tmp_path, caplog):
    """As where a receiver is unplugged: safety decides, all is recorded, and the reason is returned."""
    plant = Watched(CIRCLE)
    broken, methods = (plant, ("send", "listen")) if part == "link" else (getattr(plant, part), ("poll",))
    for name in methods:
        works = getattr(broken, name)

        def unplugged(*arguments, works=works):
            if plant.elapsed > 2.0:
                raise OSError(19, "No such device")
            return works(*arguments)

        setattr(broken, name, unplugged)
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        ended = plant.fly(chain_of(Hover(), plant), Hover.rate, 30.0, recorder)
    assert ended.startswith(words)
    shown = [tick["out"]["state"] for tick in Flight(tmp_path).ticks]
    assert list(dict.fromkeys(shown[shown.index("flying") :])) == states
    assert 2.0 < max(moment for moment, command in plant.sent if command.armed) + 0.02 < 2.2
    assert sum(said in line for line in caplog.messages) == 1


class Clogged(Watched):
    def send(self, command):
        return b"" if self.elapsed > 1.5 else super().send(command)


class Refusing(Watched):
    @property
    def refusal(self):
        return "" if self.elapsed < 1.5 else "the pilot flies it"


@pytest.mark.parametrize(
    ("kind", "words", "after"),
    [
        (Clogged, "cut: the link has accepted no command for 0.16 s", 0.0),
        (Refusing, "cut: the flight controller refuses: the pilot flies it", 0.75),
    ],
)
def test_a_link_that_takes_no_command_or_is_refused_cuts_and_its_flight_plays_back(kind, words, after, tmp_path):
    plant = kind(CIRCLE)
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        assert plant.fly(chain_of(Hover(), plant), 50.0, 30.0, recorder) == words
    assert max(at for at, command in plant.sent if command.armed) == pytest.approx(1.5 + after, abs=0.03)
    again = chain_of(Hover(), plant)
    assert first_difference(again, Flight(tmp_path).ticks) is None
    assert again.safety.state is State.CUT


@pytest.mark.parametrize("lift", [LIFT, 0.0])
def test_until_it_moves_a_vehicle_is_lifted_and_its_flyer_begun_anew(lift):
    class Noted(Hover):
        """Turns; notes for which pose it chose first after it was begun."""

        began: Pose | None = None
        fresh = True

        def reset(self):
            super().reset()
            self.fresh = True

        def act(self, pose, image, target_gate):
            if self.fresh:
                self.began, self.fresh = pose, False
            return Setpoint(14.0, np.array([0.0, 1.0, 0.0]))

    flyer, plant = Noted(), Watched(CIRCLE)
    config = ChainConfig(SafetyLimits.of_track(CIRCLE, arm_time=0.02), arm=True, lift=lift)
    chain, shown = FlightChain(flyer, CIRCLE, config), list[Outputs]()
    tick = chain.tick
    chain.tick = lambda inputs: shown.append(tick(inputs)) or shown[-1]
    plant.fly(chain, flyer.rate, 1.5)
    wanted = {outputs.setpoint.collective_thrust for outputs in shown if outputs.setpoint is not None}
    assert wanted == {14.0}, "what the flyer wants is shown also when the lift is sent"
    assert flyer.resets > 25 and flyer.prepared == len(shown), "reset at each tick on the stand; prepared after each"
    armed = [(moment, command.setpoint) for moment, command in plant.sent if command.armed]
    turning = next(index for index, (_, setpoint) in enumerate(armed) if setpoint.body_rates.any())
    if not lift:
        assert turning == 2
        return
    thrusts = [setpoint.collective_thrust / GRAVITY for _, setpoint in armed[2:turning]]
    assert len(thrusts) > 10 and thrusts == sorted(thrusts) and thrusts[0] < 1.01 and 1.1 < thrusts[-1] < 1.2
    began = armed[turning][0]
    assert flyer.began.time == pytest.approx(CLOCK_OFFSET + began, abs=0.001), (
        "its first choice is the first that is sent"
    )
    assert 0.2 < flyer.began.linear_velocity[2] < 0.4


SLOW, RISES, SINKS, STILL = (0.0, 0.0, 0.19), (0.0, 0.0, 0.21), (0.5, 0.0, -0.5), (0.0, 0.0, 0.0)


class Scripted:
    """Feeds a chain with a pose at each tick of 50 Hz, on the start or above it; armed from the 14th tick on."""

    def __init__(self, lift, **limits):
        chosen = SafetyLimits.of_track(CIRCLE, arm_time=0.02, start_yaw_degrees=0.0, **limits)
        self.chain = FlightChain(Hover(), CIRCLE, ChainConfig(chosen, arm=True, lift=lift))
        self.now = 10.0
        for count in range(14):
            outputs = self.tick(enable=count == 13)
        assert outputs.verdict.command.armed and not self.chain._flying

    def tick(self, velocity=STILL, rate=0.0, height=0.0, poses=True, enable=True):
        self.now += 0.02
        place, level = np.array(CIRCLE.start_position), np.array([1.0, 0.0, 0.0, 0.0])
        place[2] += height
        packet = PosePacket(round(self.now * 50), self.now, place, level, np.array(velocity), np.array((0, rate, 0.0)))
        received = [Received(self.now, packet)] if poses else []
        return self.chain.tick(Inputs(self.now, received, Operator(enable, False), 0))


@pytest.mark.parametrize(
    ("lift", "poses", "left"),
    [
        (LIFT, [(RISES, 0.0, 0.011)] * 4, True),
        (LIFT, [(RISES, 0.0, 0.011)] * 2, False),
        (LIFT, [(RISES, 0.0, 0.009)] * 9, False),
        (LIFT, [(RISES, 0.0, 0.02)] * 2 + [(SLOW, 0.0, 0.02)] + [(RISES, 0.0, 0.02)] * 2, False),
        (LIFT, [(SLOW, 2.1, 0.02)] * 9, False),
        (LIFT, [(SINKS, 9.0, 0.02)] * 2, False),
        (0.0, [(RISES, 0.0, 0.0)], True),
        (0.0, [(SLOW, 1.9, 0.0)], False),
        (0.0, [(SLOW, 2.1, 0.0)], True),
        (0.0, [(SINKS, 0.0, 0.0)], True),
    ],
)
def test_a_flyer_takes_over_when_poses_have_risen_for_long_enough_or_without_a_lift_moved(lift, poses, left):
    flight = Scripted(lift)
    for _ in range(3):
        flight.tick()
    for velocity, rate, height in poses:
        flight.tick(velocity, rate, height)
    assert flight.chain._flying is left


def test_what_rose_before_it_was_lifted_does_not_count():
    flight = Scripted(LIFT, hold_after=0.03, cut_after=0.15)
    for _ in range(3):
        flight.tick(RISES, 0.0, 0.02)  # in the first no thrust was sent, and the second is the first lifted
    assert not flight.chain._flying
    holding = [flight.tick(poses=False).verdict.state for _ in range(3)][-1]
    assert holding is State.HOLD
    flight.tick(RISES, 0.0, 0.04)
    assert not flight.chain._flying, "what rose before, or while it held, begins anew"
    for _ in range(4):
        flight.tick(RISES, 0.0, 0.06)
    assert flight.chain._flying


def test_a_second_flight_is_lifted_from_one_weight_again():
    flight = Scripted(LIFT)
    first = [flight.tick().verdict.command.setpoint.collective_thrust for _ in range(20)]
    assert not flight.tick(enable=False).verdict.command.armed
    for _ in range(14):
        flight.tick(enable=False)
    assert flight.tick().verdict.command.armed
    second = [flight.tick().verdict.command.setpoint.collective_thrust for _ in range(20)]
    assert first == pytest.approx(second) and first[1] == pytest.approx(GRAVITY, rel=0.01) and first[-1] > 11.0


@pytest.mark.parametrize("changed", [{"thrust": 0.87}, {"mass": 1.1}, {"thrust": 1.2}, {"delay": 0.06}])
def test_another_vehicle_than_believed_is_lifted_too(changed):
    plant = Watched(CIRCLE, **changed)
    heights = []
    chain = chain_of(Hover(), plant)
    plant.happens = lambda elapsed: heights.append(plant.vehicle.pose().position[2]) if not chain._flying else None
    plant.fly(chain, Hover.rate, 2.0)
    assert chain._flying and heights[-1] - heights[0] < 0.15


@pytest.mark.parametrize(("thrust", "low", "high"), [(1.0, 0.3, 0.6), (1.1, 0.6, 1.2), (1.2, 1.0, 1.7)])
@pytest.mark.parametrize("hidden", ["everything", "velocity", "noise"])
def test_a_lift_that_no_pose_shows_ends_low(hidden, thrust, low, high):
    noise = np.random.default_rng(0)

    class Blind(Watched):
        def _deliver(self, data):
            packet = decode_pose(data)
            if self.elapsed < 0.4:
                self.kept = packet.position
            velocity = noise.normal(0.0, 0.08, 3) if hidden == "noise" else np.zeros(3)
            place = packet.position if hidden == "velocity" else self.kept
            if hidden == "noise":
                place = place + noise.normal(0.0, 0.001, 3)
            self.poses.arrived.append(Received(self.now(), packet._replace(position=place, linear_velocity=velocity)))

    plant = Blind(CIRCLE, thrust=thrust)
    heights = []
    plant.happens = lambda elapsed: heights.append(plant.vehicle.pose().position[2])
    assert "no rise was measured within limits.lift_time=0.9 s" in plant.fly(chain_of(Hover(), plant), Hover.rate, 3.0)
    assert low < max(heights) - heights[0] < high


@pytest.mark.parametrize(
    ("field", "value", "limits", "allowed"),
    [
        *(("lift", lift, {}, "1.1 to 1.5 times the weight.*limits.thrust_max=") for lift in (1.05, -1, 1.6)),
        ("lift", 1.4, {"thrust_max": 13.0}, "1.1 to 1.5 times the weight.*limits.thrust_max="),  # it would be clipped
        *(("latency", latency, {}, "(a number, )?at least 0 and at most 1") for latency in (-1, 1.5, np.nan, "0")),
    ],
)
def test_a_lift_and_a_latency_out_of_range_are_refused(field, value, limits, allowed):
    config = ChainConfig(SafetyLimits.of_track(CIRCLE, **limits))._replace(**{field: value})
    with pytest.raises(ValueError, match=f"{field}={value!r}: must be {allowed}"):
        FlightChain(Hover(), CIRCLE, config)


@pytest.mark.parametrize("name", ["figure8", "kidney"])
def test_shipped_agents_fly_a_lap_from_the_stand(name):
    flyer = ActorFlyer(AGENTS / name)
    plant = Watched(load_track(name), json.loads((AGENTS / name / "agent.json").read_text())["preset"])
    chain = chain_of(flyer, plant, laps=1)
    assert plant.fly(chain, flyer.rate, 10.0) == "disarmed: the flight is over"
    assert plant.vehicle.gates_passed == plant.vehicle.track.num_gates
    chain.close()


def test_after_a_stall_the_next_tick_is_late_and_those_after_it_are_on_the_grid():
    class Stalls(Watched):
        def send(self, command):
            sent = super().send(command)
            if self.elapsed == pytest.approx(1.0):
                LockStep.sleep_until(self, self.now() + 0.075)  # three periods are missed, and most of a fourth
            return sent

    class Kept:
        def tick(self, time, message):
            missed.append(message["in"]["overrun"])

    plant, missed = Stalls(CIRCLE), []
    plant.fly(chain_of(Hover(), plant), Hover.rate, 1.3, Kept())
    moments = [moment for moment, _ in plant.sent if 0.97 < moment <= 1.17]
    assert moments == pytest.approx([0.98, 1.0, 1.075, 1.08, 1.1, 1.12, 1.14, 1.16])
    assert [number for number in missed if number] == [3]  # those of 1.02 and 1.04, and that of 1.06 came late
