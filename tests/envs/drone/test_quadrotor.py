"""The quadrotor's physics, and its rigid body's step."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dreamer_racing.envs.drone.betaflight import BetaflightParameters
from dreamer_racing.envs.drone.parameters import GRAVITY, PRESETS, QuadrotorParameters, Randomisation, load_preset
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.envs.simulator.scene import build_drone
from dreamer_racing.envs.simulator.simulators import MujocoSimulator
from dreamer_racing.envs.tracks import load_track
from tests.torch_flight import TorchFlight, effectiveness, mix, wrench

ROOT = Path(__file__).parents[3]
HOVER = -0.26407
"""As the pages have it."""
LEVEL = (1.0, 0.0, 0.0, 0.0)
EASY = PRESETS["easy"]


def simulate(
    actions: torch.Tensor, parameters: QuadrotorParameters = EASY, velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[MujocoSimulator, torch.Tensor]:
    """Fly actions (T, N, 4) from (0, 0, 3); return the simulator and the positions (T·P + 1, N, 3)."""
    num_envs = actions.shape[1]
    simulator = MujocoSimulator(
        load_track("circle"), parameters, num_envs, renderer=None, generator=torch.Generator().manual_seed(0)
    )
    everyone = torch.ones(num_envs, dtype=torch.bool)
    rows = [torch.tensor(values, dtype=torch.float64).repeat(num_envs, 1) for values in ((0, 0, 3), LEVEL, velocity)]
    simulator.reset(everyone, *rows)
    paths = [simulator.step(action) for action in actions]
    return simulator, torch.cat([paths[0][:1]] + [path[1:] for path in paths])


def repeat(action: tuple[float, ...], seconds: float) -> torch.Tensor:
    """One drone's constant action over a time (T, 1, 4)."""
    return torch.tensor(action, dtype=torch.float64).repeat(round(seconds / EASY.control_dt), 1, 1)


@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_hover_thrust_holds_altitude_for_ten_seconds_within_a_centimetre(preset: str) -> None:
    parameters = replace(PRESETS[preset], randomisation=None)
    _, path = simulate(repeat((HOVER, 0.0, 0.0, 0.0), 10.0), parameters)
    assert (path[:, 0] - path[0, 0]).abs().max() < 0.01


def test_hover_action_is_the_documented_number() -> None:
    assert QuadrotorParameters().hover_action == pytest.approx(HOVER, abs=1e-5)
    for page in ("docs/environment.md", "docs/simulation.md", "docs/library.md"):
        assert f"{abs(HOVER)}" in (ROOT / page).read_text(encoding="utf-8"), page


@pytest.mark.parametrize(("thrust", "weights"), [(-1.0, 0.0), (1.0, 16.0 / 0.6 / 9.81)])
def test_no_thrust_is_free_fall_and_full_thrust_gives_the_papers_thrust_to_weight_ratio(thrust, weights) -> None:
    simulator, _ = simulate(repeat((thrust, 0.0, 0.0, 0.0), 0.4))
    before = simulator.state.linear_velocity[0, 2].item()
    simulator.step(torch.tensor([[thrust, 0.0, 0.0, 0.0]]))
    acceleration = (simulator.state.linear_velocity[0, 2].item() - before) / 0.02
    assert (acceleration + GRAVITY) / GRAVITY == pytest.approx(weights, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize(("axis", "authority"), [(0, 242.0), (1, 324.0), (2, 34.0)])
def test_angular_authority_at_hover(axis: int, authority: float) -> None:
    drone = Quadrotor(EASY, 1)
    torque = torch.zeros(1, 3, dtype=torch.float64)
    torque[0, axis] = 100.0
    thrusts = mix(drone, torch.tensor([[0.6 * GRAVITY]], dtype=torch.float64), torque)
    given_torque = (thrusts @ effectiveness(drone))[0, 3 + axis] / EASY.inertia[axis]
    if axis < 2:  # roll and pitch may take thrust: the hover figure is what is left without adding any
        assert given_torque >= authority - 1.0
    else:
        assert given_torque == pytest.approx(authority, rel=0.02)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rate_step_settles_without_steady_error(axis: int) -> None:
    action = [GRAVITY / 13.33 - 1.0, 0.0, 0.0, 0.0]
    action[1 + axis] = 0.2
    target = 0.2 * EASY.body_rate_max[axis]
    simulator, _ = simulate(repeat(tuple(action), 0.12))
    early = simulator.state.body_rates[0, axis].item()
    for _ in range(20):
        simulator.step(torch.tensor([action]))
    assert early > 0.63 * target  # ≈ 3 motor lags
    assert simulator.state.body_rates[0, axis].item() == pytest.approx(target, rel=0.01)


def test_energy_does_not_grow_with_rotors_off() -> None:
    simulator, _ = simulate(repeat((-1.0, 0.0, 0.0, 0.0), 0.4), replace(PRESETS["faithful"], randomisation=None),
                            velocity=(5.0, 0.0, 3.0))  # fmt: skip

    def energy() -> float:
        state = simulator.state
        kinetic = 0.5 * 0.6 * state.linear_velocity.square().sum()
        spin = 0.5 * (torch.tensor(EASY.inertia) * state.body_rates.square()).sum()
        return (kinetic + spin + 0.6 * GRAVITY * state.position[0, 2]).item()

    last = energy()
    for _ in range(10):
        simulator.step(torch.tensor([[-1.0, 0.0, 0.0, 0.0]]))
        assert energy() < last
        last = energy()


finite = st.floats(-5.0, 5.0)


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 20.0), finite, finite, finite)
def test_mixer_respects_limits_and_priorities(thrust: float, roll: float, pitch: float, yaw: float) -> None:
    drone = Quadrotor(EASY, 1)
    wanted = torch.tensor([[roll, pitch, yaw]], dtype=torch.float64)
    rotors = mix(drone, torch.tensor([[thrust]], dtype=torch.float64), wanted)
    given_wrench = (rotors @ effectiveness(drone))[0]
    assert rotors.min() >= 0.0 and rotors.max() <= 4.0
    largest = 4.0 * 4.0 / 2 * EASY.arm_length / 2**0.5  # N m: two rotors full, two off, about one axis
    if abs(roll) + abs(pitch) < largest:  # roll and pitch are given up last: always exact while they can be
        assert given_wrench[3:5].tolist() == pytest.approx([roll, pitch], abs=1e-9)
    assert abs(given_wrench[5]) <= abs(yaw) + 1e-9
    assert given_wrench[5] * yaw >= -1e-12


def test_mixer_without_saturation_is_exact() -> None:
    drone = Quadrotor(EASY, 1)
    wanted = torch.tensor([[0.05, -0.04, 0.01]], dtype=torch.float64)
    rotors = mix(drone, torch.tensor([[6.0]], dtype=torch.float64), wanted)
    assert (rotors @ effectiveness(drone))[0, 2:].tolist() == pytest.approx([6.0, 0.05, -0.04, 0.01])


def test_command_delay_holds_a_command_back_by_its_time() -> None:
    parameters = replace(EASY, command_delay=0.014)  # 7 physics steps of 2 ms
    still, level = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([LEVEL], dtype=torch.float64)
    delayed = Quadrotor(parameters, 1)
    delayed.command(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    thrusts = [wrench(delayed, step, level, still, still)[0, 2].item() for step in range(10)]
    hover = 0.6 * GRAVITY
    assert thrusts[:7] == pytest.approx([hover] * 7)
    assert thrusts[7] > hover + 0.1


def test_randomised_drones_obey_their_own_newton_and_euler_equations() -> None:
    parameters = replace(PRESETS["faithful"], drag=(0.0, 0.0, 0.0))
    drone = Quadrotor(parameters, 64, generator=torch.Generator().manual_seed(1))
    drone.reset(torch.ones(64, dtype=torch.bool))
    own = drone.drones
    assert own["mass"].min() > 0.94 and own["mass"].max() < 1.06 and own["mass"].std() > 0.01
    assert own["delay_steps"].min() >= 0 and own["delay_steps"].max() <= 40
    rates = torch.randn(64, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 5
    level = torch.tensor([LEVEL], dtype=torch.float64).repeat(64, 1)
    before, decay = drone.rotor_speed.clone(), drone.motor_decay
    found = wrench(drone, 0, level, torch.zeros_like(rates), rates)
    target = (drone.rotor_speed - decay * before) / (1 - decay)
    rotors = (target + decay**0.5 * (before - target)).square() @ effectiveness(drone)  # of the middle of the step
    nominal = torch.tensor(parameters.inertia, dtype=torch.float64)
    inertia = own["inertia"] * nominal
    torque = own["thrust"] * rotors[:, 3:]
    torque[:, 2:] *= own["torque"]
    expected = (torque - torch.linalg.cross(rates, inertia * rates)) / inertia
    simulated = (found[:, 3:] - torch.linalg.cross(rates, nominal * rates)) / nominal
    torch.testing.assert_close(simulated, expected)
    torch.testing.assert_close(found[:, 2] / 0.6, (own["thrust"] * rotors[:, 2:3] / (0.6 * own["mass"]))[:, 0])


def thrown(parameters: QuadrotorParameters, wrenches: torch.Tensor, substeps: int) -> torch.Tensor:
    """Positions (T, 3) of a drone, thrown with a spin, that holds each wrench (6,) for so many steps."""
    model = build_drone(parameters).compile()
    data = mujoco.MjData(model)
    data.qvel[:] = (5.0, 0.0, 2.0, 3.0, -2.0, 1.0)
    views = [torch.from_numpy(array).unsqueeze(0) for array in (data.qpos, data.qvel, data.qfrc_applied)]
    flight, path = TorchFlight(Quadrotor(parameters, 1), *views, lambda: mujoco.mj_step(model, data)), []
    for held in wrenches:
        for _ in range(substeps):
            flight.apply(held.unsqueeze(0))
        path.append(flight.qpos[0, :3].clone())
    return torch.stack(path)


def test_easy_integrator_stays_within_a_millimetre_of_rk4_over_two_seconds() -> None:
    time = torch.arange(1000, dtype=torch.float64) * 0.002
    wrenches = torch.zeros(1000, 6, dtype=torch.float64)
    wrenches[:, 2] = 8.0 + 5.0 * torch.sin(5.0 * time)  # N
    wrenches[:, 3:] = 0.02 * torch.stack([torch.cos(rate * time) for rate in (20.0, 23.0, 7.0)], dim=1)  # N m
    path = thrown(EASY, wrenches, substeps=1)
    reference = thrown(replace(EASY, physics_dt=0.001, integrator="RK4"), wrenches, substeps=2)
    assert (path - reference).norm(dim=-1).max() < 1e-3


def hard_actions(*scales: float) -> torch.Tensor:
    """Actions of 16 drones (100, 16, 4) that change every tenth step."""
    generator = torch.Generator().manual_seed(3)
    targets = torch.rand(11, 16, 4, generator=generator, dtype=torch.float64) * 2 - 1
    return targets.repeat_interleave(10, dim=0)[:100] * torch.tensor(scales)


def test_length_of_the_physics_step_hardly_matters_under_hard_commands() -> None:
    actions = hard_actions(0.5, 0.3, 0.3, 1.0)
    _, path = simulate(actions)
    _, fine = simulate(actions, replace(EASY, physics_dt=0.001, integrator="RK4"))
    assert (path - fine[::2]).norm(dim=-1).max() < 0.01


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_drag_makes_a_long_physics_step_no_worse(integrator: str) -> None:
    """That of a step's beginning would make it eight times worse."""
    actions = hard_actions(0.5, 0.1, 0.1, 0.3)
    errors = []
    for drag in (EASY.drag, PRESETS["faithful"].drag):
        drone = replace(EASY, drag=drag, integrator=integrator)
        coarse, fine = (simulate(actions, replace(drone, physics_dt=step))[1][-1] for step in (0.002, 0.0001))
        errors.append((coarse - fine).norm(dim=-1).mean())
    assert errors[1] < 1.2 * errors[0] < 5e-4


def test_unknown_preset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"preset=hard: .*easy, faithful"):
        load_preset("hard")


@pytest.mark.parametrize(
    ("part", "name", "value", "words"),
    [
        *((QuadrotorParameters, name, -1.0, f"{name}=-1.0: must be above 0") for name in (
            "mass", "arm_length", "torque_constant", "rotor_thrust_max", "collective_thrust_scale", "rate_gain",
            "physics_dt", "control_dt", "motor_time_constant",
        )),
        *((QuadrotorParameters, *row) for row in (
            ("physics_dt", 0.003, "control_dt=0.02 s must be a whole multiple of physics_dt=0.003"),
            ("mass", math.nan, "mass=nan: must be above 0"),
            ("motor_time_constant", math.nan, "motor_time_constant=nan: must be above 0"),
            ("motor_lag_of", "voltage", "motor_lag_of='voltage': must be speed or thrust"),
            ("mass", "light", "mass='light': must be a number"),
            ("command_delay", -0.01, "command_delay=-0.01: must be at least 0"),
            ("inertia", (0.002, 0.0, 0.003), r"inertia=\(0.002, 0.0, 0.003\): must be three numbers, each above 0"),
            ("drag", (0.1, 0.1), "drag=.*: must be three numbers, each at least 0"),
            ("body_rate_max", (10.0, -10.0, 4.0), "body_rate_max=.*: must be three numbers, each above 0"),
            ("integrator", "implicitfast", "integrator='implicitfast': must be Euler or RK4"),
            ("randomisation", True, "randomisation=True: must be a Randomisation or None"),
            ("betaflight", True, "betaflight=True: must be a BetaflightParameters or None"),
        )),
        *((Randomisation, *row) for row in (
            ("mass", 1.0, "mass=1.0: .*at least 0 and below 1"),
            ("torque", math.nan, "torque=nan: .*at least 0 and below 1"),
            ("delay_max", math.inf, "delay_max=inf: must be at least 0, and finite"),
            ("delay_min", 0.05, "delay_min=0.05: must be at most delay_max=0.04"),
            ("thrust", "much", "thrust='much': must be a number"),
        )),
        *((BetaflightParameters, *row) for row in (
            ("p", (45.0, 47.0), "p=.*three numbers"),
            ("motor_idle", 0.5, "motor_idle=0.5: must be at least 0 and at most 0.2"),
            ("gyro_lpf1", (250.0, 0.0), "gyro_lpf1=.*two cut-offs above 0"),
        )),
    ],
)  # fmt: skip
def test_bad_parameters_are_refused(part: type, name: str, value: object, words: str) -> None:
    with pytest.raises(ValueError, match=f"{part.__name__}: {words}"):
        part(**{name: value})


# The kernels compute what `TorchFlight` states in torch, for drones in every condition.


N = 256
DELAYED = QuadrotorParameters(command_delay=0.045)


def state(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Tumbling drones at random: qpos (N, 7) and qvel (N, 6)."""
    draw = torch.randn(N, 13, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    attitude = torch.nn.functional.normalize(draw[:, 3:7], dim=1)
    return torch.cat((draw[:, :3], attitude), 1), torch.cat((6.0 * draw[:, 7:10], 8.0 * draw[:, 10:]), 1)


class Bodies:
    """Bodies that gain speed as if nothing held them, in place of MuJoCo's."""

    def __init__(self) -> None:
        self.qpos, self.qvel = state()
        self.force = torch.zeros(N, 6, dtype=torch.float64)

    def integrate(self) -> None:
        self.qvel += 0.002 * self.force * torch.tensor([1.0, 1.0, 1.0, 100.0, 100.0, 100.0])
        self.qpos[:, :3] += 0.002 * self.qvel[:, :3]


@pytest.mark.parametrize("parameters", [*PRESETS.values(), DELAYED], ids=[*PRESETS, "late"])
def test_kernels_do_what_torch_does(parameters: QuadrotorParameters) -> None:
    quadrotor, reference = (Quadrotor(parameters, N, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    for each in (quadrotor, reference):
        each.reset(torch.ones(N, dtype=torch.bool))
        each.rotor_speed.uniform_(0.0, 2.0, generator=torch.Generator().manual_seed(3))
    ours, theirs = Bodies(), Bodies()
    fused = FusedFlight(quadrotor, ours.qpos, ours.qvel, ours.force, ours.integrate)
    flight = TorchFlight(reference, theirs.qpos, theirs.qvel, theirs.force, theirs.integrate)
    generator = torch.Generator().manual_seed(2)
    for _ in range(4):
        action = 2.4 * torch.rand(N, 4, generator=generator, dtype=torch.float64) - 1.2
        path = [theirs.qpos[:, :3].clone()]
        quadrotor.command(action)
        reference.command(action)
        flown = fused.fly()
        for index in range(parameters.physics_steps):
            flight.step(index)
            path.append(theirs.qpos[:, :3].clone())
        for one, expected in (
            (ours.force, theirs.force), (ours.qpos, theirs.qpos), (ours.qvel, theirs.qvel),
            (quadrotor.rotor_speed, reference.rotor_speed), (flown, torch.stack(path)),
            (quadrotor.effort, reference.effort),
        ):  # fmt: skip
            # the square root of a rotor thrust of 0 plus a rounding error of 1e-17 N is 3e-9
            torch.testing.assert_close(one, expected, rtol=1e-7, atol=1e-7)
    assert (quadrotor.effort.amin(0) >= 0.0).all() and (quadrotor.effort.amax(0) > 0.2).all()
    assert (quadrotor.rotor_speed < 0.3).any()  # some rotors were at their limits
    assert (quadrotor.rotor_speed > 1.9).any()
