"""What flies: an actor's contract, sticks, and flights by the IMU."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.envs import tracks
from dreamer_racing.envs.drone.parameters import load_preset, save_drone
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.export.contract import describe_rate_loop
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.chain import ChainConfig, FlightChain, describe_outputs, read_inputs
from dreamer_racing.hil.configuration import imu_note
from dreamer_racing.hil.flyer import (
    Flyer,
    check_contract,
    check_flown_by_betaflight,
    check_ranges,
    check_rate_loop,
    trained_track,
)
from dreamer_racing.hil.recording import FILE, Flight, FlightRecorder
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.sticks import RateMap, ThrustMap, channels
from dreamer_racing.hil.vehicle import GRAVITY, Command, Setpoint, hover
from dreamer_racing.plant.lock_step import LockStep
from dreamer_racing.plant.vehicle import PlantVehicle

AGENTS = Path(__file__).parents[2] / "agents"
CIRCLE = load_track("circle")


def contract_of(agent: str) -> dict:
    return read_contract(AGENTS / agent / "contract.json")


@pytest.mark.parametrize("agent", ["kidney", "circle", "figure8"])
def test_agents_that_ship_fit_their_tracks(agent):
    track = load_track(agent)
    check_contract(contract_of(agent), track, 25.0)
    assert check_ranges(contract_of(agent), SafetyLimits.of_track(track)) == []


def test_a_contract_that_does_not_fit_is_refused_with_what_differs():
    contract, kidney = contract_of("kidney"), load_track("kidney")
    words = r"source.track is 'kidney', whose .*, but .* track=circle .*; control.rate_hz is 25, but rate=50"
    with pytest.raises(ValueError, match=words):
        check_contract(contract, CIRCLE, 50.0)
    with pytest.raises(ValueError, match=r"camera gives images of \[1, 96, 64, 3\], but the input image_u8 is"):
        check_contract({**contract, "camera": {**contract["camera"], "height_px": 96}}, kidney)


def test_a_track_is_known_by_its_gates_not_by_its_name(tmp_path):
    contract, file = contract_of("circle"), tmp_path / "mine.yaml"
    built_in = (Path(tracks.__file__).parent / "circle.yaml").read_text(encoding="utf-8")
    file.write_text(built_in, encoding="utf-8")
    check_contract(contract, load_track(file))  # the same, in a file of another name
    file = tmp_path / "circle.yaml"
    file.write_text(built_in.replace("4.0", "4.1"), encoding="utf-8")
    with pytest.raises(ValueError, match="source.track is 'circle', whose gates, .* but those of track=circle have"):
        check_contract(contract, load_track(file))
    del contract["source"]["track_sha256"]
    with pytest.raises(ValueError, match="it lacks source.track_sha256"):
        check_contract(contract, CIRCLE)


def test_what_safety_would_clip_is_refused_unless_it_is_meant():
    contract, limits = contract_of("circle"), SafetyLimits.of_track(CIRCLE)
    assert check_ranges(contract, limits) == []
    for channel in contract["action"]["channels"]:
        channel["scale"], channel["offset"] = 1.6 * channel["scale"], 1.6 * channel["offset"]
    with pytest.raises(
        ValueError,
        match=r"limits.rate_max=\[10,10,4\] clips the actor, .* up to \[16,16,6.4\] rad/s .* Set limits.rate_max=\[16",
    ):
        check_ranges(contract, limits)
    with pytest.raises(ValueError, match=r"limits.thrust_max=30 clips the actor, which asks for up to 42.\d+ m/s²"):
        check_ranges(contract, replace(limits, rate_max=(16.0, 16.0, 6.4)))
    said = check_ranges(contract, limits, user_limits=("rate_max", "thrust_max"))
    names = [words.partition("=")[0].removeprefix("limits.") for words in said]
    assert names == ["rate_max", "thrust_max", "rate_slew", "thrust_slew"]


def test_swings_that_the_limits_on_changes_clip_are_noted():
    contract, limits = contract_of("circle"), SafetyLimits.of_track(CIRCLE)
    contract["control"]["rate_hz"] = 50.0
    said = check_ranges(contract, limits)
    assert said == [
        "limits.rate_slew=500 allows changes of 10 rad/s a control step at 50 Hz, and the actor may ask for 20: "
        "limits.rate_slew=1000 clips nothing",
        "limits.thrust_slew=700 allows changes of 14 m/s² a control step at 50 Hz, and the actor may ask for 26.7: "
        "limits.thrust_slew=1333 clips nothing",
    ]
    wide = replace(limits, rate_slew=1000.0, thrust_slew=1333.0)
    assert check_ranges(contract, wide) == []
    assert check_ranges(contract, replace(wide, thrust_min=8.0)) == [
        "limits.thrust_min=8 clips the actor, which asks for as little as 0"
    ]


def test_actions_in_another_order_are_refused():
    contract = contract_of("circle")
    contract["action"]["channels"].reverse()
    with pytest.raises(ValueError, match=r"action.channels are body_rate_z, .*, not collective_thrust, body_rate_x, "):
        check_contract(contract, CIRCLE)


@pytest.mark.parametrize(
    ("link", "delay", "said"),
    [("msp", 1, 0), ("udp", 0, 0), ("msp", 0, 1), ("udp", 1, 1), ("betaflight_sitl", 1, 0), ("mavlink", 1, 0)],
)
def test_imu_samples_of_another_age_than_in_training_are_noted(link, delay, said):
    notes = imu_note({"imu": {"trained_errors": {"delay": delay}}}, link)
    assert len(notes) == said and all(f"they were {delay} control steps old" in words for words in notes)
    assert imu_note({}, link) == []


def trained_with(preset: str, **changed: Any) -> dict[str, Any]:
    """What a contract says of an actor of a preset."""
    return {"rate_loop": describe_rate_loop(replace(load_preset(preset), **changed))}


def test_an_actor_of_another_rate_loop_is_refused_with_both_and_flies_if_forced(tmp_path):
    words = r"trained with a proportional rate loop, but vehicle=betaflight has a Betaflight's rate loop.*force=true"
    with pytest.raises(ValueError, match=words):
        check_rate_loop(trained_with("faithful"), "betaflight", force=False)
    with pytest.raises(ValueError, match="trained with a Betaflight's rate loop, but vehicle=easy has a proportional"):
        check_rate_loop(trained_with("betaflight"), "easy", force=False)
    forced = check_rate_loop(trained_with("faithful"), "betaflight", force=True)
    assert forced is not None and forced.endswith("it flies anyway (force=true)")
    assert check_rate_loop(trained_with("easy"), "faithful", force=False) is None
    assert check_rate_loop(trained_with("betaflight"), "betaflight", force=False) is None
    old = {"source": {"preset": "easy"}}
    with pytest.raises(ValueError, match="trained with a proportional rate loop"):
        check_rate_loop(old, "betaflight", force=False)
    unknown = check_rate_loop({"source": {"preset": "mine"}}, "betaflight", force=False)
    assert unknown is not None and "does not describe a rate loop" in unknown


@pytest.mark.parametrize("name", sorted(path.parent.name for path in AGENTS.glob("*/contract.json")))
def test_every_included_agent_is_compared_with_a_vehicle(name):
    contract = read_contract(AGENTS / name / "contract.json")
    preset = contract["source"]["preset"]
    assert check_rate_loop(contract, preset, force=False) is None
    with pytest.raises(ValueError, match="was trained with"):
        check_rate_loop(contract, "easy" if preset == "betaflight" else "betaflight", force=False)


def test_a_link_to_a_betaflight_is_for_actors_of_its_rate_loop():
    words = r"trained with a proportional rate loop, but link=crsf commands a Betaflight.*env=betaflight.*force=true"
    for contract in (trained_with("faithful"), {"source": {"preset": "easy"}}):
        with pytest.raises(ValueError, match=words):
            check_flown_by_betaflight(contract, "crsf", force=False)
    forced = check_flown_by_betaflight(trained_with("easy"), "crsf", force=True)
    assert forced is not None and forced.endswith("it flies anyway (force=true)")
    for contract in (trained_with("betaflight"), {"source": {"preset": "mine"}}):
        assert check_flown_by_betaflight(contract, "crsf", force=False) is None


@pytest.mark.parametrize(
    ("gains", "lag", "words"),
    [
        ((45.0, 47.0 * 1.25, 30.0), 0.03, None),  # within the widths of training, and what is allowed beyond them
        ((45.0, 47.0 * 1.35, 30.0), 0.03, r"p of pitch 47 \(± 20%\), but vehicle=.* has p of pitch 63.45"),
        ((45.0, 47.0, 30.0), 0.05, r"motor lag of 0.03 s \(± 30%\), but vehicle=.* has a motor lag of 0.05 s"),
    ],
)
def test_gains_and_motors_may_differ_as_far_as_those_of_training_did(gains, lag, words, tmp_path):
    nominal = load_preset("betaflight")
    vehicle = replace(nominal, motor_time_constant=lag, betaflight=replace(nominal.betaflight, p=gains))
    save_drone(tmp_path / "drone.yaml", vehicle, {})
    contract, file = trained_with("betaflight"), str(tmp_path / "drone.yaml")
    if words is None:
        assert check_rate_loop(contract, file, force=False) is None
        return
    with pytest.raises(ValueError, match=words):
        check_rate_loop(contract, file, force=False)
    assert check_rate_loop(contract, file, force=True) is not None


# Sticks: signs, scales and clamps against values worked out by hand, and every map against its inverse.


RATES = RateMap(roll=10.0, pitch=8.0, yaw=4.0)
THRUST = ThrustMap(mass=0.6, full_thrust=16.0, reference_voltage=15.0, voltage=15.0)


def armed(thrust: float = GRAVITY, rates: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Command:
    return Command(True, Setpoint(thrust, np.array(rates)))


def test_hover_of_the_projects_drone():
    """motor² · 16 N = 0.6 kg · 9.81 m/s², and the throttle by Betaflight's formula."""
    motor = math.sqrt(0.6 * 9.81 / 16.0)
    assert motor == pytest.approx(0.6065, abs=1e-4)  # .607 in Betaflight's own simulation
    assert THRUST.to_motor(9.81) == pytest.approx(motor)
    microseconds = 1050 + (motor - 0.055) / 0.945 * 950
    assert microseconds == pytest.approx(1604.45, abs=0.01)
    assert channels(Command(True, hover()), RATES, THRUST) == pytest.approx(
        [1500, 1500, microseconds, 1500, 2000, *[1000] * 11]
    )


def test_throttle_of_the_firmware():
    """At 1500 µs real firmware runs its motors at .502."""
    assert THRUST.to_sticks(0.5026**2 * 16.0 / 0.6) == pytest.approx(0.5, abs=1e-3)
    assert THRUST.to_sticks(0.055**2 * 16.0 / 0.6) == pytest.approx(0.05), "idle"
    assert THRUST.to_sticks(16.0 / 0.6) == pytest.approx(1.0)


def test_a_flat_battery_needs_more_throttle():
    low = replace(THRUST, voltage=13.5)
    assert low.to_motor(9.81) == pytest.approx(THRUST.to_motor(9.81) / 0.9)
    assert low.to_sticks(0.9 * 16.0 / 0.6) == 1.0  # more than there is left


@given(
    mass=st.floats(0.1, 1.0),
    voltage=st.floats(12, 17),
    idle=st.floats(0, 0.2),
    min_check=st.floats(1000, 1200),
    throttle=st.floats(0.21, 1.0),
)
def test_a_throttle_makes_the_thrust_that_it_is_for(mass, voltage, idle, min_check, throttle):
    motor = idle + (1 - idle) * (1000 + 1000 * throttle - min_check) / (2000 - min_check)
    thrust = 20.0 * (voltage / 15.0) ** 2 * motor**2 / mass
    assert ThrustMap(mass, 20.0, 15.0, voltage, idle, min_check).to_sticks(thrust) == pytest.approx(throttle, abs=1e-9)


@given(
    thrust=st.floats(-1e6, 1e6),
    rates=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    is_armed=st.booleans(),
    arm_channel=st.integers(4, 15),
)
def test_channels_stay_within_their_ends(thrust, rates, is_armed, arm_channel):
    values = channels(Command(is_armed, Setpoint(thrust, np.array(rates))), RATES, THRUST, arm_channel)
    assert len(values) == 16 and min(values) >= 1000.0 and max(values) <= 2000.0
    assert [index for index, value in enumerate(values[4:], 4) if value != 1000.0] == [arm_channel] * is_armed


def test_order_of_channels():
    """Roll, pitch, throttle, yaw; by Betaflight's default map AETR1234; see `links/test_sitl.py`."""
    values = channels(armed(16.0 / 0.6, (10.0, -8.0, 2.0)), RATES, THRUST)
    assert values == (2000, 1000, 2000, 1250, 2000, *[1000] * 11)


@pytest.mark.parametrize(
    ("right", "changes", "message"),
    [
        (RATES, {"roll": 0.0}, "RateMap.roll="),
        (RATES, {"pitch": math.nan}, "RateMap.pitch="),
        (RATES, {"yaw": 573.0}, "RateMap.yaw="),  # 10 rad/s, in deg/s
        (THRUST, {"mass": 0.0}, "ThrustMap.mass=0.0: must be above 0"),
        (THRUST, {"mass": 600.0}, "ThrustMap.full_thrust=16.0 N: must lift mass=600.0 kg"),
        (THRUST, {"full_thrust": 4.0}, "ThrustMap.full_thrust=4.0 N: .* all motors together"),
        (THRUST, {"voltage": 3.75}, "ThrustMap.voltage=3.75 V: must be between 7.5 and 22.5 V"),
        (THRUST, {"idle": 5.5}, "ThrustMap.idle=5.5: must be at least 0 and at most 0.2"),
        (THRUST, {"min_check": 50.0}, "ThrustMap.min_check=50.0: must be at least 1000"),
    ],
)
def test_drones_that_are_none(right, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(right, **changes)


# Flights of flyers that need what the IMU tells: told, played back, and cut where it is told no longer.


class Feeling(Flyer):
    """Damps by the gyro, so that every sample shows in what it wants."""

    rate, camera, needs_imu = 50.0, None, True
    told: ClassVar[list[np.ndarray]] = []

    def reset(self) -> None:
        self.told.clear()

    def act(self, pose, image, target_gate, imu=None) -> Setpoint:
        assert imu is not None
        self.told.append(imu)
        return Setpoint(GRAVITY + 0.5 - 0.01 * (imu[5] - GRAVITY), 0.3 - imu[:3])


def make(**limits: float) -> tuple[LockStep, FlightChain]:
    plant = LockStep(PlantVehicle(CIRCLE, "easy"))
    config = ChainConfig(SafetyLimits.of_track(CIRCLE, **limits), arm=True)
    return plant, FlightChain(Feeling(), CIRCLE, config)


def test_a_flight_is_told_what_the_plant_feels_and_plays_back_bit_for_bit(tmp_path) -> None:
    plant, chain = make()
    samples, read_imu = [], plant.plant.vehicle.read_imu
    plant.plant.vehicle.read_imu = lambda: samples.append(read_imu()) or samples[-1]
    with FlightRecorder(tmp_path / FILE, {}) as recorder:
        plant.fly(chain, 50.0, 2.5, recorder)
    told = np.stack(Feeling.told)
    assert len(told) > 30
    assert np.array_equal(told, samples[-len(told) :])
    assert np.abs(told[-1, :3] - 0.15).max() < 0.05, "half of 0.3 rad/s, as it damps itself"
    assert told[-1, 5] == pytest.approx(GRAVITY + 0.5, abs=0.1)
    again = make()[1]
    again.warm_up()
    for tick in Flight(tmp_path).ticks:
        outputs = json.loads(json.dumps(describe_outputs(again.tick(read_inputs(tick["in"])))))
        assert json.dumps(outputs) == json.dumps(tick["out"])


def test_without_samples_it_does_not_arm_and_in_flight_it_is_cut() -> None:
    plant, chain = make()
    plant.read_imu = list
    assert "it needs IMU samples, and none has arrived" in plant.fly(chain, 50.0, 1.0)
    plant, chain = make()
    read_imu = plant.read_imu
    plant.read_imu = lambda: read_imu() if plant.elapsed < 2.0 else []
    assert plant.fly(chain, 50.0, 5.0).startswith("cut: the actor has given no usable setpoint for 0.1")
    assert 2.0 < plant.elapsed - 1.0 < 2.3, "s, and a second of farewell"


def test_an_accelerometer_of_another_scale_is_refused_on_the_ground() -> None:
    plant, chain = make()
    read_imu = plant.plant.vehicle.read_imu
    plant.plant.vehicle.read_imu = lambda: read_imu() * np.array((1.0, 1.0, 1.0, 0.5, 0.5, 0.5))
    assert "its accelerometer reads 4.91 m/s² at rest" in plant.fly(chain, 50.0, 1.0)


def test_an_actor_of_no_track_asks_for_one():
    with pytest.raises(ValueError, match="names no track .* give track="):
        trained_track({"source": {}})
