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
    assert read["wall_clock"] >= 0.049 and 0.03 <= read["cpu_clock"] < read["wall_clock"] + 0.05  # read in 1/100 s


def test_a_continued_run_goes_on_where_it_was():
    clock = RunClock({"env_steps": 3})
    clock.total = {"wall_clock": 100.0, "cpu_clock": 60.0, "score": 1.0}
    assert clock.total.keys() == {"wall_clock", "cpu_clock"}
    assert 100.0 <= clock.read()["wall_clock"] < 110.0 and 60.0 <= clock.read()["cpu_clock"] < 70.0


def test_what_was_made_before_a_run_was_continued_is_not_in_its_rates():
    counters = {"updates": 0}
    clock = RunClock(counters)
    counters["updates"] = 1_000_000  # restored
    clock.total = {"wall_clock": 100.0, "cpu_clock": 60.0}
    assert clock.read()["rate/updates"] == 0.0


def test_what_an_older_run_did_not_record_stays_unknown():
    """From zero it would say that all before the start was free."""
    clock = RunClock({})
    clock.total = {"wall_clock": 100.0}
    assert clock.total.keys() == {"wall_clock"} and "cpu_clock" not in clock.read()
    clock.total = {"wall_clock": 100.0, "cpu_clock": 5.0}
    assert "cpu_clock" not in clock.read()


def test_one_of_several_processes_knows_the_wall_clock_alone():
    assert RunClock({}, alone=False).read().keys() == {"wall_clock"}
