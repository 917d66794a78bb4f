"""Words on films: what they say of a race by hand, and that they cover nothing of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.figures.film import CONTEXT_COLOR, OPEN_LOOP_COLOR
from dreamer_racing.figures.hud import (
    SEEN,
    STRIP_COLOR,
    caption,
    dream_words,
    laps_completed,
    race_words,
    slow_motion,
)
from tests.figures.test_flights import random_flight


def test_time_speed_gate_and_lap_of_a_race():
    track = replace(load_track("circle"), laps=2)  # four gates
    flight = random_flight(steps=9)
    flight.target_gate[:] = torch.tensor([0, 0, 1, 2, 3, 0, 1, 2, 3, 0])
    flight.linear_velocity[:] = torch.tensor([3.0, 0.0, 4.0])
    flight.linear_velocity[4] = float("nan")
    words = race_words(track, flight)
    assert words[0] == " 0.00 s   5.0 m/s  gate 1/4  lap 1/2"
    assert words[4] == " 0.08 s   lost  gate 4/4  lap 1/2"
    assert words[5] == " 0.10 s   5.0 m/s  gate 1/4  lap 2/2"
    assert words[9].endswith("gate 1/4  lap 2/2")  # the race is over: there is no third lap


def test_a_lap_that_ends_in_a_step_of_two_gates_counts():
    flight = random_flight(steps=9)
    flight.target_gate[:] = torch.tensor([0, 2, 3, 1, 2, 3, 0, 0, 2, 0])
    assert laps_completed(flight).tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]


def test_a_dream_says_what_it_has_seen():
    assert dream_words(3, context=2, frame_dt=0.08) == [SEEN, SEEN, "imagined +0.08 s"]
    assert dream_words(5, 1, 0.04, cycle=3) == [SEEN, "imagined +0.04 s", "imagined +0.08 s", SEEN, "imagined +0.04 s"]


def test_words_stand_above_the_picture():
    frames = np.random.default_rng(0).integers(0, 256, (2, 30, 300, 3), dtype=np.uint8)
    film = caption(frames, ["1.00 s", "1.02 s"], [SEEN, "imagined +0.02 s"])
    strip = film.shape[1] - 30
    assert 12 < strip < 30 and film.shape[2] == 300
    np.testing.assert_array_equal(film[:, strip:], frames)
    for frame, color in zip(film, (CONTEXT_COLOR, OPEN_LOOP_COLOR), strict=True):
        letters = frame[:strip, 150:].reshape(-1, 3)
        distance = np.abs(letters.astype(int) - color).sum(-1)
        assert distance.min() < 40 and tuple(letters[0]) == STRIP_COLOR
    assert (film[0, :strip, :150] != film[1, :strip, :150]).any()
    with pytest.raises(ValueError, match="2 frames need as many lines: there are 1 and 0"):
        caption(frames, ["1.00 s"])


@pytest.mark.parametrize(("width", "right"), [(256, []), (528, [SEEN])])
def test_a_line_fits_into_its_strip(width, right):
    words = "12.34 s  12.3 m/s  gate 10/12  lap 3/3  8x slower"
    film = caption(np.zeros((1, 4, width, 3), np.uint8), [words], right)
    strip = film[0, : film.shape[1] - 4, : width // 2 if right else width]
    written = (strip != STRIP_COLOR).any((0, 2))
    assert written.any() and not written[-2:].any()


def test_flights_of_the_young_are_slowed():
    assert [slow_motion(seconds) for seconds in (12.0, 4.0, 1.5, 0.1, 0.0)] == [1, 1, 3, 8, 8]
