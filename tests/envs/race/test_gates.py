"""Passes and crashes: values worked out by hand, a slow reference, and properties of any path."""

import dataclasses
import math
from itertools import pairwise
from typing import NamedTuple

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dreamer_racing.envs.race.gates import CrashCause, GateSweep, GateSweeper
from dreamer_racing.envs.tracks import GROUND_HEIGHT, PLAIN_TRACKS, Gate, Track, load_track, make_track

NONE, FRAME, BACKWARDS, GROUND, OUTSIDE, NON_FINITE, INVALID, MISSED = (int(cause) for cause in CrashCause)
HALF_OPENING, HALF_OUTER = 0.65, 1.025  # m: 1.5 / 2 less the margin of 0.1, and 2.05 / 2

# Gate 0 faces +x, so that a point's x is its distance beyond the plane; gate 1 is far away.
PLAIN = make_track(
    "plain",
    [Gate((0.0, 0.0, 3.0), 0.0), Gate((20.0, 7.0, 3.0), 90.0)],
    decoys=[Gate((5.0, 0.0, 3.0), 0.0, kind="decoy")],
    bounds_low=(-50.0, -50.0, 0.0),
    bounds_high=(50.0, 50.0, 50.0),
)


def sweep(track: Track, points, target: int = 0, miss_radius: float = 0.0) -> GateSweep:
    """Sweep one drone, float64; the result is plain Python numbers."""
    path = torch.tensor(points, dtype=torch.float64).unsqueeze(1)
    result = GateSweeper(track, dtype=torch.float64, miss_radius=miss_radius)(path, torch.tensor([target]))
    return GateSweep(*(value.item() for value in result))


# ---------------------------------------------------------------- by hand


THROUGH = [(-0.1, 0, 3), (0.1, 0, 3)]
BESIDE = [(0.1, 2, 3), (-0.1, 2, 3)]  # back beside the gate
SEGMENT = [(-1, 0, 3), (3, 0, 3)]
CLOSE = dataclasses.replace(PLAIN, gates=tuple(Gate((x, 0.0, 3.0), 0.0) for x in (0.0, 1.2, 2.4)), decoys=())


def changed(**changes) -> dict[str, Track]:
    """The option of a track that differs from the plain one."""
    return {"track": dataclasses.replace(PLAIN, **changes)}


@pytest.mark.parametrize(
    ("points", "options", "expected"),
    [
        # the offset is the distance in the gate's plane
        ([(-0.1, 0.3, 3.4), (0.1, 0.3, 3.4)], {}, (1, pytest.approx(0.5), NONE)),
        # an oblique pass is judged where the plane is crossed: a quarter of the way, at y = 0.4; both ends mislead
        ([(-0.1, 0.2, 3.0), (0.3, 1.0, 3.0)], {}, (1, pytest.approx(0.4), NONE)),
        # the corners of opening and frame are square
        ([(-0.1, 0.64, 3.64), (0.1, 0.64, 3.64)], {}, (1, pytest.approx(math.hypot(0.64, 0.64)), NONE)),
        ([(-0.1, 1.02, 4.02), (0.1, 1.02, 4.02)], {}, (0, 0.0, FRAME)),
        # a pass is no miss of the same step, in which the plane is crossed again when it is no longer the target's
        ([*THROUGH, *BESIDE, (0.1, 2, 3)], {"miss_radius": 3.0}, (1, 0.0, NONE)),
        ([*BESIDE, (0.1, 2, 3)], {"miss_radius": 3.0}, (0, 0.0, MISSED)),
        # the radius of a miss is round
        ([(-0.1, 2.0, 5.0), (0.1, 2.0, 5.0)], {"miss_radius": 3.0}, (0, 0.0, MISSED)),
        ([(-0.1, 2.5, 5.5), (0.1, 2.5, 5.5)], {"miss_radius": 3.0}, (0, 0.0, NONE)),
        # a bar behind the plane is touched after the pass
        ([(-0.1, 0.6, 3.0), (0.02, 0.6, 3.0), (0.03, 0.7, 3.0)], {}, (1, pytest.approx(0.6), FRAME)),
        # a gate that is not the target
        (THROUGH, {"target": 1}, (0, 0.0, NONE)),
        (THROUGH[::-1], {"target": 1}, (0, 0.0, BACKWARDS)),
        ([(-0.1, 0.8, 3), (0.1, 0.8, 3)], {"target": 1}, (0, 0.0, FRAME)),
        # decoys do not collide
        ([(4.9, 0, 3), (5.1, 0, 3)], {}, (0, 0.0, NONE)),
        ([(4.9, 0.8, 3), (5.1, 0.8, 3)], {}, (0, 0.0, NONE)),
        ([(5.1, 0, 3), (4.9, 0, 3)], {}, (0, 0.0, NONE)),
        # what comes first decides
        ([*THROUGH, (0.1, 0.8, 3), (-0.1, 0.8, 3)], {}, (1, 0.0, FRAME)),
        ([(-0.1, 0.8, 3), (0.1, 0.8, 3), *BESIDE, *THROUGH], {}, (0, 0.0, FRAME)),
        ([(2, 0, 3), (2, 0, 0.01), (2, 0, 3), (60, 0, 3)], {}, (0, 0.0, GROUND)),
        ([(2, 0, 3), (60, 0, 3), (2, 0, 3), (2, 0, 0.01)], {}, (0, 0.0, OUTSIDE)),
        # out of the box at x = 50 in the segment that passes the gate
        ([(-1, 0, 3), (60, 0, 3)], {}, (1, 0.0, OUTSIDE)),
        # in one segment: another gate's frame before (x = -0.5) or behind (x = 2) the target gate; a wall before it
        (SEGMENT, changed(gates=(PLAIN.gates[0], Gate((-0.5, 0.8, 3.0), 0.0))), (0, 0.0, FRAME)),
        (SEGMENT, changed(gates=(PLAIN.gates[0], Gate((2.0, 0.8, 3.0), 0.0))), (1, 0.0, FRAME)),
        (SEGMENT, changed(bounds_high=(-0.5, 50.0, 50.0)), (0, 0.0, OUTSIDE)),
        # two gates in one step are two passes; the third is too much for one step
        *(([(-0.1, 0.1, 3.0), (end, 0.1, 3.0)], {"track": CLOSE}, (passes, pytest.approx(0.1), NONE))
          for end, passes in ((0.1, 1), (1.1, 1), (1.3, 2), (2.5, 2))),
        # a second gate counts in its turn and before a crash
        ([(-0.1, 0, 3), (1.3, 0, 3)], {"track": CLOSE, "target": 1}, (1, 0.0, NONE)),
        ([(-0.1, 0, 3), (0.6, 0, 3), (1.3, 0.9, 3)], {"track": CLOSE}, (1, 0.0, FRAME)),
        # the floor is the ground unless the box begins above it, which that of split_s does not
        ([(0, 0, 0.1), (0, 0, 0.04)], {"track": load_track("split_s")}, (0, 0.0, GROUND)),
        ([(2, 0, 1.1), (2, 0, 0.9)], changed(bounds_low=(-50.0, -50.0, 1.0)), (0, 0.0, OUTSIDE)),
    ],
)  # fmt: skip
def test_flights_by_hand(points, options, expected):
    assert sweep(**{"track": PLAIN, "points": points, **options}) == expected


@pytest.mark.parametrize(
    ("end", "cause"),
    [
        ((2, 0, 0.051), NONE), ((2, 0, 0.05), NONE), ((2, 0, 0.049), GROUND), ((2, 0, -3), GROUND),
        ((2, 0, 50.1), OUTSIDE), ((50.1, 0, 3), OUTSIDE), ((-50.1, 0, 3), OUTSIDE), ((2, 50.1, 3), OUTSIDE),
        ((2, -50.1, 3), OUTSIDE), ((2, 50.0, 3), NONE),
    ],
)  # fmt: skip
def test_ground_and_bounding_box(end, cause):
    assert sweep(PLAIN, [(math.copysign(2, end[0]), 5, 3), end]) == (0, 0.0, cause)


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    ("distance", "passes", "forward", "backward", "missed"),  # missed: forward, if misses within 3 m end episodes
    [
        (0.0, 1, NONE, BACKWARDS, NONE),
        (0.64, 1, NONE, BACKWARDS, NONE),
        (0.66, 0, FRAME, FRAME, FRAME),
        (0.76, 0, FRAME, FRAME, FRAME),
        (1.02, 0, FRAME, FRAME, FRAME),
        (1.03, 0, NONE, NONE, MISSED),
        (2.9, 0, NONE, NONE, MISSED),
        (3.1, 0, NONE, NONE, NONE),
        (4.0, 0, NONE, NONE, NONE),
    ],
)
def test_zones_of_a_gate(axis, sign, distance, passes, forward, backward, missed):
    before, after = [-0.1, 0.0, 5.0], [0.1, 0.0, 5.0]
    before[axis] += sign * distance
    after[axis] += sign * distance
    high = dataclasses.replace(PLAIN, gates=(Gate((0.0, 0.0, 5.0), 0.0), PLAIN.gates[1]))
    offset = pytest.approx(distance if passes else 0.0)
    assert sweep(high, [before, after]) == (passes, offset, forward)
    assert sweep(high, [after, before]) == (0, 0.0, backward)
    assert sweep(high, [before, after], miss_radius=3.0) == (passes, offset, missed)
    if missed == MISSED:
        assert sweep(high, [after, before], miss_radius=3.0).crash == NONE  # on the way back to try again
        assert sweep(high, [before, after], target=1, miss_radius=3.0).crash == NONE


@pytest.mark.parametrize("gate", range(7))
def test_every_split_s_gate_is_passed_along_its_yaw(gate):
    track = load_track("split_s")
    centre = torch.tensor(track.gates[gate].position, dtype=torch.float64)
    normal = torch.tensor(track.gates[gate].forward, dtype=torch.float64)
    there = [(centre - 0.09 * normal).tolist(), (centre + 0.09 * normal).tolist()]
    passed, offset, crash = sweep(track, there, gate)
    assert (passed, crash) == (True, NONE)
    assert offset == pytest.approx(0, abs=1e-9)
    assert sweep(track, there[::-1], gate).crash == BACKWARDS


@pytest.mark.parametrize(
    ("path", "crash"),
    [
        ([(-0.04, 1.2, 3.0), (-0.04, 0.8, 3.0)], FRAME),  # from beside it into the bar, before the plane
        ([(0.04, 0.0, 3.0), (0.04, 0.8, 3.0)], FRAME),  # from within the opening
        ([(0.04, 0.8, 5.0), (0.04, 0.8, 1.0)], FRAME),  # down through the whole frame
        ([(-0.06, 1.2, 3.0), (-0.06, 0.0, 3.0)], NONE),  # a centimetre before it
        ([(0.04, 0.0, 3.0), (0.04, 0.6, 3.6)], NONE),  # within the opening
        ([(0.04, 1.1, 3.0), (0.04, 1.1, 4.0)], NONE),  # beside it
        ([(0.04, 2.0, 3.1), (0.04, -0.6, 5.8)], NONE),  # past its corner
    ],
)
@pytest.mark.parametrize("picks", [True, False])
def test_a_frame_is_touched_from_any_side(path, crash, picks):
    sweeper = GateSweeper(PLAIN, dtype=torch.float64)
    sweeper._picks = picks
    both = torch.tensor([path, path[::-1]], dtype=torch.float64).transpose(0, 1)
    assert sweeper(both, torch.tensor([0, 0])).crash.tolist() == [crash, crash]


@pytest.mark.parametrize("picks", [True, False])
def test_what_is_touched_before_a_position_is_lost_is_a_touch(picks):
    sweeper = GateSweeper(PLAIN, dtype=torch.float64)
    sweeper._picks = picks
    path = torch.tensor([(0.04, 1.1, 3.0), (0.04, 0.9, 3.0), (math.nan, 0.0, 3.0)], dtype=torch.float64).unsqueeze(1)
    assert sweeper(path, torch.tensor([0])).crash == FRAME


def test_a_second_gate_is_looked_for_where_one_is_in_reach():
    path = torch.tensor([(-0.1, 0.0, 3.0), (1.3, 0.0, 3.0)]).unsqueeze(1)
    assert GateSweeper(CLOSE, reach=1.4)(path, torch.tensor([0])).passes == 2
    assert GateSweeper(PLAIN, reach=1.4)._two_in_reach is False


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sample", range(4))
def test_a_lost_position_is_a_crash_of_that_drone_alone(value, axis, sample):
    # Two drones fly through the gate; the second loses one coordinate on the way.
    path = torch.tensor([(-0.3, 0, 3), (-0.1, 0, 3), (0.1, 0, 3), (0.3, 0, 3)], dtype=torch.float64)
    path = path.unsqueeze(1).repeat(1, 2, 1)
    path[sample, 1, axis] = value
    result = GateSweeper(PLAIN, dtype=torch.float64)(path, torch.tensor([0, 0]))
    assert result.crash.tolist() == [NONE, NON_FINITE]
    assert result.passes.tolist() == [True, sample == 3]  # lost after the gate: the pass had been
    assert result.offset.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("after", [(2, 0, -1), (2, 0, 3), (60, 0, 3), (-2, 0.8, 3)])
def test_a_lost_position_stays_a_crash_whatever_follows(value, after):
    for lost in ((value, 0, 3), (2, 0, value), (value, value, value)):
        assert sweep(PLAIN, [lost, after]) == (False, 0.0, NON_FINITE)
        assert sweep(PLAIN, [(2, 0, 3), lost, after]) == (False, 0.0, NON_FINITE)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_and_shapes(dtype):
    path = torch.zeros(11, 5, 3, dtype=dtype)
    result = GateSweeper(PLAIN, dtype=dtype)(path, torch.zeros(5, dtype=torch.int64))
    assert result.passes.shape == result.offset.shape == result.crash.shape == (5,)
    assert (result.passes.dtype, result.offset.dtype, result.crash.dtype) == (torch.int64, dtype, torch.int64)


def test_wrong_shapes_are_refused():
    sweeper = GateSweeper(PLAIN)
    with pytest.raises(AssertionError, match=r"\(P \+ 1, 5, 3\), got \(11, 4, 3\)"):
        sweeper(torch.zeros(11, 4, 3), torch.zeros(5, dtype=torch.int64))
    with pytest.raises(AssertionError, match="at least 2 positions"):
        sweeper(torch.zeros(1, 5, 3), torch.zeros(5, dtype=torch.int64))


@pytest.mark.gpu
def test_gpu_agrees_with_cpu_and_never_synchronises():
    track = load_track("split_s")
    generator = torch.Generator().manual_seed(0)
    target = torch.randint(track.num_gates, (4096,), generator=generator)
    steps = 0.3 * torch.randn(11, 4096, 3, generator=generator, dtype=torch.float64)
    path = track.gate_positions(dtype=torch.float64)[target] + steps
    expected = GateSweeper(track, dtype=torch.float64, miss_radius=3.0)(path, target)
    sweeper = GateSweeper(track, "cuda", torch.float64, miss_radius=3.0)
    path, target = path.cuda(), target.cuda()
    torch.cuda.set_sync_debug_mode("error")
    try:
        result = sweeper(path, target)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(result.passes.cpu(), expected.passes)
    assert torch.equal(result.crash.cpu(), expected.crash)
    torch.testing.assert_close(result.offset.cpu(), expected.offset)


# ---------------------------------------------------------------- samples on the plane

distances = st.lists(st.sampled_from([-0.2, -0.1, 0.0, 0.1, 0.2]), min_size=2, max_size=8)


@given(distances)
@settings(deadline=None)
def test_no_crossing_is_lost_or_counted_twice(xs):
    """Judged segment by segment, forward and backward crossings alternate and add up to the change of side."""
    crossings = []
    for before, after in pairwise(xs):
        result = sweep(PLAIN, [(before, 0, 3), (after, 0, 3)])
        assert not (result.passes and result.crash)
        if result.passes or result.crash == BACKWARDS:
            crossings.append(1 if result.passes else -1)
    assert sum(crossings) == (xs[-1] >= 0) - (xs[0] >= 0)
    assert all(a == -b for a, b in pairwise(crossings))


@pytest.mark.parametrize("yaw", [0.0, 33.0, 90.0, -150.0])
def test_a_control_step_that_ends_on_the_plane(yaw):
    gate = Gate((1.0, 2.0, 3.0), yaw)
    track = dataclasses.replace(PLAIN, gates=(gate, PLAIN.gates[1]))
    centre, normal = torch.tensor(gate.position), torch.tensor(gate.forward)
    before, on, after = ((centre + distance * normal).tolist() for distance in (-0.1, 0.0, 0.1))
    first, second = sweep(track, [before, on]), sweep(track, [on, after])
    assert first.passes != second.passes
    first, second = sweep(track, [after, on]), sweep(track, [on, before])
    assert (first.crash == BACKWARDS) != (second.crash == BACKWARDS)


# ---------------------------------------------------------------- a slow reference


class Reference(NamedTuple):
    passes: int
    offset: float
    crash: int
    doubt: float  # how near the path comes to a different answer, m or segments
    nearest_sample: float  # least distance of a sample from a gate's plane, m: near 0, rounding decides its side


def reference(track: Track, points, target: int) -> Reference:
    """The rules again, event by event, for one drone whose positions are finite."""
    events, passes_of, doubts = [], [], [1.0]
    nearest_sample = min(abs(_in_gate_axes(gate, point)[0]) for gate in track.gates for point in points)
    for segment, (start, end) in enumerate(pairwise(points)):
        for index, gate in enumerate(track.gates):
            a, b = (_in_gate_axes(gate, point) for point in (start, end))
            events += [(segment + time, FRAME) for time in _bars_entered(a, b, doubts)]
            if (a[0] >= 0) == (b[0] >= 0):
                continue
            fraction = a[0] / (a[0] - b[0])
            left, up = (a[axis] + fraction * (b[axis] - a[axis]) for axis in (1, 2))
            far = max(abs(left), abs(up))
            doubts += [abs(far - HALF_OPENING), abs(far - HALF_OUTER), abs(a[0] - b[0])]
            if far < HALF_OUTER:
                if far >= HALF_OPENING:
                    events.append((segment + fraction, FRAME))
                elif b[0] < a[0]:
                    events.append((segment + fraction, BACKWARDS))
                else:
                    passes_of.append((segment + fraction, index, math.hypot(left, up)))
        for axis in range(3):
            floor = max(track.bounds_low[2], GROUND_HEIGHT) if axis == 2 else track.bounds_low[axis]
            for limit, sign, cause in (
                (floor, 1, GROUND if axis == 2 else OUTSIDE),
                (track.bounds_high[axis], -1, OUTSIDE),
            ):
                a, b = (sign * (point[axis] - limit) for point in (start, end))
                doubts.append(abs(b))
                if a >= 0 > b:
                    events.append((segment + a / (a - b), cause))
    events.sort()
    times = sorted([time for time, *_ in events] + [time for time, *_ in passes_of])
    doubts += [later - earlier for earlier, later in pairwise(times)]
    crash_time, cause = events[0] if events else (math.inf, NONE)
    passes, offset = 0, 0.0
    for time, index, distance in sorted(passes_of):
        if time < crash_time and passes < 2 and index == (target + passes) % track.num_gates:
            passes, offset = passes + 1, distance if passes == 0 else offset
    return Reference(passes, offset, cause, min(doubts), nearest_sample)


def _bars_entered(a, b, doubts):
    """When a segment from a to b, in a gate's axes, is first in the frame: at one of the times when it meets a side."""
    half = (0.05, HALF_OUTER, HALF_OUTER)
    sides = [
        (axis, sign * distance) for axis in range(3) for distance in (half[axis], HALF_OPENING) for sign in (-1, 1)
    ]
    met = [(side - a[axis]) / (b[axis] - a[axis]) for axis, side in sides if a[axis] != b[axis]]
    times = [0.0, *sorted(time for time in met if 0 < time < 1), 1.0]
    for start, end in pairwise(times):
        forward, left, up = (a[axis] + (start + end) / 2 * (b[axis] - a[axis]) for axis in range(3))
        far = max(abs(left), abs(up))
        if abs(forward) < half[0] and HALF_OPENING < far < HALF_OUTER:
            doubts.append(end - start)
            return [start]
    # a side that is nearly touched
    doubts += [
        abs(abs(point[axis]) - distance)
        for point in (a, b)
        for axis in range(3)
        for distance in (half[axis], HALF_OPENING)
    ]
    return []


def _in_gate_axes(gate: Gate, point):
    yaw = math.radians(gate.yaw_degrees)
    x, y, z = (a - b for a, b in zip(point, gate.position, strict=True))
    return (x * math.cos(yaw) + y * math.sin(yaw), y * math.cos(yaw) - x * math.sin(yaw), z)


def _out_of_gate_axes(gate: Gate, point):
    axes = (gate.forward, gate.left, (0.0, 0.0, 1.0))
    return tuple(c + sum(p * axis[i] for p, axis in zip(point, axes, strict=True)) for i, c in enumerate(gate.position))


# Hypothesis loves zeros: moved a little, they seldom put a sample on a plane, which has tests of its own above.
near = st.floats(-1.4, 1.4).map(lambda number: number + 0.0137)
local_paths = st.lists(st.tuples(near, near, near), min_size=2, max_size=7)  # in a gate's axes
tracks = st.sampled_from([load_track(name) for name in PLAIN_TRACKS] + [PLAIN])


@st.composite
def flights(draw):
    """A track, a target gate and a path about some gate of the track (usually the target)."""
    track = draw(tracks)
    target = draw(st.integers(0, track.num_gates - 1))
    about = draw(st.one_of(st.just(target), st.integers(0, track.num_gates - 1)))
    points = [_out_of_gate_axes(track.gates[about], point) for point in draw(local_paths)]
    return track, target, points


def begins_inside(track: Track, points) -> bool:
    sides = zip(track.bounds_low, points[0], track.bounds_high, strict=True)
    return points[0][2] >= GROUND_HEIGHT and all(low <= value <= high for low, value, high in sides)


@given(flights())
@settings(max_examples=250, deadline=None)
def test_agrees_with_the_reference(flight):
    track, target, points = flight
    expected = reference(track, points, target)
    assume(min(expected.doubt, expected.nearest_sample) > 1e-6)
    assume(begins_inside(track, points))
    result = sweep(track, points, target)
    assert (result.passes, result.crash) == (expected.passes, expected.crash)
    assert result.offset == pytest.approx(expected.offset, abs=1e-6)


# ---------------------------------------------------------------- properties


@given(flights(), st.data())
@settings(deadline=None)
def test_cutting_a_segment_changes_nothing(flight, data):
    track, target, points = flight
    assume(reference(track, points, target).doubt > 1e-6)
    # a path that begins crashed is none: its first point would be judged only as the end of a cut-off piece
    assume(begins_inside(track, points))
    segment = data.draw(st.integers(0, len(points) - 2))
    fraction = data.draw(st.floats(0, 1))
    middle = [a + fraction * (b - a) for a, b in zip(points[segment], points[segment + 1], strict=True)]
    whole = sweep(track, points, target)
    cut = sweep(track, [*points[: segment + 1], middle, *points[segment + 1 :]], target)
    assert (cut.passes, cut.crash) == (whole.passes, whole.crash)
    assert cut.offset == pytest.approx(whole.offset, abs=1e-6)


@given(flights(), st.data())
@settings(deadline=None)
def test_cutting_a_control_step_in_two_changes_nothing(flight, data):
    """Two control steps see together what one would, as long as the first neither passes nor crashes."""
    track, target, points = flight
    assume(len(points) > 2)
    cut = data.draw(st.integers(1, len(points) - 2))
    whole, first, second = (sweep(track, part, target) for part in (points, points[: cut + 1], points[cut:]))
    if first.crash:
        assert whole == first
    elif first.passes:
        rest = sweep(track, points[cut:], (target + first.passes) % track.num_gates)
        assert whole.passes == min(2, first.passes + rest.passes)
        assert (whole.offset, whole.crash) == (first.offset, second.crash)
    else:
        assert whole == second


@given(flights(), st.lists(st.builds(Gate, st.tuples(near, near, near), near, st.just("decoy")), max_size=3))
@settings(deadline=None)
def test_decoys_never_matter(flight, decoys):
    track, target, points = flight
    assert sweep(dataclasses.replace(track, decoys=tuple(decoys)), points, target) == sweep(track, points, target)


@given(st.integers(0, 2**31), st.integers(1, 33))
@settings(max_examples=25, deadline=None)
def test_drones_together_are_drones_alone(seed, num_drones):
    generator = torch.Generator().manual_seed(seed)
    track = load_track("split_s")
    target = torch.randint(track.num_gates, (num_drones,), generator=generator)
    path = track.gate_positions(dtype=torch.float64)[target] + torch.randn(
        4, num_drones, 3, generator=generator, dtype=torch.float64
    )
    sweeper = GateSweeper(track, dtype=torch.float64)
    together = sweeper(path, target)
    alone = [sweeper(path[:, [n]], target[[n]]) for n in range(num_drones)]
    assert torch.equal(together.passes, torch.cat([result.passes for result in alone]))
    assert torch.equal(together.crash, torch.cat([result.crash for result in alone]))
    torch.testing.assert_close(together.offset, torch.cat([result.offset for result in alone]))
