"""What a run has taken: by the wall, and of its cores."""

from __future__ import annotations

import time

from dreamer_racing.training.clock import RunClock


def test_waiting_takes_wall_clock_but_no_core():
    clock = RunClock({})
    before = clock.read()
    time.sleep(0.2)
    after = clock.read()
    assert after["wall_clock"] - before["wall_clock"] >= 0.2
    assert 0.0 <= after["cpu_clock"] - before["cpu_clock"] < 0.1


def test_computing_takes_both():
    clock = RunClock({})
    start = time.process_time()
    while time.process_time() - start < 0.05:
        pass
    read = clock.read()
    assert read["wall_clock"] >= 0.049 and 0.05 <= read["cpu_clock"] < read["wall_clock"] + 0.05


def test_a_continued_run_goes_on_where_it_was():
    clock = RunClock({"env_steps": 3})
    clock.total = {"wall_clock": 100.0, "cpu_clock": 60.0, "score": 1.0}
    assert clock.total.keys() == {"wall_clock", "cpu_clock"}
    assert 100.0 <= clock.read()["wall_clock"] < 110.0 and 60.0 <= clock.read()["cpu_clock"] < 70.0
    clock.total = {}  # of a checkpoint that knows of no clock
    assert clock.total["wall_clock"] < 10.0
