"""`recipes/hil.py` as a user starts it: refusals, flights against a plant in another process, and what kills either."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from dreamer_racing.envs.tracks import describe_track, load_track
from dreamer_racing.hil import configuration as flights
from dreamer_racing.hil.battery import battery_words
from dreamer_racing.hil.betaflight import print_settings
from dreamer_racing.hil.chain import Inputs, describe_inputs, describe_outputs
from dreamer_racing.hil.links.udp import decode_command
from dreamer_racing.hil.loop import LoopStatistics
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.pose import PosePacket, Received
from dreamer_racing.hil.recording import FILE, TRACK, Flight, FlightRecorder
from tests.running_recipes import ROOT, free_port, recipe, recipe_module

hil = recipe_module("hil")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "give one of actor=, replay= and report=, not none"),
        ({"actor": "pilot", "report": "x"}, "not actor and report"),
        ({"actor": "pilot", "operator": "cat"}, "operator=cat: must be one of auto, keyboard, udp, timed"),
        (
            {"actor": "pilot", "link": "crsf", "operator": "timed"},
            "operator=timed gives the enable by itself, but link=crsf may be",
        ),
        ({"actor": "pilot", "link_host": "10.0.0.5"}, "link_host=10.0.0.5 is another machine"),
        ({"actor": "pilot", "link_host": "127.x.example"}, "link_host=127.x.example is another machine"),
        ({"actor": "pilot", "link_host": "127.0.0.1.example"}, "link_host=127.0.0.1.example is another machine"),
        ({"actor": "pilot", "against": "x"}, "against=x is only used with report="),
        ({"actor": "pilot", "link": "simulatd"}, "link=simulatd: must be one of "),
        ({"actor": "pilot", "pose": "foo"}, "pose=foo: must be one of udp, mavlink, ros2"),
        ({"actor": "pilot", "rate": 3.0}, "rate=3.0: must be at least 10 and at most 500"),
        ({"actor": "pilot", "baud": 9600}, "baud=9600 is for device=, which is not given"),
        ({"actor": "pilot", "pose_device": "/dev/x"}, "pose_device=/dev/x is for pose=mavlink"),
        ({"actor": "pilot", "pose_baud": 9600}, "pose_baud=9600 is for pose_device="),
        ({"actor": "pilot", "pose_topic": "/p"}, "pose_topic=/p is for pose=ros2"),
        ({"actor": "pilot", "pose_message": "ODOMETRY"}, "pose_message=ODOMETRY is for pose=mavlink or ros2"),
        ({"actor": "pilot", "renderer": "egl"}, "renderer=egl is for an actor with a camera"),
        ({"actor": "kidney", "smoothing": 0.5}, "smoothing=0.5 is for poses without velocities, VISION_"),
        ({"actor": "kidney", "pose": "mavlink", "smoothing": 0.5}, "smoothing=0.5 is for poses without velocities"),
        ({"report": "x", "renderer": "egl"}, "renderer= is for new flights, and report= reads a recorded one"),
        ({"actor": "kidney", "preset": "easy"}, "preset=easy is for actor=pilot, which is not given"),
        ({"actor": "kidney", "link": "udp", "mass": 0.7}, "mass=0.7 is for a link that sends a throttle"),
        ({"actor": "kidney", "link": "mavlink", "arm_channel": 5}, "arm_channel=5 is for link=crsf, sbus, msp"),
        ({"actor": "kidney", "link": "sbus", "voltage_tolerance": 0.1}, "voltage_tolerance=0.1 is for link=crsf, msp"),
        (
            {"actor": "kidney", "link": "mavlink", "device": "/dev/x", "link_port": 14550},
            "link_port=14550 is for a link over the network, without device=",
        ),
        ({"actor": "kidney", "pose": "ros2", "pose_port": 9200}, "pose_port=9200 is for poses over the network"),
        ({"actor": "kidney", "operator_port": 9200}, "operator_port=9200 is for operator=udp"),
        ({"actor": "identify", "track": "circle", "rate": 50.0}, "rate=50.0 is for an actor other than identify"),
        ({"replay": "x", "track": "circle"}, "track= is for new flights, and replay= reads a recorded one"),
        (
            {"report": "x", "limits": flights.LimitsConfig(speed_max=9.0)},
            "limits= is for new flights, and report= reads",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        hil.check(hil.HilConfig(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actor": "pilot"}, "track= is missing: actor=pilot has none of its own"),
        ({"actor": "pilot", "track": "moon"}, "moon"),
        ({"actor": "kidney", "track": "circle"}, "source.track is 'kidney', .* track=circle"),
        ({"actor": "kidney", "rate": 50.0}, "control.rate_hz is 25, but rate=50"),
        ({"actor": "nobody"}, "actor=nobody: there is no such file or folder. Included agents, .*: circle"),
        ({"actor": "kidney", "link": "crsf"}, "mass= is missing: link=crsf needs it to convert thrust to throttle"),
        ({"actor": "kidney", "device": "/dev/x"}, "device=/dev/x is for crsf, sbus, .* link=simulated uses UDP"),
        ({"actor": "kidney", "betaflight_dump": "x"}, "betaflight_dump=x is for link=crsf, sbus, msp"),
        (
            {"actor": "kidney", "link": "crsf", "betaflight_dump": "x", "arm_channel": 5},
            "betaflight_dump= is only checked for arming by AUX1",
        ),
        ({"actor": "kidney", "link": "crsf", "betaflight_dump": "/nowhere"}, "/nowhere"),
        (
            {"actor": "kidney", "limits": flights.LimitsConfig(hold_after=0.2)},
            "hold_after=0.2: must be below cut_after",
        ),
    ],
)
def test_what_cannot_fly_is_refused_before_anything_is_armed(changes, message, tmp_path):
    config = hil.HilConfig(run_dir=str(tmp_path), **changes)
    hil.check(config)
    with ExitStack() as opened, pytest.raises((ValueError, OSError), match=message):
        hil.prepare(config, opened)


@pytest.mark.parametrize("operator", ["auto", "keyboard"])
def test_a_terminal_over_a_network_answers_for_no_real_vehicle(operator, monkeypatch):
    """The enable would stay where the network drops."""
    real = hil.HilConfig(actor="kidney", link="crsf", operator=operator, arm=True)
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    hil.check(real)
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.5 50000 10.0.0.9 22")
    with pytest.raises(ValueError, match=r"operator=keyboard over ssh.*operator=udp"):
        hil.check(real)
    hil.check(hil.HilConfig(actor="kidney", link="crsf", operator=operator))  # nothing is armed
    hil.check(hil.HilConfig(actor="kidney", link="crsf", operator="udp", arm=True))
    hil.check(hil.HilConfig(actor="kidney", operator=operator))  # simulated
    with pytest.raises(ValueError, match=r"operator=keyboard over ssh.*operator=udp"):
        hil.check(hil.HilConfig(actor="kidney", link_host="192.168.1.5", operator="keyboard", arm=True))


@pytest.mark.parametrize(
    ("changes", "compared"),
    [
        ({}, True),
        ({"pose": "mavlink"}, True),
        ({"pose": "mavlink", "pose_message": "ATT_POS_MOCAP"}, False),
        ({"pose": "ros2"}, False),
        ({"pose": "ros2", "pose_message": "Odometry"}, True),
        ({"pose": "ros2", "limits": flights.LimitsConfig(rate_tolerance=5.0)}, True),
    ],
)
def test_body_rates_are_compared_where_they_are_measured(changes, compared):
    """Those that are made from attitudes lag behind them, and cannot contradict them."""
    limits = flights.limits_of(hil.HilConfig(actor="pilot", **changes), load_track("circle"))
    assert (limits.rate_tolerance == 5.0) is compared


def test_a_port_in_use_is_said_and_nothing_else_happens(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        config = hil.HilConfig(actor="circle", pose_port=port, run_dir=str(tmp_path / "run"))
        with ExitStack() as opened, pytest.raises(OSError, match=f"cannot listen on 127.0.0.1:{port}"):
            hil.prepare(config, opened)
    assert not (tmp_path / "run").exists()


def test_a_link_to_a_firmware_asks_for_the_rates_that_it_is_told_to_be_set_to():
    drone = {"mass": 0.6, "full_thrust": 16.0, "reference_voltage": 15.0, "voltage": 15.0}
    config = hil.HilConfig(actor="kidney", link="betaflight_sitl", **drone)
    link = hil.link_config(config, hil.make_flyer(config)[1], 50.0)
    assert link.rates is not None and link.thrust is not None
    assert [round(rate * 57.29578) for rate in (link.rates.roll, link.rates.pitch, link.rates.yaw)] == [580, 580, 230]


def test_a_flight_controller_with_other_settings_is_refused_line_by_line(tmp_path):
    """Before a port is opened: the device does not exist."""
    path = tmp_path / "dump.txt"
    drone = {"mass": 0.6, "full_thrust": 16.0, "reference_voltage": 15.0, "voltage": 15.0}
    config = hil.HilConfig(
        actor="kidney", arm=True, link="crsf", device="/dev/none", run_dir=str(tmp_path / "run"), **drone,
        betaflight_dump=str(path), force=True,
    )  # fmt: skip
    contract = hil.make_flyer(config)[1]
    kidney = load_track("kidney")
    lines = [line for line in print_settings(contract, "crsf") if not line.startswith("#")]
    path.write_text("\n".join(["# Betaflight / STM32F405 (S405) 4.5.1 Jul 28 2024 / 05:09:33 (77d01ba3b)", *lines]))
    forced, compared = flights.check_flight(config, contract, kidney)
    assert forced.endswith("(force=true)") and compared.startswith("flight controller: ")
    wrong = path.read_text().replace("yaw_srate = 23", "yaw_srate = 67").replace("set failsafe_delay = 5\n", "")
    path.write_text(wrong)
    with ExitStack() as opened, pytest.raises(ValueError, match="2 of .* settings of the flight controller") as refused:
        hil.prepare(config, opened)
    said = [" ".join(line.split()[:2]) for line in str(refused.value).splitlines()[1:]]
    assert sorted(said) == ["differs set", "missing set"] and "found 67" in str(refused.value)
    config.betaflight_dump = None
    assert "its settings were not checked" in flights.check_flight(config, contract, kidney)[1]
    config.force = False
    with pytest.raises(ValueError, match="trained with a proportional rate loop, but link=crsf commands a Betaflight"):
        flights.check_flight(config, contract, kidney)
    config.arm = False  # to be carried by hand
    assert flights.check_flight(config, contract, kidney) == []


def test_a_drone_with_less_thrust_than_training_covered_is_said():
    drone = {"mass": 0.6, "full_thrust": 16.0, "reference_voltage": 15.0, "voltage": 15.0}
    config = hil.HilConfig(actor="kidney_betaflight", link="crsf", device="/dev/none", **drone)
    contract, kidney = hil.make_flyer(config)[1], load_track("kidney")
    assert flights.check_flight(config, contract, kidney) == []
    config.full_thrust = 12.0  # 20 m/s², which training had with a weak, sagging battery and a heavy drone
    assert flights.check_flight(config, contract, kidney) == []
    config.full_thrust = 11.0
    (note,) = flights.check_flight(config, contract, kidney)
    assert note == "thrust: the actor may ask for 26.66 m/s², and the vehicle gives at most 18.33: more is cut off"
    config.actor = "pilot"
    assert flights.check_flight(config, flights.pilot_contract(config), kidney) == []


def test_a_disk_that_is_full_at_the_end_does_not_take_the_summary(tmp_path, monkeypatch, capsys):
    chain = SimpleNamespace(progress=SimpleNamespace(passes=[]), clock=SimpleNamespace(out_of_order=0))
    loop = SimpleNamespace(run=lambda *_: "the operator ended it", flew=True, statistics=LoopStatistics())
    poses, link = SimpleNamespace(rejected=0), SimpleNamespace(dropped=0, thrust=None)
    flown = hil.Prepared(tmp_path / "gone", load_track("circle"), chain, poses, link, loop)
    monkeypatch.setattr(hil, "prepare", lambda *_: flown)
    with pytest.raises(SystemExit) as ended:
        hil.fly(hil.HilConfig(actor="circle"))
    told = capsys.readouterr()
    assert ended.value.code == 1 and "gone" in told.err and "the operator ended it" in told.out


def test_a_limit_that_was_set_may_clip_and_is_said():
    config = hil.HilConfig(actor="kidney", limits=flights.LimitsConfig(thrust_max=20.0))
    notes = flights.check_flight(config, hil.make_flyer(config)[1], load_track("kidney"))
    assert len(notes) == 1 and notes[0].startswith("limits.thrust_max=20 clips the actor, which asks for up to 26.")


def test_what_is_believed_of_a_battery_must_be_what_can_be_reckoned_with():
    drone = {"mass": 0.6, "full_thrust": 9.0, "reference_voltage": 15.0, "voltage": 15.0}  # 11.25 V lift 5.1 N
    config = hil.HilConfig(actor="kidney", link="crsf", device="/dev/null", **drone)
    contract = hil.make_flyer(config)[1]
    with pytest.raises(ValueError, match=r"voltage_tolerance=0.25: it would accept a reading of 11.25 V. .*must lift"):
        hil.link_config(config, contract, 25.0)
    config.voltage_tolerance = 0.15
    assert hil.link_config(config, contract, 25.0).thrust.voltage == 15.0
    config.link, config.voltage_tolerance = "sbus", 0.25  # hears nothing
    assert hil.link_config(config, contract, 25.0).thrust.voltage == 15.0 and flights.battery_config(config) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"readings": 0}, "no usable reading; thrust was computed with voltage=15.8"),
        ({}, "15.12 V at the end, from 9 readings"),
        ({"last_reading_age_s": 3.04}, "15.12 V at the end, from 9 readings, the last one 3.0 s before the end: STALE"),
        ({"implausible": 2}, "15.12 V at the end, from 9 readings, 2 implausible ones ignored"),
    ],
)
def test_battery_readings_are_reported(changes, words):
    battery = {"voltage_set": 15.8, "voltage": 15.12, "readings": 9, "implausible": 0, "last_reading_age_s": 0.1}
    assert battery_words(battery | changes) == f"battery: {words}"


BROKEN = """
from dreamer_racing.hil.chain import FlightChain
tick, ticks = FlightChain.tick, []
def broken(self, inputs):
    ticks.append(inputs)
    if len(ticks) > 5:
        raise ValueError("planted")
    return tick(self, inputs)
FlightChain.tick = broken
"""


def test_a_defect_in_flight_shows_as_one_and_the_vehicle_is_disarmed_all_the_same(tmp_path):
    """Of the same kind as errors that a person can mend: those before the flight are a paragraph."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(1.0)
        ports = f"link_port={vehicle.getsockname()[1]}", f"pose_port={free_port()}"
        ended = recipe("hil", "actor=circle", f"run_dir={tmp_path / 'run'}", *ports, cwd=tmp_path, before=BROKEN)
        heard = [decode_command(vehicle.recv(200)) for _ in range(5 + 50)]
    assert ended.returncode == 1 and "Traceback" in ended.stderr and "ValueError: planted" in ended.stderr
    assert "error:" not in ended.stderr
    assert not any(packet.command.armed for packet in heard)  # five ticks, and a second of disarm frames
    flown = Flight(tmp_path / "run")
    assert flown.whole and len(flown.ticks) == 5


def test_what_a_person_can_mend_is_said_in_a_paragraph(tmp_path, monkeypatch):
    monkeypatch.delenv("SSH_CONNECTION", raising=False)
    ended = recipe("hil", "actor=circle", "link=crsf", "operator=keyboard", cwd=tmp_path)
    assert ended.returncode == 2 and ended.stderr.startswith("error: mass= is missing: link=crsf"), ended.stderr


def standing_at(time: float, sequence: int = 0) -> Received:
    place, level, zero = np.array((4.0, -2.5, 1.35)), np.array((1.0, 0.0, 0.0, 0.0)), np.zeros(3)
    return Received(time, PosePacket(sequence, time - 10.0, place, level, zero, zero))


def test_a_flight_depends_on_no_file_of_its_track(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text((ROOT / "dreamer_racing/envs/tracks/circle.yaml").read_text())
    config = hil.HilConfig(actor="pilot", track=str(path), run_dir=str(tmp_path / "run"), pose_port=free_port())
    with ExitStack() as opened:
        flight = hil.prepare(config, opened)
        pose = standing_at(10.0)
        for tick in range(3):
            inputs = Inputs(10.0 + 0.02 * tick, [pose][tick:], Operator(False, False), 0)
            message = {"in": describe_inputs(inputs), "out": describe_outputs(flight.chain.tick(inputs))}
            flight.loop._recorder.tick(inputs.time, message)
    path.write_text(path.read_text().replace("4.0", "5.0"))
    assert load_track(str(path)) != flight.track
    assert Flight(tmp_path / "run").track() == flight.track
    assert hil.replay(hil.HilConfig(replay=str(tmp_path / "run"))) == 0
    path.unlink()
    assert hil.replay(hil.HilConfig(replay=str(tmp_path / "run"))) == 0


def test_a_replay_says_at_which_tick_it_parts(tmp_path, capsys):
    config = hil.HilConfig(actor="circle", record=True)
    flyer, _ = hil.make_flyer(config)
    chain = hil.make_chain(config, flyer, hil.load_track("circle"))
    about = {"config": hil.as_json(config), TRACK: describe_track(load_track("circle"))}
    with (
        FlightRecorder(tmp_path / "right" / FILE, about) as right,
        FlightRecorder(tmp_path / "wrong" / FILE, about) as wrong,
    ):
        for index in range(5):
            now = 10.0 + 0.04 * index
            inputs = Inputs(now, [standing_at(now, index)], Operator(False, False), 0)
            out = describe_outputs(chain.tick(inputs))
            message = {"in": describe_inputs(inputs), "out": out}
            right.tick(inputs.time, message)
            wrong.tick(inputs.time, message | {"out": out | ({"target_gate": 3} if index == 3 else {})})
    chain.close()
    assert hil.replay(hil.HilConfig(replay=str(tmp_path / "right"))) == 0
    assert "replayed: 5 ticks, all equal to the recording" in capsys.readouterr().out
    assert hil.replay(hil.HilConfig(replay=str(tmp_path / "wrong"))) == 1
    assert "tick 3: target_gate was 3, and is 0 now" in capsys.readouterr().err


def test_without_a_plant_it_says_how_to_start_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    config = hil.HilConfig(
        actor="pilot", track="circle", preset="easy", record=False, run_dir=str(tmp_path),
        pose_port=free_port(), link_port=free_port(),
    )  # fmt: skip
    with ExitStack() as opened:
        hil.prepare(config, opened)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "if no vehicle sends any" in line)
    assert line.endswith("python recipes/plant.py track=circle preset=easy")
