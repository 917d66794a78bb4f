import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.hil.operator import Operator
from dreamer_racing.hil.safety import Reason, Safety, SafetyLimits, State, Tick
from dreamer_racing.hil.vehicle import GRAVITY, Pose, Setpoint, hover

PERIOD = 1 / 32  # s: exact in binary, as are the times below
LIMITS = SafetyLimits(
    fence_low=(-4, -4, -1),
    fence_high=(4, 4, 4),
    start_position=(1, 0, 0),
    velocity_tolerance=1e3,  # poses of these tests stand where they like, but for those of velocities and rates
    rate_tolerance=1e3,
    turn_tolerance_degrees=180,  # and as they like, but for those of turns
)
OFF, ON, KILL = Operator(False, False), Operator(True, False), Operator(True, True)
SETPOINT = Setpoint(12.0, np.array([1.0, -2.0, 0.5]))


def turned(axis, degrees):
    """Attitude turned about body x, y or z (0, 1, 2)."""
    attitude = np.zeros(4)
    attitude[0], attitude[1 + axis] = np.cos(np.radians(degrees / 2)), np.sin(np.radians(degrees / 2))
    return attitude


def pose_at(
    time, position=(1.0, 0.0, 0.0), attitude=(1.0, 0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0)
):
    return Pose(time, np.array(position), np.array(attitude), np.array(velocity), np.array(rates))


class Flight:
    """Ticks at 32 Hz with a fresh pose at the start and a setpoint, unless said otherwise."""

    def __init__(self, **limits):
        self.safety = Safety(dataclasses.replace(LIMITS, **limits))
        self.now = 100.0

    def tick(self, after=PERIOD, pose=None, lost=False, age=0.0, operator=ON, **changes):
        self.now += after
        seen = None if lost else pose_at(self.now, **(pose or {}))
        known = {"setpoint": SETPOINT, "arm_requested": True} | changes
        return self.safety.step(Tick(self.now, seen, age, operator=operator, **known))

    def ticks(self, count, **changes):
        return [self.tick(**changes) for _ in range(count)][-1]

    def ready(self):
        """On the ground, the enable released for long enough."""
        self.ticks(10, operator=OFF)
        return self

    def flying(self):
        """Armed, with the time of arming over."""
        self.ready().ticks(10)
        assert self.safety.state is State.FLYING
        return self


def in_state(state):
    flight = Flight().ready() if state is State.DISARMED else Flight().flying()
    if state is State.HOLD:
        assert flight.ticks(2, lost=True).state is State.HOLD
    if state is State.CUT:
        flight.tick(operator=OFF)
        flight.ticks(10, operator=OFF)
    assert flight.safety.state is state
    return flight


def test_it_begins_disarmed_and_says_why():
    verdict = Flight().tick(lost=True, operator=OFF, arm_requested=False, contract_mismatch="25 Hz, not 50")
    assert verdict.state is State.DISARMED and not verdict.command.armed
    assert verdict.reasons == (Reason.NO_ENABLE, Reason.NOT_REQUESTED, Reason.CONTRACT, Reason.POSE_LOST)
    assert len(verdict.words) == 4 and "25 Hz, not 50" in verdict.words[2]


def test_it_arms_with_the_least_thrust_and_then_follows_the_actor():
    flight = Flight(arm_time=0.125, thrust_min=2.0).ready()
    for _ in range(4):  # Betaflight arms at low throttle only, whatever the least thrust of flight is
        verdict = flight.tick()
        assert verdict.state is State.FLYING and verdict.reasons == (Reason.ARMING,)
        assert verdict.command.armed and verdict.command.setpoint.collective_thrust == 0.0
    verdict = flight.tick()
    assert verdict.reasons == () and verdict.command.setpoint.collective_thrust == 12.0
    np.testing.assert_array_equal(verdict.command.setpoint.body_rates, SETPOINT.body_rates)
    assert flight.ticks(20, setpoint=Setpoint(0.5, np.zeros(3))).command.setpoint.collective_thrust == 2.0


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"arm_requested": False}, Reason.NOT_REQUESTED),
        ({"operator": None}, Reason.NO_ENABLE),
        ({"operator": OFF}, Reason.NO_ENABLE),
        ({"contract_mismatch": "other camera"}, Reason.CONTRACT),
        ({"finish": True}, Reason.FINISHED),
        ({"lost": True, "after": 0.0625}, Reason.POSE_STALE),
        ({"age": 0.051}, Reason.POSE_STALE),
        ({"age": 0.151}, Reason.POSE_LOST),
        ({"pose": {"position": (1.31, 0.0, 0.0)}}, Reason.OUTSIDE_START_BOX),
        ({"pose": {"position": (1.0, -0.31, 0.0)}}, Reason.OUTSIDE_START_BOX),
        ({"pose": {"position": (1.0, 0.0, 0.31)}}, Reason.OUTSIDE_START_BOX),
        ({"pose": {"attitude": turned(2, -15.1)}}, Reason.TURNED_AT_START),
        ({"pose": {"attitude": turned(0, 10.1)}}, Reason.TILTED_AT_START),
        ({"pose": {"attitude": turned(1, -10.1)}}, Reason.TILTED_AT_START),
        ({"pose": {"velocity": (0.0, 0.15, 0.15)}}, Reason.MOVING_AT_START),
    ],
)
def test_it_does_not_arm_but_under_all_conditions(changes, reason):
    verdict = Flight().ready().tick(**changes)
    assert verdict.state is State.DISARMED and not verdict.command.armed
    assert verdict.reasons == (reason,) and len(verdict.words) == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"lost": True},  # the last one is a tick old
        {"age": 0.05},
        {"pose": {"position": (0.71, 0.29, 0.29)}},
        {"pose": {"attitude": turned(2, 14.9)}},
        {"pose": {"attitude": turned(0, -9.9)}},
        {"pose": {"attitude": 1.05 * turned(1, 9.9)}},
        {"pose": {"velocity": (0.0, 0.14, 0.14)}},
        {"setpoint": None},
    ],
)
def test_it_arms_on_the_near_side_of_each_condition(changes):
    assert Flight(jump_tolerance=1.0).ready().tick(**changes).state is State.FLYING


@pytest.mark.parametrize(
    ("limits", "before", "changes", "reason"),
    [
        ({}, {"command_dropped": True}, {"command_dropped": True}, Reason.LINK_LOST),
        ({"overruns_max": 0, "overrun_window": 0.25}, {"loop_overrun": True}, {}, Reason.OVERRUNS),
        ({"velocity_tolerance": 4.0, "jump_tolerance": 1.0, "start_box": 3.0}, {},
         {"pose": {"position": (1.5, 0.0, 0.0)}}, Reason.POSE_CONTRADICTION),
    ],
)  # fmt: skip
def test_what_was_before_a_flight_counts_against_it(limits, before, changes, reason):
    flight = Flight(**limits)
    flight.ticks(10, operator=OFF, **before)
    verdict = flight.tick(**changes)
    assert verdict.state is State.DISARMED and verdict.reasons == (reason,)


def test_yaw_is_compared_around_the_circle():
    flight = Flight(start_yaw_degrees=175.0)
    flight.ticks(10, operator=OFF, pose={"attitude": turned(2, -175.0)})
    assert flight.tick(pose={"attitude": turned(2, -175.0)}).state is State.FLYING


def test_the_enable_counts_only_as_it_is_given():
    flight = Flight()
    assert flight.ticks(20).reasons == (Reason.NOT_RELEASED,)  # on from the beginning
    flight.ticks(6, operator=OFF)  # 5/32 s from the first to the last: too short
    assert flight.tick().reasons == (Reason.NOT_RELEASED,)
    flight.ticks(8, operator=OFF)  # 7/32 s
    assert flight.tick(arm_requested=False).reasons == (Reason.NOT_REQUESTED,)
    assert flight.tick().reasons == (Reason.NOT_RELEASED,)  # what stood in its way is gone, but it was given before
    assert flight.ticks(8, operator=OFF).state is State.DISARMED
    assert flight.tick().state is State.FLYING


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("operator", [KILL, Operator(False, True)])
def test_kill_wins_in_every_state_in_the_same_tick(state, operator):
    flight = in_state(state)
    verdict = flight.tick(operator=operator)
    assert verdict.state is State.CUT and not verdict.command.armed and Reason.KILL in verdict.reasons
    assert flight.tick().state is State.CUT


def test_kill_forgets_that_the_enable_was_released():
    flight = Flight().ready()
    flight.tick(operator=Operator(False, True))
    assert flight.tick().reasons == (Reason.NOT_RELEASED,)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"operator": OFF}, Reason.NO_ENABLE),
        ({"operator": None}, Reason.NO_ENABLE),
        ({"arm_requested": False}, Reason.NOT_REQUESTED),
        ({"contract_mismatch": "other camera"}, Reason.CONTRACT),
        ({"after": -1e-6}, Reason.CLOCK),
        ({"after": 0.201}, Reason.CLOCK),
        ({"after": math.nan}, Reason.CLOCK),
        ({"after": math.inf}, Reason.CLOCK),
        ({"age": 0.151}, Reason.POSE_LOST),
        ({"age": math.inf}, Reason.POSE_LOST),
        ({"age": math.nan}, Reason.POSE_LOST),
        ({"pose": {"position": (1.0, math.nan, 0.0)}}, Reason.NOT_FINITE),
        ({"pose": {"velocity": (math.inf, 0.0, 0.0)}}, Reason.NOT_FINITE),
        ({"pose": {"attitude": np.zeros(4)}}, Reason.NOT_FINITE),
        ({"pose": {"attitude": 0.8 * turned(0, 20.0)}}, Reason.NOT_FINITE),
        ({"pose": {"position": (1.0, 0.0)}}, Reason.NOT_FINITE),
        ({"pose": {"velocity": (0.0, 10.7, 10.7)}}, Reason.SPEED),
        ({"pose": {"position": (1.6, 0.0, 0.0)}}, Reason.POSE_JUMP),  # 15 m/s / 32 + 0.1 m = 0.57 m
    ],
)
def test_it_cuts_in_the_same_tick(changes, reason):
    verdict = Flight().flying().tick(**changes)
    assert verdict.state is State.CUT and not verdict.command.armed
    assert reason in verdict.reasons and verdict.words


@pytest.mark.parametrize(
    "changes",
    [
        {"after": 0.0},
        {"after": 0.199},
        {"age": 0.05},
        {"age": -0.01},
        {"pose": {"velocity": (0.0, 10.5, 10.5)}},
        {"pose": {"position": (1.5, 0.0, 0.0)}},
        {"pose": {"attitude": turned(0, 180.0)}},  # for a tick
        {"pose": {"attitude": 1.05 * turned(0, 30.0)}},
    ],
)
def test_it_flies_on_the_near_side_of_each_threshold(changes):
    assert Flight().flying().tick(**changes).state is State.FLYING


def moving(went, claimed):
    """A pose that has gone so far along x, m, and claims a velocity, m/s."""
    return {"position": (1.0 + went, 0.0, 0.0), "velocity": (claimed, 0.0, 0.0)}


def turning(went, claimed):
    """A pose that has yawed so far, rad, and claims a rate, rad/s."""
    return {"attitude": turned(2, math.degrees(went)), "rates": (0.0, 0.0, claimed)}


def claiming(pose, went, claimed):
    """The verdicts of ticks in which poses go at one velocity or rate and claim another, in a window of three ticks."""
    limits = {"velocity_tolerance": 4.0} if pose is moving else {"rate_tolerance": 5.0}
    flight = Flight(velocity_window=3 * PERIOD, jump_tolerance=1.0, **limits).flying()
    return [flight.tick(pose=pose(went * PERIOD * (step - 0.5), claimed)) for step in range(1, 6)]


@pytest.mark.parametrize(
    ("pose", "went", "claimed", "state"),
    [*((moving, 5.0, claimed, State.FLYING) for claimed in (5.0, 8.9, 1.1)),
     *((moving, 5.0, claimed, State.CUT) for claimed in (9.1, 0.9, -5.0)),
     *((turning, 4.0, claimed, State.FLYING) for claimed in (4.0, 8.9, -0.9)),
     *((turning, 4.0, claimed, State.CUT) for claimed in (9.1, -1.1, -4.0))],
)  # fmt: skip
def test_both_sides_of_what_is_claimed_may_differ_from_how_poses_change(pose, went, claimed, state):
    verdict = claiming(pose, went, claimed)[-1]
    assert verdict.state is state and verdict.command.armed == (state is State.FLYING)
    words = {
        moving: f"velocities and positions of poses differ by {abs(claimed - went):.3g} m/s (allowed: 4)",
        turning: f"body rates and attitudes of poses differ by {abs(claimed - went):.3g} rad/s (allowed: 5)",
    }
    wrong = verdict.reasons[:1], verdict.words[:1]
    assert wrong == (((), ()) if state is State.FLYING else ((Reason.POSE_CONTRADICTION,), (words[pose],)))


def test_degrees_a_second_for_radians_do_not_arm_where_somebody_turns_it_by_hand():
    flight = Flight(rate_tolerance=5.0, start_yaw_tolerance_degrees=180).ready()
    for step in range(6):
        pose = {"attitude": turned(2, 20.0 * step * PERIOD), "rates": (0.0, 0.0, 20.0)}
        verdict = flight.tick(pose=pose, operator=OFF)
    assert Reason.POSE_CONTRADICTION in verdict.reasons, verdict.words


def test_a_source_that_says_nothing_of_velocities_but_zeros_is_cut_within_its_window():
    """Half a tick's way is behind it at the first tick, a sixth of the window at 9 m/s, and then three."""
    verdicts = claiming(moving, 9.0, 0.0)
    assert [verdict.state for verdict in verdicts[:2]] == [State.FLYING, State.CUT]
    assert Reason.POSE_CONTRADICTION in verdicts[1].reasons


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("degrees", "state"), [(46.8, State.FLYING), (46.9, State.CUT), (180.0, State.CUT),
                                                (-46.8, State.FLYING), (-90.0, State.CUT)])  # fmt: skip
def test_both_sides_of_what_an_attitude_may_turn_between_two_poses(axis, degrees, state):
    """15 rad/s for 1/32 s are 26.86°, and 20° of tolerance."""
    flight = Flight(turn_rate_max=15.0, turn_tolerance_degrees=20.0).flying()
    verdict = flight.tick(pose={"attitude": turned(axis, degrees)})
    assert verdict.state is state and verdict.reasons == (() if state is State.FLYING else (Reason.ATTITUDE_JUMP,))
    jumped = f"the attitude jumped by {abs(degrees):.0f}° (allowed since the last one: 47)"
    assert state is State.FLYING or verdict.words == (jumped,)


def test_an_attitude_and_its_negative_are_the_same_one():
    flight = Flight(turn_tolerance_degrees=1.0).flying()
    assert flight.tick(pose={"attitude": -turned(2, 10.0)}).state is State.FLYING


def test_a_steady_turn_is_no_jump_however_far_it_goes():
    flight = Flight(turn_tolerance_degrees=1.0, turn_rate_max=15.0).flying()
    for step in range(1, 30):
        assert flight.tick(pose={"attitude": turned(2, 26.0 * step)}).state is State.FLYING


def test_poses_that_come_seldom_are_held_to_what_they_claim():
    """Those 0.12 s apart, at which it holds and flies on by turns: older than to fly on, not as old as to cut."""
    flight = Flight(velocity_tolerance=4.0, velocity_window=0.0625).flying()
    for step in range(1, 40):
        fresh = step % 4 == 0
        verdict = flight.tick(
            pose={"position": (1.0 + 2.0 * step * PERIOD, 0.0, 0.0), "velocity": (-6.0, 0.0, 0.0)}, lost=not fresh
        )
        if verdict.state is State.CUT:
            break
    assert verdict.state is State.CUT and verdict.reasons == (Reason.POSE_CONTRADICTION,), verdict.words
    assert step <= 8


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_fence_has_six_faces(axis, side):
    flight = Flight(jump_tolerance=10.0).flying()
    face = (LIMITS.fence_high if side > 0 else LIMITS.fence_low)[axis]
    position = np.array(LIMITS.start_position, float)
    position[axis] = face
    assert flight.tick(pose={"position": position}).state is State.FLYING
    position[axis] += 0.001 * side
    verdict = flight.tick(pose={"position": position})
    assert verdict.state is State.CUT and verdict.reasons == (Reason.GEOFENCE,)


@pytest.mark.parametrize(("degrees", "reasons"), [(99.9, ()), (100.1, (Reason.TILT,)), (180.0, (Reason.TILT,))])
@pytest.mark.parametrize("axis", [0, 1])
def test_tilt_cuts_when_it_lasts(axis, degrees, reasons):
    flight = Flight(tilt_time=0.25).flying()
    tilted = {"pose": {"attitude": turned(axis, degrees)}}
    assert flight.ticks(8, **tilted).state is State.FLYING  # as long as allowed
    verdict = flight.tick(**tilted)
    assert verdict.reasons == reasons and verdict.command.armed == (not reasons)


def test_what_has_flown_and_lies_still_is_cut():
    flight = Flight(still_time=0.5).flying()
    assert flight.ticks(40).state is State.FLYING  # it has not left the start yet, and has 3 s for that
    flight.tick(pose={"position": (1.11, 0.0, 0.0)})
    # no two measurements are the same, and speeds that are estimated from noisy positions are seldom low
    measured = [{"position": (1.11, 0.0, 1e-3 * digit), "velocity": (0.0, 0.3, 0.0)} for digit in range(17)]
    assert [flight.tick(pose=pose).state for pose in measured[:16]] == [State.FLYING] * 16  # as long as allowed
    verdict = flight.tick(pose=measured[16])
    assert verdict.state is State.CUT and verdict.reasons == (Reason.STRANDED,)


@pytest.mark.parametrize("claimed", [3.0, 0.0])
def test_a_pose_that_is_repeated_as_if_new_while_it_flies_is_cut(claimed):
    """At 3 m/s the odometer tolerates it and nothing seems to lie still; without velocities, it seems to lie still."""
    flight = Flight(velocity_tolerance=4.0, jump_tolerance=1.0, cut_after=0.125).flying()
    flight.tick(pose={"position": (1.15, 0.0, 0.0), "velocity": (3.0, 0.0, 0.0)})
    frozen = {"pose": {"position": (1.2, 0.0, 0.0), "velocity": (claimed, 0.0, 0.0)}}
    assert flight.ticks(5, **frozen).state is State.FLYING  # 4/32 s from the first to the last: as long as allowed
    verdict = flight.tick(**frozen)
    assert verdict.state is State.CUT and verdict.reasons == (Reason.POSE_FROZEN,)
    assert verdict.words == ("poses have been the same for 0.156 s (allowed: 0.125)",)


def test_poses_that_freeze_at_the_first_centimetres_are_cut_as_soon():
    flight = Flight(velocity_tolerance=4.0, cut_after=0.125).flying()
    flight.tick(pose={"position": (1.0, 0.0, 0.05), "velocity": (0.0, 0.0, 0.6)})
    frozen = {"pose": {"position": (1.0, 0.0, 0.06), "velocity": (0.0, 0.0, 0.6)}}
    assert flight.ticks(5, **frozen).state is State.FLYING
    assert flight.tick(**frozen).reasons == (Reason.POSE_FROZEN,)


@pytest.mark.parametrize("moved", [{"position": (1.2, 1e-9, 0.0)}, {"attitude": turned(2, 1e-3)}])
def test_a_pose_of_which_anything_changes_is_not_frozen(moved):
    flight = Flight(cut_after=0.125, jump_tolerance=1.0, still_time=60.0).flying()
    flight.tick(pose={"velocity": (3.0, 0.0, 0.0)})
    still = {"position": (1.2, 0.0, 0.0), "velocity": (3.0, 0.0, 0.0)}
    for _ in range(10):
        assert flight.ticks(4, pose=still).state is State.FLYING
        assert flight.tick(pose=still | moved).state is State.FLYING


def test_what_stands_on_the_ground_may_be_measured_the_same_again_and_again():
    assert Flight(lift_off_time=3.0).flying().ticks(80).state is State.FLYING


LIFTED = {"lift": Setpoint(11.0, np.zeros(3))}


def test_a_lift_is_sent_in_place_of_a_setpoint_that_is_usable_and_of_no_other():
    flight = Flight().flying()
    command = flight.tick(**LIFTED).command
    assert command.setpoint.collective_thrust == 11.0 and not command.setpoint.body_rates.any()
    for unusable in (None, Setpoint(np.nan, np.zeros(3))):
        verdict = flight.tick(setpoint=unusable, **LIFTED)
        assert verdict.state is State.HOLD and verdict.command.setpoint.collective_thrust == hover().collective_thrust


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_a_lift_is_cut_when_its_time_is_over_whatever_seems_to_move(velocity):
    flight = Flight(arm_time=0.25, lift_time=0.5).ready()
    verdict = flight.tick()
    armed, shift = flight.now, 0.0
    while verdict.state is State.FLYING:
        shift += 1e-9  # no two measurements are the same
        verdict = flight.tick(pose={"velocity": velocity, "position": (1.0, 0.0, shift)}, **LIFTED)
    assert verdict.state is State.CUT and verdict.reasons == (Reason.STRANDED,)
    assert flight.now - armed == pytest.approx(0.75 + PERIOD)


@pytest.mark.parametrize(("degrees", "state"), [(19.0, State.FLYING), (21.0, State.CUT)])
def test_what_tips_over_while_it_is_lifted_is_cut(degrees, state):
    flight = Flight(start_tilt_degrees=10.0).flying()
    verdict = flight.tick(pose={"attitude": turned(0, degrees)}, **LIFTED)
    assert verdict.state is state
    assert (Reason.TILT in verdict.reasons) is (state is State.CUT)


def test_tilt_counts_anew_after_being_upright():
    flight = Flight(tilt_time=0.25).flying()
    for _ in range(3):
        assert flight.ticks(8, pose={"attitude": turned(0, 170.0)}).state is State.FLYING
        flight.tick()


@pytest.mark.parametrize(
    "how", ["no pose", "the same pose", "the same pose as if new", "from the past", "from the future"]
)
def test_a_pose_that_grows_old_holds_and_then_cuts(how):
    flight = Flight(arm_time=0.01).flying()
    last, states = pose_at(flight.now), []
    for count in range(1, 17):
        flight.now += 0.01
        pose, age = {
            "no pose": (None, math.inf),
            "the same pose": (last, count * 0.01),
            "the same pose as if new": (last, 0.0),
            "from the past": (last._replace(time=last.time - count), 0.0),
            "from the future": (last._replace(time=last.time + 10.0 + count), 0.0),
        }[how]
        verdict = flight.safety.step(Tick(flight.now, pose, age, SETPOINT, ON, True))
        states.append(verdict.state)
        if verdict.state is State.HOLD:
            assert verdict.reasons == (Reason.POSE_STALE,) and verdict.command.armed
            np.testing.assert_allclose(verdict.command.setpoint.body_rates, 0.0, atol=1e-12)
            assert verdict.command.setpoint.collective_thrust == pytest.approx(GRAVITY)
    # 0.05 s and 0.15 s are on the edges, where a last bit decides
    assert states[:4] == [State.FLYING] * 4 and states[5:14] == [State.HOLD] * 9 and states[15] is State.CUT


def test_it_flies_on_when_the_pose_comes_back():
    flight = Flight().flying()
    assert flight.ticks(4, lost=True).state is State.HOLD
    assert flight.tick(pose={"position": (3.0, 0.0, 0.0)}).state is State.FLYING  # 5/32 s at 15 m/s is 2.3 m


@pytest.mark.parametrize(
    "setpoint",
    [
        None,
        Setpoint(math.nan, np.zeros(3)),
        Setpoint(9.0, np.array([0.0, math.inf, 0.0])),
        Setpoint(9.0, np.zeros(2)),
        Setpoint(None, None),
    ],
)
def test_no_setpoint_holds_and_then_cuts(setpoint):
    flight = Flight(cut_after=0.125).flying()
    for _ in range(4):
        verdict = flight.tick(setpoint=setpoint)
        assert verdict.state is State.HOLD and verdict.reasons == (Reason.NO_SETPOINT,)
        assert verdict.command.setpoint.collective_thrust == GRAVITY
    assert flight.tick().state is State.FLYING
    flight.ticks(4, setpoint=setpoint)
    verdict = flight.tick(setpoint=setpoint)
    assert verdict.state is State.CUT and verdict.reasons == (Reason.SETPOINT_LOST,)


def test_the_actor_has_time_until_the_arming_is_over():
    flight = Flight(arm_time=0.125, cut_after=0.0625).ready()
    assert flight.ticks(4, setpoint=None).reasons == (Reason.ARMING,)
    assert flight.ticks(2, setpoint=None).reasons == (Reason.NO_SETPOINT,)  # as long as one that falls silent
    assert flight.tick(setpoint=None).reasons == (Reason.SETPOINT_LOST,)


def test_a_stale_pose_while_arming_leaves_the_motors_idle():
    flight = Flight(arm_time=0.5).ready()
    flight.tick()
    verdict = flight.ticks(2, lost=True)
    assert verdict.state is State.HOLD and verdict.command.setpoint.collective_thrust == 0.0


def test_overruns_cut_when_there_are_too_many_within_the_window():
    flight = Flight(overruns_max=2, overrun_window=0.25).flying()
    pattern = [True, False, False, False]  # the third comes 8 ticks, 0.25 s, after the first
    verdicts = [flight.tick(loop_overrun=overrun) for overrun in 3 * pattern]
    assert [verdict.state for verdict in verdicts] == 8 * [State.FLYING] + 4 * [State.CUT]
    assert verdicts[8].reasons == (Reason.OVERRUNS,)
    flight = Flight(overruns_max=2, overrun_window=0.25).flying()
    states = [flight.tick(loop_overrun=overrun).state for overrun in 5 * [True, False, False, False, False]]
    assert set(states) == {State.FLYING}


@pytest.mark.parametrize(("missed", "state"), [(3, State.FLYING), (4, State.CUT), (1000, State.CUT)])
def test_a_tick_that_misses_several_deadlines_counts_as_often(missed, state):
    verdict = Flight(overruns_max=3).flying().tick(loop_overrun=missed)
    assert verdict.state is state and verdict.reasons == (() if state is State.FLYING else (Reason.OVERRUNS,))


def test_a_link_that_takes_no_command_is_cut_when_that_lasts():
    flight = Flight(cut_after=0.125).flying()
    for _ in range(3):
        assert flight.ticks(3, command_dropped=True).state is State.FLYING
        assert flight.tick().state is State.FLYING  # one got through
    assert flight.ticks(4, command_dropped=True).state is State.FLYING  # 4/32 s, as long as allowed
    verdict = flight.tick(command_dropped=True)
    assert verdict.state is State.CUT and verdict.reasons == (Reason.LINK_LOST,)
    assert verdict.words == ("the link has accepted no command for 0.156 s",)


def test_a_flight_controller_that_refuses_is_not_armed_and_in_flight_is_cut():
    flight = Flight(refusal_time=0.5).ready()
    verdict = flight.tick(refusal="CALIB: it is calibrating")
    assert verdict.state is State.DISARMED and verdict.reasons == (Reason.REFUSED,)
    assert verdict.words == ("the flight controller refuses: CALIB: it is calibrating",)
    flight = Flight(refusal_time=0.5).flying()
    for _ in range(2):  # what it says of a moment ago is no refusal
        assert flight.ticks(16, refusal="ARM_SWITCH").state is State.FLYING
        assert flight.tick().state is State.FLYING
    assert flight.ticks(16, refusal="ARM_SWITCH").state is State.FLYING
    verdict = flight.tick(refusal="ARM_SWITCH")
    assert verdict.state is State.CUT and verdict.reasons == (Reason.REFUSED,)


def test_a_refusal_counts_from_arming_on():
    flight = Flight(refusal_time=0.5)
    flight.ticks(64, operator=OFF, refusal="RXLOSS")
    assert flight.tick().state is State.FLYING
    assert flight.ticks(16, refusal="RXLOSS").state is State.FLYING
    assert flight.tick(refusal="RXLOSS").state is State.CUT


def test_commands_are_clamped():
    flight = Flight(thrust_min=2.0, thrust_max=20.0, rate_max=(3.0, 2.0, 1.0)).flying()
    high = flight.ticks(20, setpoint=Setpoint(1e9, np.full(3, 1e9))).command.setpoint
    assert high.collective_thrust == 20.0 and tuple(high.body_rates) == (3.0, 2.0, 1.0)
    low = flight.ticks(20, setpoint=Setpoint(-1e9, np.full(3, -1e9))).command.setpoint
    assert low.collective_thrust == 2.0 and tuple(low.body_rates) == (-3.0, -2.0, -1.0)


def test_commands_change_no_faster_than_allowed_from_the_last_sent():
    flight = Flight(thrust_slew=32.0, rate_slew=16.0).flying()
    flight.ticks(60)  # until it is at the wanted one
    sent = flight.tick(setpoint=Setpoint(20.0, np.array([9.0, -9.0, 0.5]))).command.setpoint
    assert sent.collective_thrust == 13.0 and tuple(sent.body_rates) == (1.5, -2.5, 0.5)
    sent = flight.tick(setpoint=Setpoint(20.0, np.array([9.0, -9.0, 0.5])), after=2 * PERIOD).command.setpoint
    assert sent.collective_thrust == 15.0 and tuple(sent.body_rates) == (2.5, -3.5, 0.5)
    sent = flight.tick(setpoint=None).command.setpoint  # a hold is no excuse
    assert sent.collective_thrust == 14.0 and tuple(sent.body_rates) == (2.0, -3.0, 0.0)


def test_a_finished_flight_is_disarmed_and_begins_anew_only_on_purpose():
    flight = Flight().flying()
    verdict = flight.tick(finish=True)
    assert verdict.state is State.DISARMED and not verdict.command.armed and verdict.reasons == (Reason.FINISHED,)
    assert flight.tick().reasons == (Reason.NOT_RELEASED,)
    flight.ticks(8, operator=OFF)
    assert flight.tick().state is State.FLYING


def test_a_cut_is_latched_until_the_enable_is_given_anew():
    flight = in_state(State.CUT)
    away = {"pose": {"position": (1.5, 0.0, 0.0)}}
    verdict = flight.tick(**away)  # released and given, but not in the start box
    assert verdict.state is State.CUT and verdict.reasons == (Reason.OUTSIDE_START_BOX,)
    assert flight.ticks(50).state is State.CUT
    assert flight.ticks(8, operator=OFF).state is State.CUT
    assert flight.tick().state is State.FLYING


def test_a_clock_that_was_wrong_is_trusted_again_but_not_what_was_measured_by_it():
    flight = Flight()
    flight.tick(operator=OFF)
    flight.now = 5.0
    assert Reason.CLOCK in flight.tick(operator=OFF).reasons
    assert flight.ready().tick().state is State.FLYING


@pytest.mark.parametrize("older", ["by its time", "by its age"])
def test_the_older_of_a_pose_s_two_ages_counts(older):
    flight = Flight(arm_time=0.01).flying()
    flight.now += 0.06
    delay = 0.04  # between measurement and arrival, of which only one of the two knows
    pose = pose_at(flight.now - delay if older == "by its time" else flight.now)
    tick = Tick(flight.now, pose, 0.0 if older == "by its time" else delay, SETPOINT, ON, True)
    assert flight.safety.step(tick).state is State.FLYING
    assert flight.tick(after=0.02, lost=True).state is State.HOLD


def test_each_flight_begins_with_the_least_thrust():
    flight = Flight(thrust_slew=1.0).flying()
    assert flight.ticks(20).command.setpoint.collective_thrust > 0.5
    flight.ticks(8, operator=OFF)
    assert flight.tick().command.setpoint.collective_thrust == 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hold_after", 0.2),
        ("hold_after", math.nan),
        ("cut_after", 150),
        ("tick_max", 0.0),
        ("fence_low", (2, 0, 0)),
        ("fence_high", (4, 4, math.inf)),
        ("start_position", (1, 0)),
        ("rate_max", (1.0, 0.0, 1.0)),
        ("thrust_min", 9.81),
        ("thrust_max", 9.81),
        ("speed_max", math.inf),
        ("tilt_max_degrees", -1),
        ("turn_rate_max", 9.9),
        ("turn_tolerance_degrees", 0.0),
    ],
)
def test_limits_that_protect_nothing_are_refused(name, value):
    with pytest.raises(ValueError, match=name if name != "fence_low" else "start_position"):
        Safety(dataclasses.replace(LIMITS, **{name: value}))


# Whatever comes in.

odd = st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0, -0.001, 1e12])
numbers = st.one_of(odd, st.floats())
vectors = st.one_of(
    st.none(), st.just(np.zeros(3)), st.lists(numbers, min_size=2, max_size=4).map(np.array), st.just(np.zeros((3, 1)))
)
attitudes = st.one_of(st.none(), st.just(turned(0, 20.0)), st.lists(numbers, min_size=4, max_size=4).map(np.array))
poses = st.one_of(st.none(), st.builds(Pose, numbers, vectors, attitudes, vectors, vectors))
odd_setpoints = st.builds(Setpoint, st.one_of(st.none(), numbers), vectors)
good_setpoints = st.builds(
    Setpoint, st.floats(-50, 50), st.lists(st.floats(-50, 50), min_size=3, max_size=3).map(np.array)
)
setpoints = st.one_of(st.none(), odd_setpoints, good_setpoints)
operators = st.one_of(st.none(), st.builds(Operator, st.booleans(), st.booleans()))
odd_ticks = st.builds(
    Tick,
    now=numbers,
    pose=poses,
    pose_age=st.one_of(st.none(), numbers),
    setpoint=setpoints,
    operator=operators,
    arm_requested=st.booleans(),
    contract_mismatch=st.sampled_from([None, "other"]),
    loop_overrun=st.integers(0, 9),
    finish=st.booleans(),
    command_dropped=st.booleans(),
    refusal=st.sampled_from(("", "RXLOSS")),
)
small = st.builds(
    dict, after=st.floats(0.0, 0.06), setpoint=setpoints, lost=st.booleans(), loop_overrun=st.integers(0, 1)
)  # what a flight survives, mostly


def check(verdict, tick):
    """What holds for every verdict whatsoever."""
    command, limits = verdict.command, LIMITS
    values = np.array([command.setpoint.collective_thrust, *command.setpoint.body_rates])
    assert command.armed == (verdict.state in (State.FLYING, State.HOLD))
    assert not (tick.operator is not None and tick.operator.kill and command.armed)
    assert not (command.armed and (tick.operator is None or not tick.operator.enable or not tick.arm_requested))
    assert values.shape == (4,) and np.isfinite(values).all()
    assert limits.thrust_min <= values[0] <= limits.thrust_max and (abs(values[1:]) <= limits.rate_max).all()
    assert len(verdict.reasons) == len(verdict.words) and (command.armed or verdict.words)
    return values


@settings(max_examples=150, deadline=None)
@given(begin=st.booleans(), ticks=st.lists(st.one_of(odd_ticks, small), max_size=20))
def test_whatever_comes_in_it_sends_only_what_is_allowed(begin, ticks):
    flight = Flight().flying() if begin else Flight()
    before, armed = np.zeros(4), False
    if begin:
        first = flight.tick().command.setpoint
        before, armed = np.array([first.collective_thrust, *first.body_rates]), True
    cut = False
    for tick in ticks:
        now = flight.now
        if isinstance(tick, dict):
            flight.now += tick["after"]
            pose = None if tick["lost"] else pose_at(flight.now)
            tick = Tick(flight.now, pose, 0.0, tick["setpoint"], ON, True, None, tick["loop_overrun"])
        elif math.isfinite(tick.now):
            flight.now = tick.now
        verdict = flight.safety.step(tick)
        values = check(verdict, tick)
        if armed and verdict.command.armed:
            elapsed = max(0.0, flight.now - now)
            slew = np.array([LIMITS.thrust_slew, *3 * [LIMITS.rate_slew]])
            assert (abs(values - before) <= slew * elapsed + 1e-9).all()
        before, armed = values, verdict.command.armed
        cut = verdict.state is State.CUT or (cut and tick.operator is not None and tick.operator.enable)
        assert not (cut and armed), "a cut is latched while the enable is not released"


@settings(max_examples=50, deadline=None)
@given(
    count=st.integers(1, 40),
    period=st.floats(0.005, 0.04),
    ages=st.lists(st.sampled_from([0.0, math.inf, math.nan, None]), min_size=50, max_size=50),
)
def test_a_lost_pose_cuts_within_a_fifth_of_a_second(count, period, ages):
    flight = Flight(arm_time=0.04).ready()
    flight.ticks(count, after=period)
    lost_at = flight.now
    for age in itertools.cycle(ages):
        verdict = flight.tick(after=period, lost=True, age=age)
        if not verdict.command.armed:
            break
    assert verdict.state is State.CUT and flight.now - lost_at <= LIMITS.cut_after + period + 1e-9 <= 0.2


@settings(max_examples=30, deadline=None)
@given(st.lists(odd_ticks, max_size=20))
def test_the_same_ticks_give_the_same_verdicts(ticks):
    first, second = Safety(LIMITS), Safety(LIMITS)
    for tick in ticks:
        one, other = first.step(tick), second.step(tick)
        assert (one.state, one.reasons, one.words) == (other.state, other.reasons, other.words)


def test_limits_are_numbers_of_any_kind_and_counts_are_whole():
    track = load_track("circle")
    of_numpy = {"speed_max": np.float32(10.0), "overruns_max": np.int64(2), "thrust_max": np.float64(20.0)}
    Safety(SafetyLimits.of_track(track, **of_numpy))
    for change, message in (
        ({"speed_max": "10"}, "limits.speed_max='10': must be a number, above 0 and at most 10000"),
        ({"speed_max": np.float32(2e4)}, "limits.speed_max=20000.0: must be above 0 and at most 10000"),
        ({"overruns_max": 2.5}, "limits.overruns_max=2.5: must be a whole number, at least 0 and at most 1000"),
    ):
        with pytest.raises(ValueError, match=message):
            Safety(SafetyLimits.of_track(track, **change))


def test_limits_of_a_track_know_its_box_and_refuse_names_that_are_none():
    track = load_track("circle")
    limits = SafetyLimits.of_track(track, speed_max=9.0, rate_max=[5.0, 5.0, 2.0])
    assert limits.fence_high == track.bounds_high and limits.fence_low[2] < 0.0
    assert limits.start_position == track.start_position and limits.speed_max == 9.0
    assert limits.rate_max == (5.0, 5.0, 2.0)
    with pytest.raises(ValueError, match="limits.speed: no such limit; must be one of arm_time"):
        SafetyLimits.of_track(track, speed=9.0)
