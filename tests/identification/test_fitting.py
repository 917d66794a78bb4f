"""Drones found from flights: simulated and recorded ones."""

from __future__ import annotations

import csv
import gzip
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dreamer_racing.envs.drone.parameters import GRAVITY, PRESETS
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.configuration import thrust_map
from dreamer_racing.hil.identify import IdentificationFlyer
from dreamer_racing.hil.recording import FILE, FlightRecorder
from dreamer_racing.hil.safety import SafetyLimits
from dreamer_racing.identification import fitting
from dreamer_racing.identification.fitting import EVERY, PARAMETERS, Model, apply, fit
from dreamer_racing.identification.recorded import (
    DT,
    Recorded,
    of_flight,
    rates_between,
    read_recorded,
    stretches,
)
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import LockStep
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle

NOMINAL = replace(PRESETS["betaflight"], randomisation=None)
HIDDEN = {"p_roll": 0.75, "p_pitch": 1.3, "p_yaw": 1.2, "d_roll": 0.8, "d_pitch": 1.2, "motor_lag": 1.35, "delay": 0.01}
NAMES = [parameter.name for parameter in PARAMETERS]


def commands(stretches: int) -> Recorded:
    """Random commands of stretches of 1.1 s, each from rest, with a gap behind each."""
    random, length = np.random.default_rng(0), round(fitting.STRETCH / DT)
    command = np.zeros((stretches * (length + 1), 4))
    fresh = np.zeros(len(command), bool)
    for begin in range(0, len(command), 10):
        if begin % 70 == 0:
            scale = (3.0, 2.0, 2.0, 1.0)
            present = np.array((10.0, 0.0, 0.0, 0.0)) + scale * random.uniform(-1.0, 1.0, 4)
        command[begin : begin + 10], fresh[begin] = present, True
    rates = np.zeros((len(command), 3))
    rates[length :: length + 1] = np.nan
    return Recorded(command, fresh, rates, np.full(len(command), np.nan))


def candidate(values: dict[str, float]) -> torch.Tensor:
    """The numbers (1, P) of relative values."""
    return torch.tensor(
        [[values.get(name, 0.0) if name == "delay" else math.log(values.get(name, 1.0)) for name in NAMES]],
        dtype=torch.float64,
    )


def flown_by(values: dict[str, float], stretches: int, yaw: bool = True) -> Recorded:
    """What a drone of such values answers to the commands, of yaw or without."""
    asked = commands(stretches)
    asked.command[:, 3] *= yaw
    length = round(fitting.STRETCH / DT)
    parts = [slice(begin, begin + length) for begin in range(0, len(asked.command) - length, length + 1)]
    flown = Model(NOMINAL, asked, parts, 1).fly(candidate(values))
    rates = asked.rates.copy()
    for index, part in enumerate(parts):
        rates[part] = flown.rates[:, 0, index].repeat_interleave(EVERY, 0).numpy()  # the last of each is compared
        rates[part.start] = 0.0
    return replace(asked, rates=rates)


def test_the_fit_finds_what_the_model_was_given() -> None:
    found = fit(flown_by(HIDDEN, 8), NOMINAL)
    for name, value in HIDDEN.items():
        assert found.values[name] == pytest.approx(value, abs=0.002 if name == "delay" else 0.05), name
    assert max(found.errors.values()) < 0.02 < min(found.before.values())


def test_what_is_asked_for_nowhere_stays_and_is_said() -> None:
    """Nothing is asked about yaw."""
    quiet = flown_by(HIDDEN, 4, yaw=False)
    noise = 0.1 * np.random.default_rng(0).standard_normal(quiet.rates.shape)  # rad/s
    found = fit(replace(quiet, rates=quiet.rates + noise), NOMINAL)
    assert "i_yaw" in found.unknown
    assert "p_roll" not in found.unknown


def test_found_numbers_become_a_drone() -> None:
    drone = apply(NOMINAL, {**dict.fromkeys(NAMES, 1.0), "delay": 0.004, "p_roll": 2.0, "d_pitch": 0.5}, thrust=0.8)
    before, after = NOMINAL.betaflight, drone.betaflight
    assert before is not None and after is not None
    assert after.p[0] == pytest.approx(2.5 * before.p[0])
    assert after.d[1] == pytest.approx(0.625 * before.d[1]) and after.d_max[1] == pytest.approx(
        0.625 * before.d_max[1], rel=1e-3
    )
    assert drone.rotor_thrust_max == pytest.approx(0.8 * NOMINAL.rotor_thrust_max)
    assert drone.command_delay == pytest.approx(NOMINAL.command_delay + 0.004)


def test_other_rate_loops_and_recordings_full_of_gaps_are_refused() -> None:
    with pytest.raises(ValueError, match="start from preset=betaflight"):
        fit(commands(2), PRESETS["easy"])
    asked = commands(2)
    with pytest.raises(ValueError, match="are without a gap"):
        fit(replace(asked, rates=np.full_like(asked.rates, np.nan)), NOMINAL)


@pytest.mark.slow
@pytest.mark.parametrize(("pose", "tolerance"), [("udp", 0.1), ("ros2", 0.15)], ids=["body rates", "attitudes only"])
def test_a_drone_that_is_hidden_in_the_plant_is_found_from_its_flight(
    pose: str, tolerance: float, tmp_path: Path
) -> None:
    hidden = apply(NOMINAL, {**dict.fromkeys(NAMES, 1.0), **HIDDEN})
    track = load_track("circle")
    motion_capture = Delivery(rate=200.0, jitter=0.002, packet_loss=0.01, position_noise=0.001, attitude_noise=0.003)
    plant, flyer = LockStep(PlantVehicle(track, hidden, Mismatch(thrust=0.9)), motion_capture), IdentificationFlyer()
    chain = FlightChain(flyer, track, ChainConfig(SafetyLimits.of_track(track, still_time=3600.0), arm=True))
    with FlightRecorder(tmp_path / FILE, {"config": {"latency": 0.0, "pose": pose}}) as recorder:
        assert plant.fly(chain, flyer.rate, flyer.duration + 3.0, recorder).endswith("s are over")
    recorded = read_recorded(tmp_path)
    recorded.check(tmp_path)
    found = fit(recorded, NOMINAL)
    for name in ("p_roll", "p_pitch", "p_yaw"):
        assert found.values[name] == pytest.approx(HIDDEN[name] * 0.9, rel=tolerance), name
    assert found.values["motor_lag"] == pytest.approx(HIDDEN["motor_lag"], rel=tolerance)
    assert found.values["delay"] == pytest.approx(HIDDEN["delay"], abs=0.003)
    assert found.thrust == pytest.approx(0.9, abs=0.02)
    if pose == "udp":  # else the errors are mostly noise of the attitudes
        fitted = zip(found.errors.values(), found.before.values(), strict=True)
        assert all(after < 0.5 * before for after, before in fitted)


# Recordings on their grid: by hand, and what is refused.


COLUMNS = ("t", "thrust_cmd", "wx_cmd", "wy_cmd", "wz_cmd", "wx", "wy", "wz")


def recorded(seconds: float, amplitude: float = 2.0) -> Recorded:
    """Commands that change every 0.1 s on all axes, and rates that are those."""
    count = round(seconds / DT)
    time = DT * np.arange(count)
    signs = np.sign(np.sin(2 * np.pi * time / 0.2 + 0.01))
    command = np.column_stack((GRAVITY + amplitude * signs, *(3 * (amplitude * signs,))))
    fresh = np.concatenate(([True], np.diff(signs) != 0))
    return Recorded(command, fresh, command[:, 1:].copy(), command[:, 0].copy())


def test_a_recording_that_tells_enough_passes() -> None:
    recorded(5.0).check("this one")
    assert recorded(5.0).excited_seconds() == (5.0, 5.0, 5.0, 5.0)


def test_what_is_too_short_or_too_quiet_says_which_axis_needs_what() -> None:
    with pytest.raises(ValueError, match=r"this one is too short or too quiet: yaw was excited for 2 s, but needs 3 s"):
        recorded(2.5).check("this one")
    quiet = recorded(5.0)
    quiet.command[:, 1] = 0.01
    with pytest.raises(
        ValueError, match=r"quiet: roll was excited for 0 s, but needs 2 s .* at least 0.4 rad/s"
    ) as raised:
        quiet.check("this one")
    assert "pitch" not in str(raised.value) and "actor=identify" in str(raised.value)
    blind = recorded(5.0)
    blind.rates[:] = np.nan
    with pytest.raises(ValueError, match="roll was excited for 0 s"):
        blind.check("this one")


def test_stretches_have_no_gap_and_begin_behind_one() -> None:
    flown = recorded(2.0)
    flown.rates[700] = np.nan
    assert stretches(flown, 0.5, 0.1) == [slice(0, 500), slice(701, 1201), slice(1101, 1601), slice(1501, 2001)][:3]


def test_a_table_is_read_on_its_grid(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for index in range(300):
            command = (GRAVITY, 1.0, 0.0, 0.0) if index < 100 else (12.0, -1.0, 0.5, 0.2)
            rates = (0.001 * index, 0.0, 0.0) if index != 200 else (9.0, 0.0, 0.0)
            writer.writerow((5.0 + DT * index, *command, *rates))
    read = read_recorded(path)
    assert len(read.command) in (299, 300)
    assert read.command[99].tolist() == [GRAVITY, 1.0, 0.0, 0.0]
    assert read.command[101].tolist() == [12.0, -1.0, 0.5, 0.2]
    assert read.fresh.sum() == 2
    assert np.isnan(read.force).all()
    assert np.isnan(read.rates[199:202]).any(1).sum() >= 1, "nothing flies from 0.2 to 9 rad/s in a ms"
    assert read.rates[150, 0] == pytest.approx(0.15, abs=0.002)
    with pytest.raises(FileNotFoundError, match="no recording"):
        read_recorded(tmp_path / "none.csv")
    with open(path, "a") as file:
        file.write("5.3,9.81,0,0,0,nan,0,0\n")
    assert len(read_recorded(path).command) in (299, 300, 301), "NaN: it was not measured"
    with open(path, "a") as file:
        file.write("6.0,1.0\n")
    with pytest.raises(ValueError, match=r"line 303: wx_cmd is None, not a finite number"):
        read_recorded(path)
    cut = tmp_path / "cut.csv.gz"
    cut.write_bytes(gzip.compress(path.read_bytes())[:-20])
    with pytest.raises(ValueError, match=r"cut.csv.gz is cut off"):
        read_recorded(cut)
    path.write_text("t,wx\n0,0\n")
    with pytest.raises(ValueError, match="lacks thrust_cmd, wx_cmd"):
        read_recorded(path)


class Flown:
    """A flight by hand: it hovers, tilted, and is sent two commands; poses come 30 ms late."""

    about: dict = {"config": {"latency": 0.03}}

    def __init__(self, armed: bool = True) -> None:
        tilted = (np.cos(0.2), np.sin(0.2), 0.0, 0.0)  # 0.4 rad
        self.ticks = []
        for index in range(100):
            now = 1000.0 + 0.01 * index
            packets = [
                [now + 0.03, 2 * index + part, 5.0 + 0.01 * index + 0.005 * part, 0.0, 0.0, 1.0, *tilted,
                 0.0, 0.0, 0.0, 0.1 * index, 0.0, 0.0]
                for part in range(2)
            ]  # fmt: skip
            self.ticks.append({
                "in": {"time": now, "received": packets},
                "took": {"sent": 0.001},
                "out": {"command": [armed, 10.0 if index < 50 else 11.0, 1.0, 2.0, 3.0]},
            })  # fmt: skip


def test_a_flight_is_read_by_the_clock_of_its_loop() -> None:
    read = of_flight(Flown())
    assert read.command[0].tolist() == [10.0, 1.0, 2.0, 3.0]
    changed = int(np.flatnonzero(read.command[:, 0] == 11.0)[0])
    assert changed == pytest.approx(500, abs=1)
    assert read.fresh.sum() >= 95
    # a pose that arrives at t was measured at t - 0.03 at the latest
    assert read.rates[510, 0] == pytest.approx(5.1, abs=0.2)
    assert np.nanmean(read.force) == pytest.approx(GRAVITY * np.cos(0.4), rel=0.01)
    with pytest.raises(ValueError, match="never armed"):
        of_flight(Flown(armed=False))


def test_poses_without_body_rates_give_rates_that_do_not_lag() -> None:
    """A vehicle that turns to and fro about z; of its 200 poses a second some are lost, and once all for 0.2 s."""
    time = np.arange(400) / 200.0
    time = time[(np.random.default_rng(0).random(400) > 0.1) & ~((time > 1.0) & (time < 1.2))]
    angle = np.sin(10.0 * time)
    attitude = np.stack((np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)), 1)
    middle, found = rates_between(time, attitude)
    np.testing.assert_allclose(found[:, 2], 10.0 * np.cos(10.0 * middle), atol=0.1)
    assert not found[:, :2].any() and not ((middle > 1.03) & (middle < 1.17)).any()


def test_mass_and_thrust_are_those_of_the_flight() -> None:
    config = {"mass": 0.7, "full_thrust": 30.0, "reference_voltage": 16.0, "voltage": 14.4}
    drone = replace(commands(1), thrust_map=thrust_map(config)).drone(NOMINAL)
    assert (drone.mass, 4 * drone.rotor_thrust_max) == pytest.approx((0.7, 30.0 * 0.9**2))
    assert thrust_map({**config, "mass": None}) is None and commands(1).drone(NOMINAL) == NOMINAL
