"""Saving and restoring a run, killed processes and damaged files."""

from __future__ import annotations

import logging
import os
import random
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError

from dreamer_racing.envs.race.curriculum import BodyRateCurriculum, BodyRateSchedule
from dreamer_racing.experience.replay import StreamReplay, make_replay
from dreamer_racing.training import publishing
from dreamer_racing.training.checkpoint import (
    BestCheckpoint,
    RandomState,
    RunCheckpointError,
    RunCheckpoints,
    load_components,
    load_state,
    newest_sound,
)
from dreamer_racing.training.directory import ensure_writable, latest_checkpoint
from dreamer_racing.training.publishing import CHECKSUMS, write_checksums
from tests.forked import SERVER
from tests.robustness.faults import turn


class Run:
    """A run whose whole state tells its number of steps."""

    def __init__(self, run_dir: Path, size: int = 100, keep_last: int = 2):
        self.learner = torch.nn.Linear(size, size)
        self.optimiser = torch.optim.Adam(self.learner.parameters(), lr=0.1)
        self.replay: StreamReplay = make_replay(200, 2, 4, 5)
        self.curriculum = BodyRateCurriculum(BodyRateSchedule(window=1, cooldown=1, maximum=1.0))
        self.counters = {"env_steps": 0, "updates": 0}
        self.checkpoints = RunCheckpoints(run_dir, self.components, keep_last=keep_last)

    @property
    def components(self) -> dict:
        names = ("learner", "optimiser", "replay", "curriculum", "counters")
        return {name: getattr(self, name) for name in names}

    def advance(self) -> None:
        steps = self.counters["env_steps"] = self.counters["env_steps"] + 10
        self.replay.extend(rollout(steps))
        self.optimiser.zero_grad()
        self.learner(torch.randn(1, self.learner.in_features)).mean().backward()
        self.optimiser.step()
        self.learner.bias.data.fill_(steps)
        self.curriculum.update([60.0])

    def save(self) -> Path:
        return self.checkpoints.save(self.counters["env_steps"])

    def assert_consistent(self) -> int:
        """Every part is of the same moment. Returns which."""
        steps = self.counters["env_steps"]
        assert (self.learner.bias == steps).all()
        assert self.replay.write_count == 2 * (5 * steps // 10)
        assert (self.replay.records(1)["pixels"][-1] == steps // 10 % 256).all()
        assert self.curriculum.body_rate_weight == pytest.approx(0.001 * steps / 10)
        assert self.optimiser.state_dict()["state"][0]["step"] == steps / 10
        return steps


def rollout(steps: int) -> TensorDict:
    flag, value = torch.zeros(2, 5, 1, dtype=torch.bool), torch.rand(2, 5, 1)
    pixels = torch.full((2, 5, 8, 8, 3), steps // 10 % 256, dtype=torch.uint8)
    arrived = {"pixels": pixels, "reward": value, "reward_base": value, "body_rate_norm": value}
    root = {"pixels": pixels, "action": torch.rand(2, 5, 4), "is_init": flag}
    return TensorDict({**root, "next": {**arrived, "terminated": flag, "truncated": flag}}, [2, 5])


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    run = Run(tmp_path)
    for _ in range(3):
        run.advance()
        run.save()
    return tmp_path


def test_restored_run_continues_identically(tmp_path):
    run = Run(tmp_path)
    random.seed(1)
    np.random.seed(2)  # noqa: NPY002 -- the global generator is what is restored
    torch.manual_seed(3)
    run.advance()
    run.save()

    def future(run: Run) -> list:
        run.advance()
        draws = [random.random(), np.random.rand(), torch.rand(()).item()]  # noqa: NPY002
        return [*draws, run.learner.weight.detach().clone(), run.replay.sample()["pixels"]]

    expected = future(run)
    other = Run(tmp_path)
    metadata = other.checkpoints.load()
    assert metadata["env_steps"] == other.assert_consistent() == 10
    actual = future(other)
    assert actual[:3] == expected[:3]
    assert all(torch.equal(a, b) for a, b in zip(actual[3:], expected[3:], strict=True))


def test_second_save_at_the_same_step_does_nothing(saved):
    run = Run(saved)
    run.checkpoints.load()
    run.advance()
    path = run.save()
    written = (path / "manifest.json").stat().st_mtime_ns
    assert run.save() == path
    assert (path / "manifest.json").stat().st_mtime_ns == written


def test_resuming_from_an_older_checkpoint_replaces_the_later_ones(saved):
    run = Run(saved)
    run.checkpoints.load(saved / "checkpoints" / "checkpoint-000000000020")
    run.counters["env_steps"] = 15
    run.checkpoints.save(25)
    assert [path.name[-2:] for path in sorted((saved / "checkpoints").iterdir())] == ["20", "25"]
    run.checkpoints.load()
    assert run.counters["env_steps"] == 15
    run.counters["env_steps"] = 16
    run.checkpoints.save(25)  # loaded since: it is saved anew
    run.checkpoints.load()
    assert run.counters["env_steps"] == 16


def test_latest_accepts_a_run_a_folder_and_one_checkpoint(saved):
    newest = saved / "checkpoints" / "checkpoint-000000000030"
    assert latest_checkpoint(saved) == latest_checkpoint(saved / "checkpoints") == latest_checkpoint(newest) == newest


def test_latest_passes_over_incomplete_folders(saved, caplog):
    folder = saved / "checkpoints"
    newest = folder / "checkpoint-000000000030"
    shutil.copytree(newest, folder / ".checkpoint-000000000040.partial")
    copied = folder / "checkpoint-000000000050"
    shutil.copytree(newest, copied)
    next(copied.rglob("state.pt")).unlink()  # a copy that lost a file
    (folder / "checkpoint-000000000060").mkdir()
    with caplog.at_level(logging.WARNING):
        assert latest_checkpoint(saved) == newest
    assert "000060" in caplog.text
    assert "000050" in caplog.text


@pytest.mark.parametrize("make", [lambda path: None, lambda path: path.mkdir(), lambda path: path.touch()])
def test_nothing_to_restore_is_said_with_the_path(tmp_path, make):
    make(tmp_path / "run")
    with pytest.raises(FileNotFoundError, match=str(tmp_path / "run")):
        latest_checkpoint(tmp_path / "run")


def test_some_components_and_what_does_not_fit(saved):
    learner = torch.nn.Linear(100, 100)
    assert load_components(saved, {"learner": learner})["env_steps"] == 30
    assert (learner.bias == 30).all()
    with pytest.raises(CheckpointError, match="checkpoint-000000000030.*learner"):
        load_components(saved, {"learner": torch.nn.Linear(3, 3)})
    with pytest.raises(CheckpointError, match="missing.*actor"):
        load_components(saved, {"actor": torch.nn.Linear(3, 3)})
    with pytest.raises(CheckpointError, match="2 streams of 100 records, this one has 4 of 50"):
        load_components(saved, {"replay": make_replay(200, 4, 4, 5)})


def test_a_part_that_older_checkpoints_lack_is_left_as_it_is(saved):
    run = Run(saved)
    parts = {**run.checkpoints.components, "lag": {"waits": 1}}
    with pytest.raises(CheckpointError, match="missing.*lag"):
        RunCheckpoints(saved, parts).load()
    RunCheckpoints(saved, parts).load(may_lack=("lag",))
    assert run.assert_consistent() == 30
    assert parts["lag"] == {"waits": 1}
    RunCheckpoints(saved, parts).save(40)
    parts["lag"]["waits"] = 0
    RunCheckpoints(saved, parts).load(may_lack=("lag",))
    assert parts["lag"] == {"waits": 1}


@pytest.mark.parametrize("function", ["replace", "rmtree"])
def test_what_cannot_be_removed_does_not_end_a_run_that_is_saved(function, saved, monkeypatch, caplog):
    run = Run(saved)
    run.checkpoints.load(saved / "checkpoints" / "checkpoint-000000000020")
    run.counters["env_steps"] = 25

    def busy(path, *arguments, **options):
        if "checkpoint-000000000030" in str(path):  # which belongs to the future of this run
            raise OSError(16, "Device or resource busy", str(path))
        return original(path, *arguments, **options)

    module = os if function == "replace" else shutil
    original = getattr(module, function)
    monkeypatch.setattr(module, function, busy)
    assert run.save().name.endswith("25")
    assert "could not be removed" in caplog.text and "resource busy" in caplog.text


class Unreadable:
    def state_dict(self) -> dict:
        return {"path": Path("x")}  # loads only with arbitrary code execution allowed

    def load_state_dict(self, state: dict) -> None: ...


def test_a_failed_save_leaves_the_earlier_ones(saved):
    checkpoints = RunCheckpoints(saved, {"counters": {}, "part": Unreadable()})
    with pytest.raises(CheckpointError, match="Earlier checkpoints are untouched"):
        checkpoints.save(40)
    assert [path.name[-2:] for path in sorted((saved / "checkpoints").iterdir())] == ["20", "30"]


def test_random_state_of_absent_devices_is_skipped(caplog):
    state = RandomState().state_dict()
    state["torch_cuda"] = [torch.zeros(16, dtype=torch.uint8)] * 99
    torch.rand(3)
    with caplog.at_level(logging.WARNING):
        RandomState().load_state_dict(state)
    assert "99 CUDA devices" in caplog.text
    assert torch.equal(torch.get_rng_state(), state["torch_cpu"])


@pytest.mark.parametrize("folder", ["file/run", "/proc/nowhere"])
def test_unwritable_folder_is_named(tmp_path, folder):
    (tmp_path / "file").touch()
    folder = tmp_path / folder
    with pytest.raises(PermissionError, match=f"{folder}.*run_dir="):
        ensure_writable(folder)
    with pytest.raises(PermissionError, match="Cannot write"):
        RunCheckpoints(folder, {})
    assert ensure_writable(tmp_path / "new" / "run").is_dir()
    assert not list((tmp_path / "new" / "run").iterdir())


# --- kill -9 ---


def save_forever(run_dir: Path, saved_steps) -> None:
    torch.set_num_threads(1)
    run = Run(run_dir, size=700)
    if saved_steps.value:
        run.checkpoints.load()
    while True:
        run.advance()
        run.save()
        saved_steps.value = run.counters["env_steps"]


def die_inside(run_dir: Path, function: str, call: int) -> None:
    """Restores the run and saves once, killing itself at the given call of a function of the operating system."""
    torch.set_num_threads(1)
    run = Run(run_dir)
    run.checkpoints.load()
    module, name = function.split(".")
    original = getattr({"os": os, "shutil": shutil}[module], name)
    calls = iter(range(1_000_000))

    def fatal(*args, **kwargs):
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*args, **kwargs)

    setattr({"os": os, "shutil": shutil}[module], name, fatal)
    run.advance()
    run.save()


def test_kill_during_a_save_leaves_a_loadable_checkpoint(tmp_path):
    announced = SERVER.Value("q", 0)
    leftovers = 0
    for number in range(48):
        if number >= 6 and leftovers:
            break
        delay = (0.002 + 0.006 * (number % 6)) * 2 ** (number // 6)  # longer where a machine is busy
        process = SERVER.Process(target=save_forever, args=(tmp_path, announced))
        before = announced.value
        process.start()
        deadline = time.monotonic() + 30
        while announced.value == before and process.is_alive() and time.monotonic() < deadline:
            time.sleep(0.001)
        time.sleep(delay)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        leftovers += len(list((tmp_path / "checkpoints").glob(".*")))
        run = Run(tmp_path, size=700)
        assert not list((tmp_path / "checkpoints").glob(".*"))
        run.checkpoints.load()
        assert run.assert_consistent() >= announced.value > before
        announced.value = run.counters["env_steps"]
    assert leftovers > 0, "no kill fell into a save: this test has tested nothing"


@pytest.mark.parametrize(
    ("function", "call"),
    [("os.replace", call) for call in range(3)] + [("os.fsync", 0), ("os.fsync", 5), ("shutil.rmtree", 0)],
)
def test_kill_at_each_step_of_publishing(saved, function, call):
    process = SERVER.Process(target=die_inside, args=(saved, function, call))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert latest_checkpoint(saved)  # also before anything cleans up
    run = Run(saved)
    run.checkpoints.load()
    assert run.assert_consistent() in (30, 40)
    assert not list((saved / "checkpoints").glob(".*"))


def test_a_checkpoint_that_stepped_aside_comes_back(saved):
    newest = saved / "checkpoints" / "checkpoint-000000000030"
    newest.rename(newest.with_name(f".{newest.name}.replaced"))  # killed between the two renames of a replacement
    aside = latest_checkpoint(saved)
    assert aside.name == f".{newest.name}.replaced" and newest_sound(saved) == aside
    assert load_components(saved, {"counters": {}})["env_steps"] == 30
    shutil.copytree(aside, newest)
    assert latest_checkpoint(saved) == newest  # the other one has come
    shutil.rmtree(newest)
    shutil.rmtree(newest.with_name("checkpoint-000000000020"))
    assert latest_checkpoint(saved) == aside  # as with checkpoint.keep=1
    Run(saved)
    assert latest_checkpoint(saved) == newest


# --- damage ---


def files_of(checkpoint: Path) -> list[str]:
    return sorted(str(file.relative_to(checkpoint)) for file in checkpoint.rglob("*") if file.is_file())


def test_every_damaged_or_missing_file_is_noticed_and_the_checkpoint_before_it_is_taken(saved, caplog):
    newest, before = saved / "checkpoints/checkpoint-000000000030", saved / "checkpoints/checkpoint-000000000020"
    names = files_of(newest)
    assert len(names) > 8 and CHECKSUMS in names and any("replay" in name for name in names)
    for name in names:
        whole = (newest / name).read_bytes()
        for damage in (turn, lambda file: file.write_bytes(file.read_bytes()[:-1]), Path.unlink):
            caplog.clear()
            damage(newest / name)
            with caplog.at_level("WARNING"):
                assert newest_sound(saved) == before, name
            assert str(newest) in caplog.text and "is lost" in caplog.text, name
            if damage is not Path.unlink and name != "manifest.json":  # else there is no complete checkpoint
                assert f"{newest} is damaged: {name}" in caplog.text
            (newest / name).write_bytes(whole)
    assert newest_sound(saved) == newest


def test_a_run_goes_on_from_before_a_damaged_checkpoint_and_replaces_it(saved):
    turn(next((saved / "checkpoints/checkpoint-000000000030").rglob("*-learner/*.pt")))
    run = Run(saved)
    assert run.checkpoints.load(saved)["env_steps"] == 20
    run.assert_consistent()
    run.advance()
    run.save()
    assert newest_sound(saved).name == "checkpoint-000000000030"
    assert Run(saved).checkpoints.load()["env_steps"] == 30


def test_a_damaged_checkpoint_asked_for_is_refused_by_name(saved):
    newest = saved / "checkpoints/checkpoint-000000000030"
    turn(next(newest.rglob("*-learner/*.pt")))
    with pytest.raises(
        RunCheckpointError, match=r"30 is damaged: .*-learner/.*\.pt does not match .* checkpoint-000000000020"
    ):
        Run(saved).checkpoints.load(newest)
    assert load_components(newest, {"counters": {}})["env_steps"] == 30  # what is read of it is sound


def test_a_file_that_is_no_state_is_refused_though_its_checksum_is_right(saved):
    newest = saved / "checkpoints/checkpoint-000000000030"
    next(newest.rglob("*-learner/*.pt")).write_bytes(b"not a state" * 100)
    write_checksums(newest)
    with pytest.raises(RunCheckpointError, match="could not be restored") as error:
        Run(saved).checkpoints.load()
    assert "weights_only" not in str(error.value)


@pytest.mark.parametrize("name", ["manifest.json", CHECKSUMS])
@pytest.mark.parametrize("content", ["[]", "3", "{}", "", "[" * 9], ids=repr)
def test_json_of_another_kind_is_damage(saved, name, content, caplog):
    newest, before = saved / "checkpoints/checkpoint-000000000030", saved / "checkpoints/checkpoint-000000000020"
    whole = (newest / name).read_bytes()
    (newest / name).write_text(content)
    with caplog.at_level("WARNING"):
        assert newest_sound(saved) == before
    assert str(newest) in caplog.text and "is lost" in caplog.text
    (newest / name).write_bytes(whole)
    (before / name).write_text(content)  # the older one: neither reading nor saving minds
    run = Run(saved)
    assert run.checkpoints.load()["env_steps"] == 30
    run.advance()
    run.save()
    assert newest_sound(saved).name.endswith("40")


class Payload:
    """What a pickle that runs code looks like."""

    def __init__(self, witness: Path) -> None:
        self._witness = witness

    def __reduce__(self) -> tuple:
        return (os.system, (f"touch {self._witness}",))


def test_a_malicious_state_is_refused_and_nothing_of_it_is_run(saved):
    newest, witness = saved / "checkpoints/checkpoint-000000000030", saved / "witness"
    file = next(newest.rglob("*-learner/*.pt"))
    torch.save({"weight": Payload(witness)}, file)
    write_checksums(newest)  # whoever can write a file can write its sum
    for read in (Run(saved).checkpoints.load, lambda: load_state(newest, "learner")):
        with pytest.raises(RunCheckpointError, match="restored. One of its files does not contain a saved state"):
            read()
    assert not witness.exists()
    torch.load(file, weights_only=False)  # as nothing of ours does
    assert witness.exists(), "the state was harmless: this test has tested nothing"


def test_the_old_best_stays_until_the_new_one_is_there(tmp_path, monkeypatch):
    counters = {"env_steps": 10}
    best = BestCheckpoint(tmp_path, {"counters": counters}, 1000)
    best.offer(1.0, 10)
    counters["env_steps"] = 20

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(publishing, "_sync_tree", full)
    with pytest.raises(RunCheckpointError, match="No space left"):
        best.offer(2.0, 20)
    monkeypatch.undo()
    restored: dict[str, int] = {}
    assert load_components(tmp_path / "best", {"counters": restored})["score"] == 1.0 and restored["env_steps"] == 10
    assert best.score == 1.0 and best.offer(2.0, 20)
    assert BestCheckpoint(tmp_path, {"counters": counters}, 1000).score == 2.0


def test_a_damaged_best_is_replaced_by_the_next_evaluation(tmp_path):
    counters = {"env_steps": 10}
    BestCheckpoint(tmp_path, {"counters": counters}, 1000).offer(5.0, 10)
    turn(next((tmp_path / "best").rglob("value.json")))
    again = BestCheckpoint(tmp_path, {"counters": counters}, 1000)
    assert again.score is None and again.offer(1.0, 20)
    assert BestCheckpoint(tmp_path, {"counters": counters}, 1000).score == 1.0


def test_the_best_is_kept_and_only_the_best(tmp_path):
    counters = {"env_steps": 10}
    best = BestCheckpoint(tmp_path, {"counters": counters}, 1000)
    assert best.score is None
    assert best.offer(1.0, 10)
    counters["env_steps"] = 20
    assert not best.offer(1.0, 20)
    restored: dict[str, int] = {}
    assert load_components(tmp_path / "best", {"counters": restored})["score"] == 1.0
    assert restored == {"env_steps": 10}
    resumed = BestCheckpoint(tmp_path, {"counters": counters}, 1000)
    assert resumed.score == 1.0
    counters["env_steps"] = 5  # resumed from before the best, which is of what is given up, whatever its score
    resumed = BestCheckpoint(tmp_path, {"counters": counters}, 5)
    load_components(tmp_path / "best.replaced", {"counters": restored})
    assert restored == {"env_steps": 10} and resumed.score is None and resumed.offer(0.5, 5)
    load_components(tmp_path / "best", {"counters": restored})
    assert restored == {"env_steps": 5}
    assert len(list((tmp_path / "best").glob("checkpoints/checkpoint-*"))) == 1
