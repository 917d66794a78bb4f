"""Report in a few seconds what this machine has for training, what is wrong with it, and how to fix that.

    python recipes/doctor.py
    python recipes/doctor.py replay.capacity=1000000 checkpoint.keep=3    # would that fit?
    python recipes/doctor.py --json

Its exit status is 1 if something is wrong.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

from composing.entry import recipe

from dreamer_racing.doctor import Verdict, examine
from dreamer_racing.settings import COUNT, setting


@dataclass
class ReplaySize:
    """Replay setting, as in `recipes/dreamer_v3.py`."""

    capacity: int = setting(250_000, COUNT)  # records


@dataclass
class CheckpointNumber:
    """Checkpoint setting, as in `recipes/dreamer_v3.py`."""

    keep: int = setting(2, COUNT)


@dataclass
class DoctorConfig:
    """Configuration of `recipes/doctor.py`."""

    replay: ReplaySize = field(default_factory=ReplaySize)
    checkpoint: CheckpointNumber = field(default_factory=CheckpointNumber)
    run_dir: str = "runs"  # folder for runs
    json: bool = False  # print JSON on stdout, for programs; --json does the same


@recipe("doctor", DoctorConfig, logs=False)
def main(config: DoctorConfig) -> None:
    """Examine the machine, and print the findings."""
    findings = []
    for finding in examine(config.replay.capacity, config.checkpoint.keep, Path(config.run_dir)):
        findings.append(finding)
        if not config.json:
            remedy = f"\n{'':25}→ {finding.remedy}" if finding.remedy else ""
            print(f"{finding.what:<14} {finding.state.value:<9} {finding.found}{remedy}", flush=True)
    if config.json:
        print(json.dumps([{**finding._asdict(), "state": finding.state.value} for finding in findings], indent=1))
    if any(finding.state is Verdict.wrong for finding in findings):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
