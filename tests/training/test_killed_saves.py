"""An outside oracle: ckpt-chaos kills a training at every file that its saves make, move or remove, or cuts it there.

Its own command starts Python twice for each. Here every training is forked with what it imports; the kills and the
verdicts are those of ckpt-chaos.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from dreamer_racing.training.checkpoint import RunCheckpoints
from tests.forked import SERVER

inject = pytest.importorskip("ckpt_chaos.inject")
invariants = pytest.importorskip("ckpt_chaos.invariants")

SAVES = 2
"""The first has nothing before it, the second replaces what the first is the newest of."""
MODES = ("before", "torn")
KILLED = 137


class Event(NamedTuple):
    """What a save did to a file."""

    number: int
    kind: str
    name: str
    tornable: bool


def train(folder: Path, saved: Path) -> tuple[int, bytes]:
    """Train to the end, from the newest checkpoint if there is one; note which saves have returned.

    Returns:
        The step that it went on from, and its weights.
    """
    torch.manual_seed(0)
    network = torch.nn.Linear(4, 4)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.1)
    counters = {"env_steps": 0}
    parts = {"network": network, "optimizer": optimizer, "counters": counters}
    checkpoints = RunCheckpoints(folder, parts, keep_last=1)
    if any(folder.glob("checkpoints/checkpoint-*")):
        checkpoints.load()
    began = counters["env_steps"]
    while counters["env_steps"] < SAVES:
        optimizer.zero_grad()
        network(torch.randn(2, 4)).square().mean().backward()  # of random numbers, which are saved too
        optimizer.step()
        counters["env_steps"] += 1
        checkpoints.save(counters["env_steps"])
        saved.write_text(str(counters["env_steps"]))
    return began, b"".join(parameter.detach().numpy().tobytes() for parameter in network.parameters())


def train_armed(folder: Path, saved: Path, log: Path, event: int | None, mode: str) -> None:
    """Train where ckpt-chaos watches the folder, and kills at one of its events."""
    torch.set_num_threads(1)
    inject.arm(str(folder), crash_at=event, mode=mode, log_path=str(log), torn_python=True)
    train(folder, saved)


def exit_status(*arguments: object) -> int | None:
    process = SERVER.Process(target=train_armed, args=arguments)
    process.start()
    process.join()
    return process.exitcode


def judge(folder: Path, saved: Path, undisturbed: bytes) -> str:
    """Go on in a folder that a killed training left; say what ckpt-chaos calls what came of it."""
    newest = int(saved.read_text()) if saved.exists() else 0
    with torch.random.fork_rng(devices=[]):
        began, weights = train(folder, saved)
    return invariants.classify(invariants.ResumeOutcome(None, began, newest, float(weights != undisturbed)))


@pytest.mark.slow
@pytest.mark.xdist_group("killed saves")
def test_a_training_killed_at_any_file_of_a_save_goes_on_as_if_it_had_not_been(tmp_path: Path) -> None:
    saved, log = tmp_path / "saved.txt", tmp_path / "events.log"
    with torch.random.fork_rng(devices=[]):
        _, undisturbed = train(tmp_path / "undisturbed", saved)
    folder = tmp_path / "run"
    assert exit_status(folder, saved, log, None, "before") == 0
    lines = [line.split("\t") for line in log.read_text().splitlines()]
    events = [Event(int(number), kind, name, tornable == "1") for number, kind, name, tornable in lines]
    assert {event.kind for event in events} >= {"open", "torch.save", "os.mkdir", "os.rename"}
    # The probe whether a folder can be written opens a file without a name, of which nothing could be left to cut.
    cut = {event.number for event in events if event.tornable and not (folder / event.name).is_dir()}
    points = [(event, mode) for event in events for mode in MODES if mode == "before" or event.number in cut]
    verdicts = {}
    for event, mode in points:
        shutil.rmtree(folder)
        saved.unlink(missing_ok=True)
        assert exit_status(folder, saved, log, event.number, mode) == KILLED
        verdicts[*event[:3], mode] = judge(folder, saved, undisturbed)
    assert {point: verdict for point, verdict in verdicts.items() if verdict != "PASS"} == {}
    assert len(verdicts) > 50
