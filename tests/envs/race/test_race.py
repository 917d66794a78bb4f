"""Episodes by hand: laps, times, ends, crashes; and where episodes start."""

import dataclasses
import math
from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from dreamer_racing.envs.drone.parameters import GRAVITY, load_preset, without_randomisation
from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.race.gates import CrashCause, GateSweeper
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.race.race import Race, RaceStep, RewardWeights
from dreamer_racing.envs.race.racing_line import START_LINE, plan_racing_line
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Gate, GateShape, Track, load_track, make_track, validate_track
from dreamer_racing.envs.worlds import RaceWorlds

CIRCLE = load_track("circle")
CENTRES = CIRCLE.gate_positions(dtype=torch.float64)
NORMALS = CIRCLE.gate_normals(dtype=torch.float64)
HOVER = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)  # in the middle of the circle, above all frames


def begin(num_envs: int = 1, target: int = 0, **arguments) -> Race:
    """Begin an episode of each drone on the circle, hovering in its middle."""
    race = Race(CIRCLE, num_envs, dtype=torch.float64, **arguments)
    race.begin(torch.ones(num_envs, dtype=torch.bool), HOVER.repeat(num_envs, 1), torch.full((num_envs,), target))
    return race


def fly(race: Race, *points, rates=(0.0, 0.0, 0.0), invalid: bool = False) -> RaceStep:
    """Take every drone along the same points in one control step."""
    num_envs = len(race.target_gate)
    path = torch.stack([torch.as_tensor(point, dtype=torch.float64) for point in points])
    path = path.unsqueeze(1).repeat(1, num_envs, 1)
    return race.step(
        path, torch.tensor(rates, dtype=torch.float64).repeat(num_envs, 1), torch.full((num_envs,), invalid)
    )


def through(gate: int):
    """Return a path through the centre of a gate."""
    return CENTRES[gate] - 0.1 * NORMALS[gate], CENTRES[gate] + 0.1 * NORMALS[gate]


def hover(race: Race, steps: int = 1) -> RaceStep:
    """Stay in the middle for some control steps and return the last outcome."""
    for _ in range(steps):
        outcome = fly(race, HOVER, HOVER)
    return outcome


# ---------------------------------------------------------------- reward and target


def test_progress_adds_up_to_the_distance_covered():
    race = begin(target=2)
    points = 0.3 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + HOVER
    points[0] = HOVER
    outcomes = [fly(race, a, b, rates=(0.0, 3.0, 4.0)) for a, b in pairwise(points)]
    covered = (CENTRES[2] - HOVER).norm() - (CENTRES[2] - points[-1]).norm()
    torch.testing.assert_close(sum(outcome.reward_base for outcome in outcomes), covered.view(1))
    for outcome in outcomes:
        assert outcome.body_rate_norm.item() == pytest.approx(5.0)
        assert not (outcome.terminated | outcome.truncated | (outcome.passes > 0) | outcome.finished).item()
        assert outcome.crash.item() == CrashCause.NONE


def test_a_pass_pays_ten_and_moves_the_target_on():
    race = begin()
    outcome = fly(race, *through(0), rates=(1.0, 0.0, 0.0))
    assert outcome.reward_base.item() == 10.0
    assert outcome.body_rate_norm.item() == 0.0
    assert (outcome.gates_passed.item(), outcome.target_gate.item()) == (1, 1)
    # From (4, 0.1, 1.35) towards gate 1 at (0, 4, 1.35): both distances are to the new gate.
    outcome = fly(race, (4, 0.1, 1.35), (4, 0.2, 1.35))
    expected = math.hypot(4, 3.9) - math.hypot(4, 3.8)
    assert outcome.reward_base.item() == pytest.approx(expected)
    assert outcome.gate_offset.item() == 0.0


# ---------------------------------------------------------------- laps and time


STAY, LAP = (HOVER, HOVER), [through(gate) for gate in range(4)]
BESIDE = [point + torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64) for point in through(0)]


@pytest.mark.parametrize(
    ("arguments", "steps", "expected"),
    [
        ({}, [BESIDE], {"target_gate": 0, "gates_passed": 0, "terminated": False}),
        ({"episode_steps": 3}, [STAY] * 2, {"truncated": False}),
        ({"episode_steps": 3}, [STAY] * 3, {"truncated": True, "terminated": False, "finished": False}),
        ({"target": 2}, [*LAP[2:], *LAP[:2]], {"lap_time": pytest.approx(0.08), "target_gate": 2, "finished": False}),
        ({"target": 2}, [*LAP[2:], LAP[0]], {"lap_time": 0.0, "target_gate": 1}),
        ({"episode_steps": 4, "laps": 1}, LAP, {"truncated": True, "finished": True}),
        (
            {"episode_steps": 1},
            [(HOVER, (0, 0, 0.01))],
            {"truncated": False, "terminated": True, "crash": CrashCause.GROUND, "reward_base": -4.0},
        ),
        (
            {"laps": 1},
            [*LAP[:3], (*LAP[3], (0, -4, 0.01))],
            {
                "passes": 1, "gates_passed": 4, "lap_time": pytest.approx(0.08), "finished": False, "truncated": False,
                "terminated": True, "reward_base": -4.0, "body_rate_norm": 0.0,
            },
        ),
    ],
    ids=[
        "flying round a gate is not the end", "time is not up", "time is up", "a lap may begin at any gate",
        "three gates are no lap", "the last lap in the last step", "a crash in the last step is terminated only",
        "a crash behind the finish is a crash, but the lap was flown",
    ],
)  # fmt: skip
def test_ends_by_hand(arguments, steps, expected):
    race = begin(**arguments)
    for points in steps:
        outcome = fly(race, *points)
    assert {name: getattr(outcome, name).item() for name in expected} == expected


def test_lap_times():
    race = begin()
    hover(race, 5)
    for gate in range(3):
        assert fly(race, *through(gate)).lap_time.item() == 0.0
    outcome = fly(race, *through(3))  # the ninth step of the episode
    assert outcome.lap_time.item() == pytest.approx(0.18)
    assert (outcome.target_gate.item(), outcome.gates_passed.item()) == (0, 4)
    assert hover(race, 2).lap_time.item() == 0.0
    times = [fly(race, *through(gate)).lap_time.item() for gate in range(4)]
    assert times == [0.0, 0.0, 0.0, pytest.approx(0.12)]  # two hovering and four passing


@pytest.mark.parametrize("laps", [3, None])
def test_the_last_lap_truncates_as_finished(laps):
    race = begin(laps=laps)
    for passes in range(1, 13):
        outcome = fly(race, *through((passes - 1) % 4))
        assert outcome.finished.item() == outcome.truncated.item() == (passes == 12 and laps == 3)
        assert not outcome.terminated.item()
    assert outcome.reward_base.item() == 10.0


def test_two_gates_in_one_step_are_two_passes():
    gates = tuple(dataclasses.replace(CIRCLE.gates[0], position=(x, 0.0, 1.35), yaw_degrees=0.0) for x in (0, 1, 2))
    race = Race(dataclasses.replace(CIRCLE, gates=gates), 1, dtype=torch.float64, laps=2, control_dt=0.1)
    race.begin(torch.tensor([True]), torch.tensor([[-0.1, 0.0, 1.35]]), torch.tensor([2]))
    back = (-0.1, -3.0, 1.35), (-0.1, 0.0, 1.35)  # round the frames
    outcome = fly(race, (1.9, 0, 1.35), (2.1, 0, 1.35), (2.1, -3.0, 1.35), *back)
    assert (outcome.passes.item(), outcome.target_gate.item()) == (1, 0)
    outcome = fly(race, back[1], (1.1, 0, 1.35))
    assert (outcome.passes.item(), outcome.gates_passed.item(), outcome.target_gate.item()) == (2, 3, 2)
    assert (outcome.reward_base.item(), outcome.lap_time.item()) == (20.0, pytest.approx(0.2))
    fly(race, (1.1, 0, 1.35), (1.9, 0, 1.35))
    outcome = fly(race, (1.9, 0, 1.35), (2.1, 0, 1.35), (2.1, -3.0, 1.35), *back, (0.1, 0, 1.35))
    assert (outcome.passes.item(), outcome.gates_passed.item(), outcome.lap_time.item()) == (2, 5, 0.0)
    outcome = fly(race, (0.1, 0, 1.35), (1.1, 0, 1.35))
    assert (outcome.finished.item(), outcome.lap_time.item()) == (True, pytest.approx(0.3))


# ---------------------------------------------------------------- broken numbers


def test_lost_drones_crash_alone():
    race = begin(num_envs=4)
    path = HOVER.repeat(3, 4, 1)
    path[1, 1, 0] = math.nan
    path[2, 2] = math.inf
    rates = torch.zeros(4, 3, dtype=torch.float64)
    rates[3, 1] = math.nan
    outcome = race.step(path, rates, torch.zeros(4, dtype=torch.bool))
    lost = CrashCause.NON_FINITE_STATE
    assert outcome.crash.tolist() == [CrashCause.NONE, lost, lost, lost]
    assert outcome.reward_base.tolist() == [0.0, -4.0, -4.0, -4.0]
    assert outcome.body_rate_norm.tolist() == [0.0] * 4
    assert outcome.terminated.tolist() == [False, True, True, True]


def test_an_invalid_action_voids_the_step():
    race = begin()
    outcome = fly(race, *through(0), (4, 0.1, 0.01), invalid=True)
    assert outcome.crash.item() == CrashCause.INVALID_ACTION
    assert (outcome.passes.item(), outcome.gates_passed.item(), outcome.gate_offset.item()) == (0, 0, 0.0)
    assert (outcome.terminated.item(), outcome.reward_base.item()) == (True, -4.0)


# ---------------------------------------------------------------- bookkeeping


def test_begin_leaves_the_others_alone():
    race = begin(num_envs=2)
    fly(race, *through(0))
    race.begin(torch.tensor([False, True]), torch.tensor([[math.nan] * 3, [2.0] * 3]), torch.tensor([3, 3]))
    assert race.target_gate.tolist() == [1, 3]
    assert race.gates_passed.tolist() == [1, 0]
    assert race.step_count.tolist() == [1, 0]
    assert race.lap_start_step.tolist() == [0, 0]
    assert race.position.tolist() == [through(0)[1].tolist(), [2.0, 2.0, 2.0]]


def test_a_new_episode_forgets_the_old_lap():
    race = begin()
    for gate in range(4):
        fly(race, *through(gate))
    assert race.lap_start_step.item() == 4
    race.begin(torch.tensor([True]), HOVER.view(1, 3), torch.tensor([0]))
    times = [fly(race, *through(gate)).lap_time.item() for gate in range(4)]
    assert times[-1] == pytest.approx(0.08)


def test_outcomes_are_not_changed_by_later_steps():
    race = begin()
    first = fly(race, *through(0))
    before = {field.name: getattr(first, field.name).clone() for field in dataclasses.fields(first)}
    fly(race, *through(1))
    race.begin(torch.tensor([True]), HOVER.view(1, 3), torch.tensor([2]))
    for name, value in before.items():
        assert torch.equal(getattr(first, name), value), name


@given(st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_random_flights_keep_the_invariants(seed):
    """And each drone alone fares the same."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.randint(4, (8,), generator=generator)
    start = CENTRES[target] - 0.2 * NORMALS[target]
    moves = 0.3 * torch.randn(15, 3, 8, 3, generator=generator, dtype=torch.float64) / 3
    points = start + torch.cat((torch.zeros(1, 8, 3), moves.flatten(0, 1))).cumsum(0)
    paths = [points[3 * k : 3 * k + 4] for k in range(15)]

    def run(drones):
        race = Race(CIRCLE, len(drones), episode_steps=12, laps=1, dtype=torch.float64)
        race.begin(torch.ones(len(drones), dtype=torch.bool), start[drones], target[drones])
        no = torch.zeros(len(drones), dtype=torch.bool)
        return [race.step(path[:, drones], torch.zeros(len(drones), 3, dtype=torch.float64), no) for path in paths]

    together = run(list(range(8)))
    alone = [run([n]) for n in range(8)]
    passes = torch.zeros(8, dtype=torch.int64)
    for step, outcome in enumerate(together):
        passes += outcome.passes
        assert torch.equal(outcome.gates_passed, passes)
        assert torch.equal(outcome.target_gate, (target + passes) % 4)
        assert torch.equal(outcome.terminated, outcome.crash != 0)
        assert not (outcome.terminated & outcome.truncated).any()
        assert torch.equal(outcome.truncated, ~outcome.terminated & (outcome.finished | (step >= 11)))
        for field in dataclasses.fields(outcome):
            single = torch.cat([getattr(steps[step], field.name) for steps in alone])
            torch.testing.assert_close(getattr(outcome, field.name), single)


def test_float32_and_nothing_waits_for_the_host():
    with FakeTensorMode(allow_non_fake_inputs=True):  # refuses whatever needs a value: item, bool, nonzero
        track = load_track("split_s")
        race = Race(track, 4, miss_radius=3.0)
        race._sweep._picks = False  # as on a GPU
        starts = StartSampler(track)
        pose = starts.sample(4)
        race.begin(torch.ones(4, dtype=torch.bool), pose.position, pose.target_gate)
        outcome = race.step(torch.zeros(11, 4, 3), torch.zeros(4, 3), torch.zeros(4, dtype=torch.bool))
    floats = (outcome.reward_base, outcome.body_rate_norm, outcome.gate_offset, outcome.lap_time)
    assert {value.dtype for value in floats} == {torch.float32}
    assert {value.shape for value in vars(outcome).values()} == {(4,)}


# ---------------------------------------------------------------- starts


def sampler(track: Track = CIRCLE, **arguments) -> StartSampler:
    usual = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}
    return StartSampler(track, **{**usual, **arguments})


def axes(attitude: Tensor) -> list[Tensor]:
    """The drones' forward, left and up in the world, (N, 3) each."""
    return [rotate(attitude, axis) for axis in torch.eye(3, dtype=torch.float64).split(1)]


def flown_by_the_pilot(worlds: RaceWorlds, steps: int) -> Iterator[RaceStep]:
    """The outcomes of control steps of the scripted pilot."""
    worlds.reset()
    pilot, state = ScriptedPilot(worlds.track, dtype=worlds.dtype), worlds.simulator.state
    for _ in range(steps):
        yield worlds.step(pilot.act(*vars(state).values(), worlds.race.target_gate))


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_evaluation_starts_at_rest_at_the_start(name):
    track = load_track(name)
    pose = sampler(track).sample(3, evaluation=True)
    start = torch.tensor(track.start_position, dtype=torch.float64).repeat(3, 1)
    torch.testing.assert_close(pose.position, start)
    assert pose.linear_velocity.eq(0).all()
    assert pose.target_gate.tolist() == [0, 0, 0]
    to_gate = torch.tensor(track.gates[0].position, dtype=torch.float64) - start
    to_gate[:, 2] = 0  # the start is level
    torch.testing.assert_close(axes(pose.attitude)[0], to_gate / to_gate.norm(dim=-1, keepdim=True))


def test_evaluation_starts_with_noise_are_moved_by_so_many_times_the_noise_of_training():
    pose = sampler(start_noise=2.0).sample(2000, evaluation=True)
    moved = (pose.position - torch.tensor(CIRCLE.start_position, dtype=torch.float64)).abs().amax(0)
    limits = torch.tensor([1.0, 1.0, 0.6], dtype=torch.float64)
    assert (moved <= limits).all() and (moved > 0.98 * limits).all()
    assert pose.linear_velocity.eq(0).all() and pose.target_gate.eq(0).all()


def test_worlds_start_with_the_noise_of_evaluation():
    worlds = RaceWorlds("circle", 50, evaluation=True, from_pixels=False, start_noise=1.0, seed=0)
    worlds.reset()
    spread = worlds.privileged()["position"].std(0)
    torch.testing.assert_close(spread, torch.tensor([0.5, 0.5, 0.3]) / 3**0.5, rtol=0.2, atol=0)


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_training_starts(name):
    track = load_track(name)
    pose = sampler(track).sample(5000)
    centre = track.gate_positions(dtype=torch.float64)[pose.target_gate]
    normal = track.gate_normals(dtype=torch.float64)[pose.target_gate]
    distance = ((centre - pose.position) * normal).sum(-1)  # before the plane
    assert distance.min() > 0.29
    low = torch.tensor(track.bounds_low, dtype=torch.float64)
    low[2] = max(low[2], 0.05)
    assert (pose.position - low).min() >= 0.3 - 1e-9
    assert (torch.tensor(track.bounds_high, dtype=torch.float64) - pose.position).min() >= 0.3 - 1e-9

    speed = pose.linear_velocity.norm(dim=-1)
    at_gate = speed > 0
    assert at_gate.double().mean() == pytest.approx(0.5, abs=0.03)
    assert set(pose.target_gate[at_gate].tolist()) == set(range(track.num_gates))
    assert set(pose.target_gate[~at_gate].tolist()) == {0}
    assert 1.5 <= speed[at_gate].min() < 1.6
    assert 2.4 < speed[at_gate].max() <= 2.5
    # Towards the centre, and before the gate as described.
    miss = torch.linalg.cross(pose.linear_velocity, centre - pose.position)[at_gate].norm(dim=-1)
    torch.testing.assert_close(miss, torch.zeros_like(miss))
    assert distance[at_gate].max() < 3.5
    start = torch.tensor(track.start_position, dtype=torch.float64)
    assert (pose.position[~at_gate] - start)[:, :2].norm(dim=-1).max() <= math.hypot(0.5, 0.5)


@pytest.mark.parametrize(("evaluation", "times"), [(False, 1.0), (True, 2.0)])
def test_attitude_noise(evaluation, times):
    pose = sampler(start_noise=2.0).sample(5000, evaluation)
    forward, left, _ = axes(pose.attitude)
    yaws = CIRCLE.gate_yaws(dtype=torch.float64)[pose.target_gate]  # the start faces gate 0 along its yaw
    yaw = torch.atan2(forward[:, 1], forward[:, 0]) - yaws
    pitch = forward[:, 2].asin()
    roll = (left[:, 2] / pitch.cos()).asin()
    for angle, limit in ((torch.atan2(yaw.sin(), yaw.cos()), 10.0), (pitch, 5.0), (roll, 5.0)):
        assert 0.99 * times * limit < angle.abs().rad2deg().max() <= times * limit + 1e-6
    torch.testing.assert_close(pose.attitude.norm(dim=-1), torch.ones(5000, dtype=torch.float64))


@given(st.floats(-180, 180), st.integers(0, 100))
@settings(max_examples=40, deadline=None)
def test_no_start_is_past_its_gate_however_tight_the_box(yaw, seed):
    gates = [Gate((0.0, 0.0, 1.35), yaw), Gate((0.0, 0.0, 4.0), yaw)]
    start = gates[0].position[0] - gates[0].forward[0], -gates[0].forward[1], 1.35  # 1 m before the plane
    track = make_track("tight", gates, start_position=start, bounds_low=(-1.31,) * 3, bounds_high=(1.31, 1.31, 6.0))
    validate_track(track, "tight")
    pose = sampler(track, generator=torch.Generator().manual_seed(seed)).sample(500)
    distance = -(pose.position * track.gate_normals(dtype=torch.float64)[0]).sum(-1)
    assert distance.min() > 0.29
    assert pose.position[:, :2].abs().max() <= 1.01 + 1e-9


@pytest.mark.parametrize("beyond_gate", [0.0, 0.5])
def test_no_start_is_within_the_frame_of_a_gate_close_by(beyond_gate):
    gates = [Gate((2.5 * index, 1.1 * (index % 2), 1.35), 0.0) for index in range(3)]
    track = make_track("slalom", gates, start_position=(-2.5, 0.0, 1.35))
    validate_track(track, "slalom")
    pose = sampler(track, beyond_gate=beyond_gate, dtype=torch.float32).sample(20_000)
    still = torch.stack((pose.position, pose.position))
    crash = GateSweeper(track)(still, pose.target_gate).crash
    assert crash.unique().tolist() == [CrashCause.NONE]
    moved = (pose.position == torch.tensor(track.start_position)).all(-1)
    assert 20 < moved.sum() < 1000
    assert not pose.linear_velocity[moved].any() and not pose.target_gate[moved].any()
    torch.testing.assert_close(pose.attitude[moved], torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(int(moved.sum()), 4))


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_no_start_of_a_built_in_track_is_moved_out_of_a_frame(name):
    track = load_track(name)
    pose = sampler(track, beyond_gate=0.3).sample(20_000)
    assert not (pose.position == torch.tensor(track.start_position, dtype=torch.float64)).all(-1).any()


def test_starts_beyond_a_gate_face_the_turn_to_the_next():
    pose = sampler(beyond_gate=1.0).sample(2000)
    gate = (pose.target_gate - 1) % 4
    behind = ((pose.position - CENTRES[gate]) * NORMALS[gate]).sum(-1)
    assert behind.min() >= 0.1 and behind.max() <= 2.5
    speed = pose.linear_velocity.norm(dim=-1)
    assert 1.5 <= speed.min() < 1.6 and 4.9 < speed.max() <= 5.0
    torch.testing.assert_close(pose.linear_velocity, speed.unsqueeze(-1) * NORMALS[gate])
    assert pose.target_gate.unique().tolist() == [0, 1, 2, 3]


def test_the_shares_of_starts_beyond_and_at_gates_leave_the_others_as_they_were():
    poses = {at_gate: sampler(beyond_gate=0.4, at_gate=at_gate).sample(20_000) for at_gate in (0.0, 0.25, 0.5, 1.0)}
    for at_gate, pose in poses.items():
        speed = pose.linear_velocity.norm(dim=-1)
        assert (speed == 0).double().mean() == pytest.approx(0.6 * (1.0 - at_gate), abs=0.02)
        assert (speed > 2.5).double().mean() == pytest.approx(0.4 * 2.5 / 3.5, abs=0.02)
    none, some = poses[0.0], poses[0.25]
    fast = none.linear_velocity.norm(dim=-1) > 0  # beyond a gate
    torch.testing.assert_close(some.position[fast], none.position[fast])
    assert (none.target_gate[~fast] == 0).all()


@pytest.mark.parametrize("arguments", [{"start_at_gate": 0.0}, {"evaluation": True, "start_on_line": 1.0}])
def test_worlds_can_begin_every_episode_at_the_start(arguments):
    """Of evaluations none begins on the line."""
    worlds = RaceWorlds("circle", 200, from_pixels=False, seed=0, **arguments)
    worlds.reset()
    assert (worlds.simulator.state.linear_velocity == 0).all() and (worlds.race.target_gate == 0).all()


N_ON_LINE = 400


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_starts_on_the_line_are_between_the_last_gate_and_the_next(name):
    worlds = RaceWorlds(name, 2000, from_pixels=False, start_on_line=1.0, seed=0)
    worlds.reset()
    gate, centres = worlds.race.target_gate, worlds.track.gate_positions(dtype=torch.float64)
    assert gate.unique().tolist() == list(range(worlds.track.num_gates))
    for of, side in ((gate, 1.0), ((gate - 1) % worlds.track.num_gates, -1.0)):
        ahead = centres[of] - worlds.simulator.state.position
        near = ahead.norm(dim=-1) < StartSampler.PAST_GATE
        before = (ahead * worlds.track.gate_normals(dtype=torch.float64)[of]).sum(-1) * side
        assert near.any() and (before[near] >= 0).all(), "a drone begins on the wrong side of a gate's plane"


@pytest.mark.parametrize("name", ["circle", "kidney"])
def test_starts_on_the_line_can_be_flown_on_from_anywhere_of_a_lap(name):
    worlds = RaceWorlds(name, N_ON_LINE, from_pixels=False, start_on_line=1.0, seed=0)
    crashed, passed = torch.zeros(N_ON_LINE, dtype=torch.bool), torch.zeros(N_ON_LINE, dtype=torch.int64)
    for outcome in flown_by_the_pilot(worlds, 100):
        passed = torch.where(crashed, passed, outcome.gates_passed)
        crashed |= outcome.terminated
    assert crashed.float().mean() < 0.1
    assert (passed > 0).float().mean() > 0.9


@pytest.mark.parametrize("preset", ["easy", "faithful"])
def test_starts_on_the_line_look_where_it_leads_and_push_along_what_it_asks_for(preset):
    parameters = without_randomisation(load_preset(preset))
    line = plan_racing_line(CIRCLE, parameters, START_LINE)
    starts = sampler(on_line=1.0, line=line)
    starts.LINE_NOISE, starts._attitude_noise = 0.0, torch.zeros(3, dtype=torch.float64)
    pose = starts.sample(500)
    nearest = torch.cdist(pose.position, line.samples[:, :3]).argmin(-1)
    reference = line.samples[nearest]
    pace = pose.linear_velocity.norm(dim=-1) / reference[:, 3:6].norm(dim=-1)
    assert 0.19 < pace.min() < 0.25 and 0.95 < pace.max() < 1.02
    drag = sum(parameters.drag[:2]) / 2 / parameters.mass
    nose, left, axis = axes(pose.attitude)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    force = pace.square().unsqueeze(-1) * reference[:, 6:9] + drag * pose.linear_velocity + GRAVITY * up
    assert (axis * force).sum(-1).div(force.norm(dim=-1)).min() > 0.999
    later = line.at(nearest.double() * line.dt + starts.LOOK_AHEAD).position - pose.position
    assert (left * later).sum(-1).abs().max() < 0.1 and (nose * later).sum(-1).min() > 0


def test_no_episode_begins_in_the_frame_of_a_narrow_gate(monkeypatch):
    narrow = dataclasses.replace(CIRCLE, shape=GateShape(opening=0.6))
    line = plan_racing_line(CIRCLE, load_preset("easy"), START_LINE)
    starts = sampler(narrow, on_line=1.0, line=line)
    assert not starts._in_a_frame(starts.sample(20_000).position).any()
    is_in_a_frame = starts._in_a_frame
    monkeypatch.setattr(starts, "_in_a_frame", lambda position: torch.zeros(len(position), dtype=torch.bool))
    assert is_in_a_frame(starts.sample(20_000).position).any(), "the line's noise would carry some there"


def test_the_share_of_starts_on_the_line_leaves_the_rest_as_it_was():
    line = plan_racing_line(CIRCLE, load_preset("easy"), START_LINE)
    mixed, plain = sampler(on_line=0.5, line=line).sample(2000), sampler().sample(2000)
    same = (mixed.position == plain.position).all(-1)
    assert same.double().mean() == pytest.approx(0.5, abs=0.04)
    assert torch.equal(mixed.target_gate[same], plain.target_gate[same])
    with pytest.raises(ValueError, match="needs a racing line"):
        sampler(on_line=0.5)


@pytest.mark.parametrize(("evaluation", "ends"), [(False, True), (True, False)])
def test_a_missed_gate_ends_training_episodes_only(evaluation, ends):
    worlds = RaceWorlds("circle", 1, from_pixels=False, evaluation=evaluation, miss_radius=3.0, seed=0)
    worlds.reset()
    beside = torch.tensor([4.0, 0.0, 3.35], dtype=worlds.dtype)  # 2 m above gate 0, which is flown along y
    path = torch.stack([beside - torch.tensor([0, 0.1, 0]), beside + torch.tensor([0, 0.1, 0])]).unsqueeze(1)
    worlds.race.target_gate.zero_()
    outcome = worlds.race.step(path, torch.zeros(1, 3), torch.tensor([False]))
    assert outcome.terminated.item() is ends
    assert outcome.crash.item() == (CrashCause.GATE_MISSED if ends else CrashCause.NONE)
    if ends:
        assert outcome.reward_base.item() == RewardWeights().collision


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_a_good_lap_misses_no_gate(name):
    worlds = RaceWorlds(name, 4, from_pixels=False, miss_radius=3.0, seed=0)
    for outcome in flown_by_the_pilot(worlds, 450):
        assert not (outcome.crash == CrashCause.GATE_MISSED).any()
    assert (outcome.gates_passed >= worlds.track.num_gates).all()


def test_half_the_control_rate_flies_twice_as_far_a_step_and_ends_after_the_same_time():
    fast, slow = (RaceWorlds("circle", 1, from_pixels=False, seed=0, control_rate=rate) for rate in (None, 25.0))
    for worlds, steps in ((fast, 4), (slow, 2)):
        worlds.reset()
        for _ in range(steps):
            worlds.step(torch.full((1, 4), 0.1))
    torch.testing.assert_close(fast.simulator.state.position, slow.simulator.state.position)
    assert (fast.race.episode_steps, slow.race.episode_steps) == (1000, 500)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("episode_steps", 0, "episode_steps=0: must be at least 1"),
        *(("start_noise", noise, r"start_noise=.*below 3\.54 .*2\.50 m before the plane")
          for noise in (-1.0, 2.5 / 0.5**0.5, math.nan)),
        ("start_beyond_gate", 2, "start_beyond_gate=2"),
        ("start_at_gate", -0.1, "start_at_gate=-0.1: must be at least 0 and at most 1"),
        ("start_on_line", -0.1, "start_on_line=-0.1"),
        ("start_on_line", 1.5, "start_on_line=1.5: must be at least 0 and at most 1"),
        ("miss_radius", 0.5, "miss_radius=0.5: .* more than 1.025 m"),
        ("control_rate", 5, "control_rate=5 Hz: must be at least 10"),
        ("control_rate", 60, "control_rate=60.* whole number of physics steps of 2 ms"),
    ],
)  # fmt: skip
def test_numbers_out_of_their_range_are_refused(name, value, words):
    with pytest.raises(ValueError, match=words):
        RaceWorlds("circle", 1, from_pixels=False, **{name: value})


def test_noisy_starts_of_evaluation_leave_out_frames(monkeypatch):
    starts = sampler(start_noise=2.0)
    monkeypatch.setattr(starts, "_in_a_frame", lambda position: torch.arange(len(position)) % 2 == 0)
    position = starts.sample(100, evaluation=True).position
    at_start = (position == torch.tensor(CIRCLE.start_position, dtype=torch.float64)).all(-1)
    assert at_start[::2].all() and not at_start[1::2].any()
