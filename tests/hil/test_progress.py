"""Gates passed in order, by hand, and as the race itself counts them."""

from __future__ import annotations

import numpy as np
import pytest

from dreamer_racing.envs.tracks import Gate, make_track
from dreamer_racing.hil.progress import GateProgress
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Pose

TRACK = make_track("line", [Gate((0.0, 0.0, 1.35), 0.0), Gate((5.0, 0.0, 1.35), 0.0)])


def at(time: float, *position: float) -> Pose:
    return Pose(time, np.array(position), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3))


def fly(*poses: Pose) -> GateProgress:
    progress = GateProgress(TRACK, SafetyLimits.of_track(TRACK))
    for pose in poses:
        progress.update(pose)
    return progress


def test_a_pass_has_a_time_and_an_offset():
    progress = fly(at(1.0, -0.3, 0.3, 1.35), at(1.1, 0.1, 0.3, 1.75))
    assert progress.target == 1
    assert progress.passes[0].gate == 0
    assert progress.passes[0].time == pytest.approx(1.075)
    assert progress.passes[0].offset == pytest.approx(np.hypot(0.3, 0.3))


@pytest.mark.parametrize(
    "poses",
    [
        (at(0, 0.1, 0, 1.35), at(1, -0.1, 0, 1.35)),  # backwards
        (at(0, -0.1, 0.8, 1.35), at(1, 0.1, 0.8, 1.35)),  # beside the opening
        (at(0, -0.1, 0, 2.1), at(1, 0.1, 0, 2.1)),  # over it
        (at(0, 4.9, 0, 1.35), at(1, 5.1, 0, 1.35)),  # the second first
        (at(0, 0.1, 0, 1.35), at(1, 0.3, 0, 1.35)),  # behind it all the time
    ],
)
def test_what_is_no_pass(poses):
    assert not fly(*poses).passes


def test_a_pose_counts_where_safety_would_allow_it():
    """5 ms after the one before it may be 0.175 m further; several gates may be passed from one tick to the next."""
    near = make_track("near", [Gate((0.0, 0.0, 1.35), 0.0), Gate((0.3, 0.0, 1.35), 0.0)])
    progress = GateProgress(near, SafetyLimits.of_track(near))
    for number, x in enumerate((-0.05, 0.05, 0.15, 0.25, 0.35)):
        progress.update(at(0.005 * number, x, 0.0, 1.35), judged=x > 0.3)
    assert [passed.gate for passed in progress.passes] == [0, 1]
    progress.reset()
    progress.update(at(1.0, -0.2, 0.0, 1.35))
    assert progress.update(at(1.005, 0.2, 0.0, 1.35), judged=False) is None
    assert progress.update(at(1.010, -0.1, 0.0, 1.35)) is None
    assert progress.update(at(1.015, 0.2, 0.0, 1.35)) is None, "safety judges it, and cuts"
    assert progress.passes == []


def test_laps_go_on_and_a_reset_begins_anew():
    lap = [at(0, -1, 0, 1.35), at(1, 1, 0, 1.35), at(2, 6, 0, 1.35), at(3, 6, 9, 1.35), at(4, -1, 9, 1.35)]
    progress = fly(*lap, *lap)
    assert [passed.gate for passed in progress.passes] == [0, 1, 0, 1]
    progress.reset()
    assert (progress.target, progress.passes) == (0, [])
