"""Write what attacks measured into the last column of docs/reliability.md.

    python docs/reliability.py            # write the column
    python docs/reliability.py --check    # exit with status 1 if it is not up to date

The numbers are those of results/faults.json and results/fuzz.json, which faults.py and fuzz.py in tests/robustness
write, each with the commit that was attacked; what is in neither is not measured. Everything else of the page is
written by hand: a row that an attack is to fill is named in `ATTACKS` by its first cell.
"""

import argparse
import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reliability.md"
HEADING = "last attack"
NOT_MEASURED, NO_ATTACK = "not measured", "–"
ATTACKS = {
    "the process is killed, at any time": (
        "kill", "kill early", "kill at open", "kill at rename", "kill at fsync",
    ),
    "Ctrl-C, SIGTERM": ("SIGTERM",),
    "power loss, or the machine is taken away": ("kill by the clock",),
    "a file of a checkpoint is damaged or missing": ("damage", "checkpoints"),
    "the disk fills up": ("full disk",),
    "a loss or gradient that is not finite": ("not finite",),
    "an action or a world that is not finite": ("actions",),
    "the system clock changes": ("clock",),
    "a wrong option": ("overrides",),
    "an untrusted track file": ("tracks",),
    "an untrusted export": ("contracts",),
    "an untrusted checkpoint": ("checkpoints",),
}  # fmt: skip
"""Kinds of attacks by the fault that a row is about."""
TESTS = {
    "the process is killed, at any time": (
        "test_kill_during_a_save_leaves_a_loadable_checkpoint",
        "test_kill_at_each_step_of_publishing",
        "test_a_training_killed_at_any_file_of_a_save_goes_on_as_if_it_had_not_been",
        "test_a_resumed_run_equals_an_uninterrupted_one",
        "test_a_run_writes_the_same_rows_wherever_it_is_stopped",
        "test_a_resumed_run_of_the_control_suite_is_evaluated_as_an_uninterrupted_one",
    ),
    "Ctrl-C, SIGTERM": (
        "test_a_signal_saves_and_exits_cleanly_and_a_second_one_does_not_save",
        "test_ctrl_c_before_anything_is_there_is_no_traceback",
    ),
    "power loss, or the machine is taken away": (
        "test_a_run_that_saves_on_the_way_does_so_within_two_minutes_and_then_by_the_clock",
    ),
    "a file of a checkpoint is damaged or missing": (
        "test_every_damaged_or_missing_file_is_noticed_and_the_checkpoint_before_it_is_taken",
        "test_json_of_another_kind_is_damage",
    ),
    "the disk fills up": (
        "test_a_run_outlives_a_full_disk",
        "test_a_run_outlives_a_disk_that_takes_nothing_at_all",
        "test_a_run_that_cannot_be_saved_at_its_end_says_so",
    ),
    "too little disk space, before the run begins": ("test_a_disk_that_may_not_be_enough_is_said_before_the_run",),
    "a kill or a full disk while `best/` is replaced": ("test_the_old_best_stays_until_the_new_one_is_there",),
    "a second process in the same run folder": ("tests/training/test_directory.py",),
    "a loss or gradient that is not finite": (
        "test_a_loss_that_is_not_finite_ends_the_run",
        "test_a_lagging_guard_names_the_batch_that_was_bad",
    ),
    "an action or a world that is not finite": ("tests/envs/race/test_race.py", "tests/envs/simulator",),
    "the system clock changes": ("test_a_run_does_not_care_what_time_it_is",),
    "a run is resumed with other settings": (
        "test_a_resumed_run_says_what_is_other_than_it_was",
        "test_a_resumed_run_cannot_change_its_track",
    ),
    "a wrong option": (
        "tests/recipes/test_entry.py",
        "tests/recipes/test_refusals.py",
        "tests/recipes/test_usage.py",
    ),
    "an untrusted track file": ("tests/envs/tracks/test_loading.py",),
    "an untrusted export": ("test_a_contract_of_another_file_is_refused",),
    "a dependency of another version": ("tests/test_layout.py", ".ci/lowest", ".ci/run",),
    "used without a clone": ("tests/test_main.py", "test_provenance", ".ci/wheel",),
    "an untrusted checkpoint": ("test_a_malicious_state_is_refused_and_nothing_of_it_is_run",),
    "a program ends without `close()`": ("test_twenty_processes_that_close_nothing_end_with_status_zero",),
    "home directory missing or not writable": ("tests/test_machine.py",),
    "`MUJOCO_GL`, `PYOPENGL_PLATFORM` or `MUJOCO_EGL_DEVICE_ID` name something that is not there": (
        "tests/envs/test_worlds.py",
    ),
    "a terminal that is not UTF-8, or a closed pipe": ("tests/test_machine.py",),
    "the terminal is closed (SIGHUP)": (
        "tests/training/test_session.py",
        "test_a_signal_saves_and_exits_cleanly_and_a_second_one_does_not_save",
    ),
    "a run is killed early": (
        "test_a_run_that_saves_on_the_way_does_so_within_two_minutes_and_then_by_the_clock",
    ),
    "the wrong Python, without the project's packages": ("tests/recipes/test_entry.py",),
    "an environment is copied, pickled or sent": ("tests/envs/test_copies.py",),
    "a worker process is killed": ("test_a_worker_that_is_killed_is_replaced_and_no_frame_is_lost_or_counted_twice",),
}  # fmt: skip
"""Tests and folders of tests by the fault that a row is about."""
CALLS = re.compile(r"(?:call|after opening) \d+ of (\d+)")
"""Where a case was killed that is one of so many."""


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only check that the page is up to date")
    there = PAGE.read_text(encoding="utf-8")
    page = fill(there, read_results(ROOT / "results"))
    if parser.parse_args().check:
        if page != there:
            raise SystemExit("docs/reliability.md is not up to date: run python docs/reliability.py")
        return
    PAGE.write_text(page, encoding="utf-8")


def read_results(folder: Path) -> dict[str, str]:
    """Return a phrase on each kind of attack that was measured."""
    phrases: dict[str, str] = {}
    faults = _read(folder / "faults.json")
    for kind in dict.fromkeys(record["fault"] for record in faults):
        cases = [record for record in faults if record["fault"] == kind]
        survived = sum(record["survived"] for record in cases)
        there = max((int(calls[1]) for case in cases if (calls := CALLS.fullmatch(case.get("where", "")))), default=0)
        among = f", among {there}" if there > len(cases) else ""
        phrases[kind] = f"{kind}: {survived} of {len(cases)} survived{among}"
    for record in _read(folder / "fuzz.json"):
        phrases[record["kind"]] = f"{record['kind']}: {record['failed']} of {record['cases']:,} failed"
    return phrases


def fill(page: str, phrases: dict[str, str]) -> str:
    """Return a page with the last column of its table filled.

    Raises:
        ValueError: the table lacks a row of `ATTACKS`, or the column.
    """
    missing = set(ATTACKS)

    def cell(match: re.Match[str]) -> str:
        fault = match[1].strip()
        missing.discard(fault)
        kinds = ATTACKS.get(fault, ())
        found = [phrases.get(kind, f"{kind}: {NOT_MEASURED}") for kind in kinds]
        return f"{match[0].rpartition('|')[0].rpartition('|')[0]}| {'; '.join(found) or NO_ATTACK} |"

    head, heading, table = page.partition(f"| {HEADING} |\n")
    rows, blank, rest = table.partition("\n\n")
    separator, _, rows = rows.partition("\n")
    filled = re.sub(r"^\| ([^|]+)\|.*\|$", cell, rows, flags=re.MULTILINE)
    if missing or not heading:
        raise ValueError(f"{PAGE.name} lacks {', '.join(sorted(missing)) or f'the column {HEADING}'}.")
    return f"{head}{heading}{separator}\n{filled}{blank}{rest}"


def _read(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else []


if __name__ == "__main__":
    main()
