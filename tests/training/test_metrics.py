"""The metrics file, and its resumption."""

from __future__ import annotations

import csv
import threading
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dreamer_racing.figures.loggers import LoggerConfig, make_loggers
from dreamer_racing.training import metrics as metrics_module
from dreamer_racing.training.metrics import Journal, MetricsLog


def read(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def write(log: MetricsLog, rows: dict[int, dict]) -> None:
    for env_steps, values in rows.items():
        log.push(values)
        log.write(env_steps)


def full(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def scalars(place: Path, name: str) -> list[tuple[int, float]]:
    """What TensorBoard shows of a file or folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    return [(event.step, event.value) for event in EventAccumulator(str(place)).Reload().Scalars(name)]


def test_averages_between_writes(tmp_path):
    log = MetricsLog(tmp_path)
    log.push({"loss": torch.tensor(1.0), "norm": torch.tensor([1, 3])})
    log.push({"loss": torch.tensor(2.0), "norm": torch.tensor([5, 7])})
    log.push({"loss": 6.0})
    assert log.write(10) == {"loss": 3.0, "norm": 4.0}
    log.push({"loss": 0.1})
    log.write(20)
    assert log.write(30) == {}
    assert read(tmp_path) == [
        {"env_steps": "10", "loss": "3", "norm": "4"},
        {"env_steps": "20", "loss": "0.1", "norm": ""},
    ]


@pytest.mark.parametrize("cell", ["1O", "", "nan", "-3", "2.5", "9" * 5000, "٣"], ids=range(7))
def test_a_damaged_number_of_env_steps_costs_its_row_alone_and_is_said(tmp_path, caplog, cell):
    write(MetricsLog(tmp_path), {step: {"loss": float(step)} for step in (10, 20, 30)})
    path = tmp_path / "metrics.csv"
    path.write_text(path.read_text(encoding="utf-8").replace("20,20", f"{cell},20"), encoding="utf-8")
    with caplog.at_level("WARNING"):
        MetricsLog(tmp_path, resume_env_steps=30)
    assert f"{path} is damaged: " in caplog.text and "1 of 3 rows are ignored" in caplog.text
    assert [row["env_steps"] for row in read(tmp_path)] == ["10", "30"]


def test_pushed_tensors_may_be_overwritten_and_their_graphs_are_not_kept(tmp_path):
    log = MetricsLog(tmp_path)
    static, weight = torch.tensor(0.0), torch.ones(3, requires_grad=True)  # static, as a CUDA graph's outputs are
    for value in (1.0, 2.0, 3.0):
        log.push({"loss": static.fill_(value), "norm": value * weight.sum()})
    averages = log._pending.averages.state_dict()["tensors"]
    assert averages and not any(total.requires_grad for _, total, _ in averages)
    assert log.write(1) == {"loss": 2.0, "norm": 6.0}


def test_pushing_does_not_read_tensors_and_a_write_reads_once(tmp_path, monkeypatch):
    log, reads = MetricsLog(tmp_path), []
    for name in ("item", "tolist", "cpu", "__float__"):
        original = getattr(torch.Tensor, name)
        monkeypatch.setattr(torch.Tensor, name, lambda self, *a, f=original: (reads.append(f), f(self, *a))[1])
    for step in range(5):
        log.push({"a": torch.tensor(1.0), "b": torch.ones(2)})
        log.push({f"rare/{step}": torch.tensor(1.0)})
    assert reads == []
    log.write(1)
    assert len(reads) == 1


def test_columns_that_appear_later(tmp_path):
    write(MetricsLog(tmp_path), {step: {f"metric/{index}": float(step) for index in range(step)} for step in (1, 2, 3)})
    rows = read(tmp_path)
    assert list(rows[0]) == ["env_steps", "metric/0", "metric/1", "metric/2"]
    assert [row["metric/2"] for row in rows] == ["", "", "3"]
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


def test_resuming_drops_later_rows_and_a_torn_one(tmp_path):
    write(MetricsLog(tmp_path), {step: {"a": float(step), "b": 1.0} for step in (10, 20, 30, 40)})
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write("1,2")  # killed while writing "1234567,2,3"
    log = MetricsLog(tmp_path, resume_env_steps=25)
    assert [row["env_steps"] for row in read(tmp_path)] == ["10", "20"]
    write(log, {35: {"b": 5.0, "c": 6.0}})
    assert read(tmp_path)[-1] == {"env_steps": "35", "a": "", "b": "5", "c": "6"}


def test_a_resumed_log_goes_on_in_the_middle_of_a_row(tmp_path):
    """Averages of tensors and of floats, and the order of columns, with rows of a killed process in the file."""

    def write_some(log: MetricsLog, env_steps: int) -> None:
        for value in (0.1, 0.7, 0.2):
            log.push({"loss": torch.tensor(value * env_steps), "norm": torch.tensor([1.0, value])})
            log.push({f"late/{env_steps // 20}": value, "return": value / 3})
            if env_steps == 20 and value == 0.7:
                torch.save(log._pending.state_dict(), tmp_path / "pending.pt")
        log.write(env_steps)

    log = MetricsLog(tmp_path)
    for env_steps in (10, 20, 40):
        write_some(log, env_steps)
    whole = (tmp_path / "metrics.csv").read_text()
    pending = Journal()
    pending.load_state_dict(torch.load(tmp_path / "pending.pt", weights_only=True))
    assert pending.written == 10
    log = MetricsLog(tmp_path, resume_env_steps=pending.written, pending=pending)
    assert (tmp_path / "metrics.csv").read_text().splitlines()[0] == "env_steps,late/0,return,loss,norm"
    log.push({"loss": torch.tensor(0.2 * 20), "norm": torch.tensor([1.0, 0.2])})
    log.push({"late/1": 0.2, "return": 0.2 / 3})
    log.write(20)
    write_some(log, 40)
    assert (tmp_path / "metrics.csv").read_text() == whole


@pytest.mark.parametrize("new", [{}, {"b": 3.0}], ids=["a row", "a column"])
def test_what_a_full_disk_refuses_waits(new, tmp_path, monkeypatch):
    log = MetricsLog(tmp_path)
    write(log, {10: {"a": 1.0}})
    before = (tmp_path / "metrics.csv").read_bytes()
    monkeypatch.setattr(metrics_module.os, "fsync", full)
    for env_steps in (20, 30):
        with pytest.raises(OSError, match="No space left"):
            write(log, {env_steps: {"a": env_steps / 10} | new})
        assert (tmp_path / "metrics.csv").read_bytes() == before
    monkeypatch.undo()
    pending = Journal()
    pending.load_state_dict(log._pending.state_dict())  # a run that is stopped meanwhile takes them along
    MetricsLog(tmp_path, resume_env_steps=pending.written, pending=pending).flush()
    later = dict.fromkeys(new, "3")
    assert read(tmp_path) == [
        {"env_steps": "10", "a": "1", **dict.fromkeys(new, "")},
        {"env_steps": "20", "a": "2", **later},
        {"env_steps": "30", "a": "3", **later},
    ]


def test_resuming_without_a_file_starts_one(tmp_path):
    MetricsLog(tmp_path, resume_env_steps=25)
    assert (tmp_path / "metrics.csv").read_text().strip() == "env_steps"


def test_a_new_run_keeps_the_old_file(tmp_path):
    for value in (1.0, 2.0, 3.0):
        write(MetricsLog(tmp_path), {1: {"a": value}})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["metrics.1.csv", "metrics.2.csv", "metrics.csv"]
    assert "1,1" in (tmp_path / "metrics.1.csv").read_text()
    assert read(tmp_path)[0]["a"] == "3"


def test_tensorboard_shows_a_resumed_run_once(tmp_path):
    for resume, value, steps in ((None, 1.0, (100, 200, 300)), (200, 2.0, (250, 350))):
        with closing(MetricsLog(tmp_path, make_loggers(tmp_path, LoggerConfig(), resume), resume)) as log:
            write(log, {step: {"loss": value} for step in steps})

    assert scalars(tmp_path / "tensorboard", "loss") == [(100, 1), (200, 1), (250, 2), (350, 2)]


def test_tensorboard_goes_on_after_a_write_that_failed(tmp_path, monkeypatch):
    (sink,) = loggers = make_loggers(tmp_path, LoggerConfig())
    log = MetricsLog(tmp_path, loggers)
    write(log, {10: {"loss": 1.0}})
    monkeypatch.setattr(threading, "excepthook", lambda failure: None)  # of the thread that writes
    monkeypatch.setattr(sink.experiment.file_writer.event_writer._general_file_writer, "write", full)
    with pytest.raises(OSError, match="No space left"):
        write(log, {20: {"loss": 1.0}})
    write(log, {30: {"loss": 1.0}})
    log.close()
    files = sorted((tmp_path / "tensorboard").iterdir(), key=lambda file: int(file.suffix[1:]))  # as they were made
    assert [scalars(file, "loss") for file in files] == [[(10, 1.0)], [(30, 1.0)]]
    assert [row["env_steps"] for row in read(tmp_path)] == ["10", "20", "30"]


def test_a_logger_that_cannot_write_takes_no_row_from_those_after_it(tmp_path):
    got: list[int] = []
    sinks = [SimpleNamespace(experiment=None, log_metrics=log) for log in (full, lambda values, step: got.append(step))]
    log = MetricsLog(tmp_path, sinks)
    for step in (10, 20):
        with pytest.raises(OSError, match="No space left"):
            write(log, {step: {"loss": 1.0}})
    assert got == [10, 20]


def test_tensorboard_and_other_loggers_get_every_row(tmp_path):
    from torchrl.record.loggers.csv import CSVLogger

    other = CSVLogger(exp_name="other", log_dir=str(tmp_path))
    with closing(MetricsLog(tmp_path, [other, *make_loggers(tmp_path, LoggerConfig())])) as log:
        write(log, {step: {"loss/actor": torch.tensor(step / 10)} for step in (10, 20)})
        shown = scalars(tmp_path / "tensorboard", "loss/actor")  # while the run goes on
    assert shown == [(10, 1.0), (20, 2.0)]
    assert "2.0" in (tmp_path / "other" / "scalars" / "loss" / "actor.csv").read_text()


def test_the_mean_of_several_counts_as_many(tmp_path):
    """Episodes that end together, as by their time limit, count as often as those that end alone."""
    log = MetricsLog(tmp_path)
    log.push({"episode/return": 40.0, "loss": torch.tensor(2.0)}, 32)
    for _ in range(10):
        log.push({"episode/return": -4.0, "loss": torch.tensor(9.0)})
    log.push({}, 0)
    assert log.write(1) == pytest.approx({"episode/return": 1240 / 42, "loss": 154 / 42})
