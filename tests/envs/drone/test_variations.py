"""Drones as files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dreamer_racing.envs.drone.parameters import PRESETS, load_preset, save_drone

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
    assert load_preset(str(path)) == drone
    assert "gyro_lpf2" not in path.read_text(), "only what differs is written"


def test_a_file_by_hand_may_be_of_any_preset(tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    path.write_text("preset: faithful\nparameters: {mass: 0.5, drag: [0.1, 0.1, 0.2]}\n")
    assert load_preset(str(path)) == replace(PRESETS["faithful"], mass=0.5, drag=(0.1, 0.1, 0.2))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "there is no such file"),
        ("preset: [", "is no YAML"),
        ("- 1", "is no drone"),
        ("preset: easy\nparameters: 3", "is no drone"),
        ("preset: eazy", r"'eazy' is none of .*\(did you mean easy\?\)"),
        ("preset: easy\nparameters: {mas: 1}", r"there is no parameter 'mas' \(did you mean mass\?\)"),
        ("preset: easy\nparameters: {mass: -1}", "mass=-1: must be above 0"),
        ("preset: easy\nparameters: {mass: heavy}", "mass='heavy': must be a number"),
        ("preset: easy\nparameters: {mass: {kg: 1}}", "mass={'kg': 1}: is no group of numbers"),
        ("preset: easy\nparameters: {drag: [1, 2]}", "drag=.*: must be three numbers"),
        ("preset: easy\nparameters: {randomisation: {mass: 0}}", "there is no parameter 'randomisation'"),
        ("preset: betaflight\nparameters: {betaflight: {p: [1, 2, -3]}}", "p=.*: must be three numbers"),
    ],
)
def test_what_is_no_drone_is_refused_by_file_and_field(text: str | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "drone.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=words) as raised:
        load_preset(str(path))
    assert str(path) in str(raised.value)
