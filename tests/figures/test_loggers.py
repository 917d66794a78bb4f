"""Loggers beside metrics.csv: what they are given arrives, a resumed run is the same run, and nothing goes online."""

from __future__ import annotations

import importlib.util
import io
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from torchrl.record.loggers.csv import CSVLogger

from dreamer_racing.figures.film import write_video
from dreamer_racing.figures.loggers import LoggerConfig, Wandb, make_loggers, read_film
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.metrics import MetricsLog

OFFLINE = LoggerConfig(tensorboard=False, wandb=Wandb.offline)
SETTINGS = {"seed": 3, "track": "circle", "env.decoys": None, "curriculum.relabel": True, "model.size": "cpu_small"}


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run with what an evaluation at 2000 env_steps leaves, and one before it."""
    directory = RunDirectory(tmp_path / "a_run")
    directory.plots.mkdir(parents=True)
    for name in ("000001000", "000002000", "000002000_stochastic"):
        Image.new("RGB", (8, 6), (255, 0, 0)).save(directory.plots / f"{name}.png")
    frames = np.zeros((250, 16, 400, 3), np.uint8)
    frames[:, :, :, 1] = np.arange(250)[:, None, None]
    write_video(directory.videos / "000002000.mp4", frames, fps=25)
    return directory.path


def events_of(run_dir: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    return events


def test_tensorboard_shows_configuration_plots_and_films(run_dir, tmp_path):
    (sink,) = make_loggers(run_dir, LoggerConfig())
    sink.log_configuration(SETTINGS, "seed: 3\ntrack: circle\n")
    other = CSVLogger(exp_name="other", log_dir=str(tmp_path))  # which need not know of films
    with closing(MetricsLog(run_dir, [sink, other])) as log:
        log.log_evaluation(2000)
        log.push({"evaluation/return_mean": 1.0})
        log.write(2000)
    events = events_of(run_dir)
    assert set(events.Tags()["images"]) == {"evaluation/plot", "evaluation_stochastic/plot", "evaluation/film"}
    (plot,), (film,) = (events.Images(f"evaluation/{name}") for name in ("plot", "film"))
    assert plot.step == film.step == 2000
    assert plot.encoded_image_string == (RunDirectory(run_dir).plots / "000002000.png").read_bytes()
    with Image.open(io.BytesIO(film.encoded_image_string)) as gif:
        assert gif.format == "GIF" and gif.width == 200
        seconds = sum(gif.seek(frame) or gif.info["duration"] for frame in range(gif.n_frames)) / 1000
    assert seconds == pytest.approx(250 / 25, rel=0.05)  # equal frames are stored once
    text = events.Tensors("configuration/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "track: circle" in text
    assert not list((run_dir / "videos").glob(".*"))


def test_tensorboard_compares_hyperparameters_of_one_run_a_run(run_dir):
    from tensorboard.plugins.hparams import plugin_data_pb2

    for resumed in (None, 100):
        (sink,) = make_loggers(run_dir, LoggerConfig(), resumed)
        sink.log_configuration(SETTINGS, "")
        sink.experiment.close()
    content = events_of(run_dir).SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    known = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info.hparams
    assert known["seed"].number_value == 3 and known["curriculum.relabel"].string_value == "true"
    assert known["env.decoys"].string_value == "null" and set(known) == set(SETTINGS)
    assert [path for path in (run_dir / "tensorboard").iterdir() if path.is_dir()] == []  # no run of its own


def test_a_film_keeps_its_speed(run_dir):
    frames, fps = read_film(run_dir / "videos" / "000002000.mp4", max_frames=100, max_width=320)
    assert frames.shape == (84, 8, 200, 3)
    assert len(frames) / fps == pytest.approx(250 / 25, rel=0.02)
    whole, fps = read_film(run_dir / "videos" / "000002000.mp4", max_frames=250, max_width=400)
    assert whole.shape == (250, 16, 400, 3) and fps == 25


def test_a_missing_wandb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs the package wandb: .*pip install .*\[wandb\]'"):
        make_loggers(tmp_path, OFFLINE)
    assert make_loggers(tmp_path, LoggerConfig(tensorboard=False)) == []


def test_wandb_offline_keeps_all_and_a_resumed_run_is_the_same_run(run_dir, monkeypatch):
    pytest.importorskip("wandb", reason="pip install 'dreamer_racing[wandb]'")
    monkeypatch.setenv("WANDB_MODE", "online")  # what the configuration says counts; restored after the test
    for resumed in (None, 1000):
        (sink,) = make_loggers(run_dir, OFFLINE, resumed)
        assert sink.experiment.settings.mode in ("offline", "dryrun") and sink.experiment.offline
        sink.log_configuration(SETTINGS, "")
        with closing(MetricsLog(run_dir, [sink], resumed)) as log:
            log.push({"loss": 1.5})
            log.write((resumed or 0) + 1000)
            if resumed:
                log.log_evaluation(2000)
    name = json.loads(RunDirectory(run_dir).wandb_run.read_text())["id"]
    assert sink.experiment.id == name and sink.experiment.config["track"] == "circle"
    kept = sorted((run_dir / "wandb").glob(f"offline-run-*-{name}"))
    assert len(kept) in (1, 2) and all(list(place.glob("*.wandb")) for place in kept)  # 1: both in one second
    media = [file.suffix for file in (run_dir / "wandb").rglob("files/media/**/*") if file.is_file()]
    assert sorted(media) == [".mp4", ".png", ".png"]
    (other,) = make_loggers(run_dir, OFFLINE)  # a new run in the same place
    assert other.experiment.id != name
    other.experiment.finish()
