"""The rate loop, and drones that differ."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dreamer_racing.envs.drone.betaflight import BetaflightParameters, full_stick
from dreamer_racing.envs.drone.parameters import GRAVITY, PRESETS, load_preset, save_drone
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rate_loop import DroneParameter, RateLoop, Row
from tests.running_recipes import module_of
from tests.torch_flight import wrench

DRONE = replace(PRESETS["betaflight"], randomisation=None)
HOVER = DRONE.mass * GRAVITY
STILL = torch.zeros(1, 3, dtype=torch.float64)


def asked(thrust: float = HOVER, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    return torch.tensor([[thrust, roll, pitch, yaw]], dtype=torch.float64)


def motors(loop: RateLoop, setpoint: torch.Tensor, rates: torch.Tensor = STILL, steps: int = 1) -> list[float]:
    for _ in range(steps):
        commands = loop.motor_commands(setpoint, rates)
    return commands[0].tolist()


def test_throttle_means_thrust_to_a_microsecond() -> None:
    """A motor's thrust is that of its command squared; one of 950 µs is 0.1 % of the command."""
    for thrust in (1.0, HOVER, 15.9):
        commands = motors(RateLoop(DRONE, 1), asked(thrust))
        assert commands == pytest.approx([math.sqrt(thrust / 16.0)] * 4, abs=0.945 / 950 / 2 + 1e-9)
    assert motors(RateLoop(DRONE, 1), asked(0.0)) == pytest.approx([0.055] * 4)


def test_full_stick_is_the_next_ten_degrees() -> None:
    assert [full_stick(rate) for rate in DRONE.body_rate_max] == [580.0, 580.0, 230.0]


def test_a_step_of_roll_gives_what_the_firmware_gave() -> None:
    """300 deg/s to the left at hover; the recording has 1.0, 0.999, 0.180, 0.181 (26.212 s)."""
    left = asked(roll=math.radians(-259 / 500 * 580.0))
    assert motors(RateLoop(DRONE, 1), left) == pytest.approx([1.0, 1.0, 0.181, 0.181], abs=0.002)


def test_air_mode_moves_the_throttle_so_that_the_correction_fits() -> None:
    """Full correction takes all of the motors' range, whatever the throttle: it gives thrust up, or takes it."""
    for thrust in (0.0, HOVER, 16.0):
        commands = motors(RateLoop(DRONE, 1), asked(thrust, roll=10.0))
        assert commands == pytest.approx([0.055, 0.055, 1.0, 1.0])


def test_channels_are_held_until_the_next_frame() -> None:
    loop = RateLoop(DRONE, 1)
    before = motors(loop, asked())
    late = [motors(loop, asked(roll=3.0)) for _ in range(10)]
    assert loop.frame_steps == 10
    assert all(commands == pytest.approx(before) for commands in late[:9])
    assert late[9][2] > before[2] + 0.05  # to the right: the left motors turn faster


def test_integrals_stay_within_what_windup_leaves_them() -> None:
    """Three drones, each turning about an axis of its own."""
    loop = RateLoop(replace(DRONE, betaflight=BetaflightParameters(i=(250.0, 250.0, 250.0))), 3)
    setpoint = torch.cat([asked(0.0, *(4.0 * float(axis == turned) for axis in range(3))) for turned in range(3)])
    for _ in range(3000):
        loop.motor_commands(setpoint, STILL.expand(3, 3))
    assert loop.state[:, Row.I].diagonal().tolist() == pytest.approx([400.0, 400.0, 320.0])


def test_d_acts_against_the_gyro_and_not_on_setpoints() -> None:
    """D on measurement: without P and I, a setpoint does nothing, and a growing rate is braked."""
    no_p = BetaflightParameters(p=(0.0, 0.0, 0.0), i=(0.0, 0.0, 0.0))
    loop = RateLoop(replace(DRONE, betaflight=no_p), 1)
    level = motors(loop, asked())
    assert motors(loop, asked(roll=5.0), steps=15) == pytest.approx(level)
    rates = STILL.clone()
    for _ in range(20):
        rates[0, 0] += 0.1  # rad/s in 1 ms, to the right
        commands = motors(loop, asked(roll=5.0), rates)
    assert commands[0] > level[0] and commands[2] < level[2]


def test_d_rises_to_d_max_while_the_setpoint_moves_and_falls_back() -> None:
    loop = RateLoop(DRONE, 1)
    for step in range(200):
        loop.motor_commands(asked(roll=0.0 if step < 10 else 5.0), STILL)
        if step == 30:
            moved = loop.state[0, Row.BOOST_2].clone()
    assert moved[0] > 0.3 and moved[1:].abs().max() == 0.0
    assert loop.state[0, Row.BOOST_2, 0] < 0.01


def test_i_term_relax_keeps_the_integral_from_growing_in_a_step() -> None:
    relaxed, free = (RateLoop(replace(DRONE, betaflight=p), 1) for p in (
        BetaflightParameters(), BetaflightParameters(iterm_relax_threshold=1e9),
    ))  # fmt: skip
    for loop in (relaxed, free):
        for _ in range(25):
            loop.motor_commands(asked(roll=6.0, yaw=1.0), STILL)
    assert relaxed.state[0, Row.I, 0] < 0.1 * free.state[0, Row.I, 0]
    assert relaxed.state[0, Row.I, 2] == free.state[0, Row.I, 2]  # yaw has none


def test_a_drone_draws_its_own_firmware_and_resets_alone() -> None:
    quadrotor = Quadrotor(PRESETS["betaflight"], 64, generator=torch.Generator().manual_seed(0))
    quadrotor.reset(torch.ones(64, dtype=torch.bool))
    loop, widths = quadrotor.rate_loop, PRESETS["betaflight"].randomisation
    assert loop is not None and widths is not None
    parameters = loop.drone_parameters
    gains, filters = parameters[:, : DroneParameter.FILTERS], parameters[:, DroneParameter.FILTERS, :2]
    motors_own = parameters[:, DroneParameter.MOTORS]
    for values, width in ((gains, widths.gains), (filters, widths.filters)):
        assert (values - 1.0).abs().max() <= width and values.std() > 0.4 * width
    lag = -0.001 / motors_own[:, 0].log()
    assert lag.min() > 0.03 * (1.0 - widths.motor_lag) - 1e-9 and lag.max() < 0.03 * (1.0 + widths.motor_lag) + 1e-9
    assert motors_own[:, 2].min() >= 0.0 and motors_own[:, 2].max() <= widths.sag_max
    delays = quadrotor.drones["delay_steps"]
    assert delays.min() >= 5 and delays.max() <= 35
    before = loop.drone_parameters.clone()
    mask = torch.arange(64) == 3
    quadrotor.reset(mask)
    assert torch.equal(parameters[~mask], before[~mask]) and not torch.equal(parameters[mask], before[mask])


def test_a_battery_that_sags_gives_less_thrust_the_more_is_asked() -> None:
    level = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    given = []
    for sag in (0.0, 0.15):
        quadrotor = Quadrotor(replace(DRONE, drag=(0.0, 0.0, 0.0)), 1)
        quadrotor.set_motors(torch.ones(1, 1, dtype=torch.bool), 1.0, sag)
        quadrotor.command(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
        given.append([wrench(quadrotor, 19, level, STILL, STILL)[0, 2].item() for _ in range(400)][-1])
    assert given == pytest.approx([16.0, 16.0 * 0.85], rel=1e-3)


def test_a_flight_goes_on_from_its_state() -> None:
    ours, other = (
        Quadrotor(PRESETS["betaflight"], 4, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)
    )
    level = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(4, 1)
    generator = torch.Generator().manual_seed(2)
    rates = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    ours.reset(torch.ones(4, dtype=torch.bool))
    ours.command(torch.rand(4, 4, generator=generator))
    for step in range(20):
        wrench(ours, step, level, rates, rates)
    other.load_state_dict(ours.state_dict())
    assert torch.equal(wrench(ours, 0, level, rates, rates), wrench(other, 0, level, rates, rates))


@pytest.mark.slow
def test_the_firmware_itself_did_the_same() -> None:
    """Six seconds of a recording; all of it: `benchmarks/betaflight.py`, docs/betaflight.md."""
    benchmark = module_of("benchmarks", "betaflight")
    recording = benchmark.read_recording(Path(__file__).parent / "betaflight_firmware.csv.gz")
    records = benchmark.compare(benchmark.cut(recording), kinds=["with pauses"])
    assert [record["scale"] for record in records] == ["0.3", "0.6", "1.0"]
    for record, limit in zip(records, (10.0, 10.0, 20.0), strict=True):
        assert max(record[axis] for axis in "xyz") < limit, record
        assert record["motors"] < 0.05 and abs(record["thrust"]) < 2.0, record


# Drones as files.


BETAFLIGHT = PRESETS["betaflight"]


def test_a_drone_comes_back_from_its_file(tmp_path: Path) -> None:
    assert BETAFLIGHT.betaflight is not None
    drone = replace(
        BETAFLIGHT,
        mass=0.71,
        command_delay=0.013,
        inertia=(0.003, 0.002, 0.004),
        betaflight=replace(BETAFLIGHT.betaflight, p=(33.0, 60.0, 38.0)),
    )
    path = tmp_path / "made" / "drone.yaml"
    save_drone(path, drone, {"flight": "hil_circle"})
    read = load_preset(str(path))
    assert replace(read, randomisation=drone.randomisation) == drone
    assert read.randomisation is not None
    assert (read.randomisation.delay_min, read.randomisation.delay_max) == pytest.approx((0.008, 0.038))  # 3 ms later
    assert "gyro_lpf2" not in path.read_text(), "only what differs is written"
    other = tmp_path / "mine.yml"
    other.write_text("preset: faithful\nparameters: {mass: 0.5, drag: [0.1, 0.1, 0.2]}\n")
    assert load_preset(str(other)) == replace(PRESETS["faithful"], mass=0.5, drag=(0.1, 0.1, 0.2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "there is no such file"),
        ("preset: [", "is not valid YAML"),
        ("preset: easy\nparameters: 3", "is not a drone file"),
        ("preset: eazy", r"'eazy' is not one of .*\(did you mean easy\?\)"),
        ("preset: [easy]", r"\['easy'\] is not one of"),
        ("preset: easy\nparameters: {mas: 1}", r"there is no parameter 'mas' \(did you mean mass\?\)"),
        ("preset: easy\nparameters: {mass: heavy}", "mass='heavy': must be a number"),
        ("preset: easy\nparameters: {mass: {kg: 1}}", "mass={'kg': 1}: mass has no fields"),
        ("preset: easy\nparameters: {randomisation: {mass: 0}}", "there is no parameter 'randomisation'"),
        ("preset: betaflight\nparameters: {betaflight: {p: [1, 2, -3]}}", "p=.*: must be three numbers"),
    ],
)
def test_bad_drone_files_are_refused_by_file_and_field(text: str | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=words) as raised:
        load_preset(str(path))
    assert str(path) in str(raised.value)
