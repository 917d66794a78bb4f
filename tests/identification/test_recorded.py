"""Recordings on their grid: by hand, and what is refused."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.envs.drone.parameters import GRAVITY
from dreamer_racing.identification.recorded import DT, Recorded, of_flight, read_recorded, stretches

COLUMNS = ("t", "thrust_cmd", "wx_cmd", "wy_cmd", "wz_cmd", "wx", "wy", "wz")


def recorded(seconds: float, amplitude: float = 2.0) -> Recorded:
    """Commands that change every 0.1 s on all axes, and rates that are those."""
    count = round(seconds / DT)
    time = DT * np.arange(count)
    signs = np.sign(np.sin(2 * np.pi * time / 0.2 + 0.01))
    command = np.column_stack((GRAVITY + amplitude * signs, *(3 * (amplitude * signs,))))
    fresh = np.concatenate(([True], np.diff(signs) != 0))
    return Recorded(command, fresh, command[:, 1:].copy(), command[:, 0].copy())


def test_a_recording_that_tells_enough_passes() -> None:
    recorded(5.0).check("this one")
    assert recorded(5.0).moved() == (5.0, 5.0, 5.0, 5.0)


def test_what_is_too_short_or_too_quiet_says_which_axis_needs_what() -> None:
    with pytest.raises(ValueError, match=r"this one is too short or too quiet: yaw was moved for 2 s, and needs 3 s"):
        recorded(2.5).check("this one")
    quiet = recorded(5.0)
    quiet.command[:, 1] = 0.01
    with pytest.raises(
        ValueError, match=r"quiet: roll was moved for 0 s, and needs 2 s .* vary by 0.4 rad/s"
    ) as raised:
        quiet.check("this one")
    assert "pitch" not in str(raised.value) and "actor=identify" in str(raised.value)
    blind = recorded(5.0)
    blind.rates[:] = np.nan
    with pytest.raises(ValueError, match="roll was moved for 0 s"):
        blind.check("this one")


def test_stretches_have_no_gap_and_begin_behind_one() -> None:
    flown = recorded(2.0)
    flown.rates[700] = np.nan
    assert stretches(flown, 0.5, 0.1) == [slice(0, 500), slice(701, 1201), slice(1101, 1601), slice(1501, 2001)][:3]


def test_a_table_is_read_on_its_grid(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for index in range(300):
            command = (GRAVITY, 1.0, 0.0, 0.0) if index < 100 else (12.0, -1.0, 0.5, 0.2)
            rates = (0.001 * index, 0.0, 0.0) if index != 200 else (9.0, 0.0, 0.0)
            writer.writerow((5.0 + DT * index, *command, *rates))
    read = read_recorded(path)
    assert len(read.command) in (299, 300)
    assert read.command[99].tolist() == [GRAVITY, 1.0, 0.0, 0.0]
    assert read.command[101].tolist() == [12.0, -1.0, 0.5, 0.2]
    assert read.fresh.sum() == 2
    assert np.isnan(read.force).all()
    assert np.isnan(read.rates[199:202]).any(1).sum() >= 1, "nothing flies from 0.2 to 9 rad/s in a ms"
    assert read.rates[150, 0] == pytest.approx(0.15, abs=0.002)
    with pytest.raises(FileNotFoundError, match="no recording"):
        read_recorded(tmp_path / "none.csv")
    path.write_text("t,wx\n0,0\n")
    with pytest.raises(ValueError, match="lacks thrust_cmd, wx_cmd"):
        read_recorded(path)


class Flown:
    """A flight by hand: it hovers, tilted, and is sent two commands; poses come 30 ms late."""

    about: dict = {"config": {"latency": 0.03}}

    def __init__(self, armed: bool = True) -> None:
        tilted = (np.cos(0.2), np.sin(0.2), 0.0, 0.0)  # 0.4 rad
        self.ticks = []
        for index in range(100):
            now = 1000.0 + 0.01 * index
            packets = [
                [now + 0.03, 2 * index + part, 5.0 + 0.01 * index + 0.005 * part, 0.0, 0.0, 1.0, *tilted,
                 0.0, 0.0, 0.0, 0.1 * index, 0.0, 0.0]
                for part in range(2)
            ]  # fmt: skip
            self.ticks.append({
                "in": {"time": now, "received": packets},
                "took": {"sent": 0.001},
                "out": {"command": [armed, 10.0 if index < 50 else 11.0, 1.0, 2.0, 3.0]},
            })  # fmt: skip


def test_a_flight_is_read_by_the_clock_of_its_loop() -> None:
    read = of_flight(Flown())
    assert read.command[0].tolist() == [10.0, 1.0, 2.0, 3.0]
    changed = int(np.flatnonzero(read.command[:, 0] == 11.0)[0])
    assert changed == pytest.approx(500, abs=1)
    assert read.fresh.sum() >= 95
    # a pose that arrives at t was measured at t - 0.03 at the latest
    assert read.rates[510, 0] == pytest.approx(5.1, abs=0.2)
    assert np.nanmean(read.force) == pytest.approx(GRAVITY * np.cos(0.4), rel=0.01)
    with pytest.raises(ValueError, match="never armed"):
        of_flight(Flown(armed=False))
