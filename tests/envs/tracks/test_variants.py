"""Tracks made from tracks: decoys change what is seen and nothing else, displaced gates can be flown."""

from __future__ import annotations

import dataclasses
import math

import pytest

from dreamer_racing.envs.tracks import (
    BUILTIN_TRACKS,
    PLAIN_TRACKS,
    Gate,
    TrackError,
    decoys_for,
    displace_gates,
    load_track,
    with_decoys,
)


def test_decoys_of_figure8_are_those_of_its_own_track_file():
    plain, decorated = load_track("figure8"), load_track("figure8_decoys")
    assert with_decoys("figure8", "paper") == with_decoys("figure8_decoys", "paper") == decorated
    assert dataclasses.replace(decorated, name=plain.name, decoys=()) == plain
    assert len(decorated.decoys) == 2


def test_decoys_are_taken_away_and_left_alone():
    assert with_decoys("figure8_decoys", "none") == with_decoys("figure8", None) == load_track("figure8")
    assert with_decoys("figure8_decoys", None).decoys
    mine = dataclasses.replace(load_track("circle"), decoys=(Gate((0.0, 0.0, 1.35), 0.0, kind="decoy"),))
    assert with_decoys(mine, "none").decoys == ()


def test_which_tracks_have_decoys():
    found = {name: decoys_for(load_track(name)) for name in BUILTIN_TRACKS}
    assert {name for name, decoys in found.items() if decoys == "paper"} == {"figure8", "figure8_decoys"}
    assert found["circle"] is None


def test_plain_tracks_are_other_races_than_each_other():
    races = [load_track(name).gates for name in PLAIN_TRACKS]
    assert len(set(races)) == len(races)
    assert set(races) == {load_track(name).gates for name in BUILTIN_TRACKS}


@pytest.mark.parametrize(
    ("track", "decoys", "words"),
    [("circle", "paper", ["decoys=paper", "figure8", "circle"]), ("figure8", "many", ["decoys=many", "paper", "none"])],
)
def test_decoys_that_are_not_there(track, decoys, words):
    with pytest.raises(TrackError) as error:
        with_decoys(track, decoys)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize("name", BUILTIN_TRACKS)
def test_displaced_gates(name):
    track = load_track(name)
    farthest = widest = 0.0
    for seed in range(10):
        displaced = displace_gates(track, shift=0.3, turn_degrees=10.0, seed=seed)
        assert load_track(displaced) is displaced  # it can be flown
        assert displaced == displace_gates(track, 0.3, 10.0, seed) != displace_gates(track, 0.3, 10.0, seed + 1)
        assert dataclasses.replace(displaced, name=track.name, gates=track.gates) == track
        for old, new in zip(track.gates, displaced.gates, strict=True):
            farthest = max(farthest, math.dist(old.position, new.position))
            widest = max(widest, abs(new.yaw_degrees - old.yaw_degrees))
            assert old.position != new.position
    assert 0.27 < farthest <= 0.3
    assert 8.5 < widest <= 10.0


def test_displacements_that_cannot_be_flown_are_refused():
    with pytest.raises(TrackError, match=r"circle.*none of 1000 displacements by up to 50"):
        displace_gates(load_track("circle"), shift=50.0, turn_degrees=0.0, seed=0)
