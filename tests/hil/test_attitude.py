"""Attitudes: signs, sums and inverses, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamer_racing.hil.attitude import rotation_between, rotation_matrix, turn

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("axis", "turned", "towards"),
    [
        (0, 1, (0, 0, 1)),  # rolling right lifts the left side
        (1, 0, (0, 0, -1)),  # pitching by +y puts the nose down
        (2, 0, (0, 1, 0)),  # yawing by +z turns the nose left
    ],
)
def test_the_sign_of_every_axis(axis, turned, towards):
    rotation = np.zeros(3)
    rotation[axis] = math.pi / 2
    assert rotation_matrix(turn(LEVEL, rotation))[:, turned] == pytest.approx(towards, abs=1e-12)


def test_small_turns_add_up():
    attitude, rates = LEVEL, np.array([0.3, -0.7, 1.1])
    for _ in range(1000):
        attitude = turn(attitude, 1e-3 * rates)
    assert rotation_matrix(attitude) == pytest.approx(rotation_matrix(turn(LEVEL, rates)), abs=1e-9)
    assert turn(LEVEL, np.zeros(3)).tolist() == LEVEL.tolist()


@given(rotation=st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3), sign=st.sampled_from([-1.0, 1.0]))
def test_the_logarithm_undoes_a_turn(rotation, sign):
    """Up to 3.12 rad: at half a turn, left and right are the same."""
    first = turn(LEVEL, np.array([0.3, -2.0, 1.0]))
    assert rotation_between(first, sign * turn(first, np.array(rotation))) == pytest.approx(rotation, abs=1e-9)
