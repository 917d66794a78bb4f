"""Contracts against what an actor is to fly: track, rate, camera, and what safety lets through."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dreamer_racing.envs import tracks
from dreamer_racing.envs.drone.parameters import load_preset, save_drone
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.export.contract import describe_rate_loop
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.flyer import check_contract, check_flown_by_betaflight, check_ranges, check_rate_loop
from dreamer_racing.hil.safety_limits import SafetyLimits

AGENTS = Path(__file__).parents[2] / "agents"
CIRCLE = load_track("circle")


def contract_of(agent: str) -> dict:
    return read_contract(AGENTS / agent / "contract.json")


@pytest.mark.parametrize("agent", ["kidney", "circle", "figure8"])
def test_agents_that_ship_fit_their_tracks(agent):
    track = load_track(agent)
    assert check_contract(contract_of(agent), track, 25.0) is None
    assert check_ranges(contract_of(agent), SafetyLimits.of_track(track)) == []


def test_a_contract_that_does_not_fit_is_refused_with_what_differs():
    contract, kidney = contract_of("kidney"), load_track("kidney")
    assert check_contract(contract, kidney, 25.0) is None
    with pytest.raises(
        ValueError,
        match=r"source.track is 'kidney', whose .*, and .* track=circle .*; control.rate_hz is 25, and rate=50",
    ):
        check_contract(contract, CIRCLE, 50.0)
    with pytest.raises(ValueError, match=r"camera says images of \[1, 96, 64, 3\], and the input image_u8 is"):
        check_contract({**contract, "camera": {**contract["camera"], "height_px": 96}}, kidney)


def test_a_track_is_known_by_its_gates_not_by_its_name(tmp_path):
    contract, file = contract_of("circle"), tmp_path / "mine.yaml"
    built_in = (Path(tracks.__file__).parent / "circle.yaml").read_text(encoding="utf-8")
    file.write_text(built_in, encoding="utf-8")
    assert check_contract(contract, load_track(file)) is None  # the same, in a file of another name
    file = tmp_path / "circle.yaml"
    file.write_text(built_in.replace("4.0", "4.1"), encoding="utf-8")
    with pytest.raises(ValueError, match="source.track is 'circle', whose gates, .* and those of track=circle have"):
        check_contract(contract, load_track(file))


def test_an_older_contract_is_compared_by_name_and_says_so():
    contract = contract_of("circle")
    del contract["source"]["track_sha256"]
    note = check_contract(contract, CIRCLE)
    assert note is not None and "no source.track_sha256: circle was compared by its name only" in note
    with pytest.raises(ValueError, match="source.track is 'circle', and track=kidney"):
        check_contract(contract, load_track("kidney"))


def test_what_safety_would_clip_is_refused_unless_it_is_meant():
    contract, limits = contract_of("circle"), SafetyLimits.of_track(CIRCLE)
    assert check_ranges(contract, limits) == []
    for channel in contract["action"]["channels"]:
        channel["scale"], channel["offset"] = 1.6 * channel["scale"], 1.6 * channel["offset"]
    with pytest.raises(
        ValueError,
        match=r"limits.rate_max=\[10,10,4\] clips the actor, .* up to \[16,16,6.4\] rad/s .* Set limits.rate_max=\[16",
    ):
        check_ranges(contract, limits)
    with pytest.raises(ValueError, match=r"limits.thrust_max=30 clips the actor, which asks for up to 42.\d+ m/s²"):
        check_ranges(contract, replace(limits, rate_max=(16.0, 16.0, 6.4)))
    said = check_ranges(contract, limits, meant=("rate_max", "thrust_max"))
    assert [words.partition("=")[0] for words in said] == ["limits.rate_max", "limits.thrust_max"]


def trained_with(preset: str, **changed: Any) -> dict[str, Any]:
    """What a contract says of an actor of a preset."""
    return {"rate_loop": describe_rate_loop(replace(load_preset(preset), **changed))}


def test_an_actor_of_another_rate_loop_is_refused_with_both_and_flies_if_forced(tmp_path):
    words = r"trained with a proportional rate loop, and vehicle=betaflight has a Betaflight's rate loop.*force=true"
    with pytest.raises(ValueError, match=words):
        check_rate_loop(trained_with("faithful"), "betaflight", force=False)
    with pytest.raises(ValueError, match="trained with a Betaflight's rate loop, and vehicle=easy has a proportional"):
        check_rate_loop(trained_with("betaflight"), "easy", force=False)
    forced = check_rate_loop(trained_with("faithful"), "betaflight", force=True)
    assert forced is not None and forced.endswith("it flies all the same (force=true)")
    assert check_rate_loop(trained_with("easy"), "faithful", force=False) is None
    assert check_rate_loop(trained_with("betaflight"), "betaflight", force=False) is None
    old = {"source": {"preset": "easy"}}
    with pytest.raises(ValueError, match="trained with a proportional rate loop"):
        check_rate_loop(old, "betaflight", force=False)
    unknown = check_rate_loop({"source": {"preset": "mine"}}, "betaflight", force=False)
    assert unknown is not None and "says nothing of a rate loop" in unknown


def test_a_link_to_a_betaflight_is_for_actors_of_its_rate_loop():
    words = r"trained with a proportional rate loop, and link=crsf tells a Betaflight.*env=betaflight.*force=true"
    for contract in (trained_with("faithful"), {"source": {"preset": "easy"}}):
        with pytest.raises(ValueError, match=words):
            check_flown_by_betaflight(contract, "crsf", force=False)
    forced = check_flown_by_betaflight(trained_with("easy"), "crsf", force=True)
    assert forced is not None and forced.endswith("it flies all the same (force=true)")
    for contract in (trained_with("betaflight"), {"source": {"preset": "mine"}}):
        assert check_flown_by_betaflight(contract, "crsf", force=False) is None


@pytest.mark.parametrize(
    ("gains", "lag", "words"),
    [
        ((45.0, 47.0 * 1.25, 30.0), 0.03, None),  # within the widths of training, and what is allowed beyond them
        ((45.0, 47.0 * 1.35, 30.0), 0.03, r"p of pitch 47 \(± 20%\), and vehicle=.* has p of pitch 63.45"),
        ((45.0, 47.0, 30.0), 0.05, r"motors of 0.03 s \(± 30%\), and vehicle=.* has motors of 0.05 s"),
    ],
)
def test_gains_and_motors_may_differ_as_far_as_those_of_training_did(gains, lag, words, tmp_path):
    nominal = load_preset("betaflight")
    vehicle = replace(nominal, motor_time_constant=lag, betaflight=replace(nominal.betaflight, p=gains))
    save_drone(tmp_path / "drone.yaml", vehicle, {})
    contract, file = trained_with("betaflight"), str(tmp_path / "drone.yaml")
    if words is None:
        assert check_rate_loop(contract, file, force=False) is None
        return
    with pytest.raises(ValueError, match=words):
        check_rate_loop(contract, file, force=False)
    assert check_rate_loop(contract, file, force=True) is not None
