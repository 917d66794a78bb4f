"""A recipe, run as a user runs it: a run leaves what it promises, goes on, and is evaluated."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from dreamer_racing.evaluation.image_corruptions import CORRUPTIONS
from dreamer_racing.training.checkpoint import newest_sound
from dreamer_racing.training.directory import RunDirectory, env_steps_of, latest_checkpoint
from tests.running_recipes import CONFIG, SMALL, UNDRAWN, build, completed, recipe_module, refused, rows

pytestmark = pytest.mark.xdist_group("run")  # one worker makes what these tests share


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished debug run."""
    directory = tmp_path_factory.mktemp("runs") / "first läuf (a=1, b)"
    done = completed("dreamer_v3", *SMALL, "evaluation.stochastic=true", f"run_dir='{directory}'", cwd=directory.parent)
    assert "device: cpu (device=auto)" in done.stdout and "renderer: " in done.stdout and "GB when full" in done.stdout
    return directory


def everything_in(folder: Path) -> dict[str, tuple[int, bytes]]:
    """When each file of a folder was written, and what it holds."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def test_a_run_leaves_what_it_promises(run_dir: Path) -> None:
    table = rows(run_dir)
    assert [int(row["env_steps"]) for row in table] == sorted(int(row["env_steps"]) for row in table)
    last = table[-1]
    assert int(last["env_steps"]) >= 400
    for column in ("episode/return", "episode/gates_passed", "loss_image", "evaluation/gates_per_episode",
                   "time/collect", "rate/env_steps", "curriculum/body_rate_weight"):  # fmt: skip
        assert any(row[column] for row in table), column
    assert list((run_dir / "videos").glob("*.mp4")) and list((run_dir / "plots").glob("*.png"))
    assert list((run_dir / "tensorboard").rglob("events*"))
    assert OmegaConf.load(run_dir / "config.yaml").model.batch_size == 4


def test_resume_continues_where_the_run_stopped(run_dir: Path) -> None:
    before = rows(run_dir)
    done = completed("dreamer_v3", f"resume='{run_dir}'", "total_env_steps=500", cwd=run_dir.parent)
    assert "resumed" in done.stdout
    after = rows(run_dir)
    assert [row["env_steps"] for row in after[: len(before)]] == [row["env_steps"] for row in before]
    assert int(after[-1]["env_steps"]) >= 500
    config = OmegaConf.load(run_dir / "config.yaml")
    assert config.track == "circle" and config.model.size == "debug" and config.total_env_steps == 500


def test_a_kill_behind_the_last_checkpoint_costs_nothing_and_adds_nothing(run_dir: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    shutil.copytree(run_dir, killed)
    (killed / "finished.json").unlink()
    before = (killed / "metrics.csv").read_text()
    completed("dreamer_v3", f"resume={killed}", cwd=tmp_path, before=UNDRAWN)
    assert (killed / "finished.json").exists()
    assert (killed / "metrics.csv").read_text() == before


def test_resuming_a_finished_run_does_nothing_but_say_so(run_dir: Path) -> None:
    before = everything_in(run_dir)
    env_steps = env_steps_of(latest_checkpoint(run_dir))
    done = completed("dreamer_v3", f"resume='{run_dir}'", f"total_env_steps={env_steps}", cwd=run_dir.parent)
    assert f"already complete, at {env_steps:,} env_steps" in done.stdout and "continue:" in done.stdout
    said = dict(line.split(":", 1) for line in done.stdout.splitlines() if ":" in line)
    assert all((run_dir / "videos" / f"{env_steps:09d}{policy}.mp4").exists() for policy in ("", "_stochastic"))
    left = [run_dir.parent / said[what].strip() for what in ("run", "best policy", "film", "plot")]
    assert all(path.exists() for path in left) and left[2].stem == left[3].stem == f"{env_steps:09d}"
    assert everything_in(run_dir) == before


def test_a_finished_run_whose_newest_checkpoint_is_damaged_goes_on(run_dir: Path, tmp_path: Path) -> None:
    copied = shutil.copytree(run_dir, tmp_path / "run")
    newest = latest_checkpoint(copied)
    env_steps = env_steps_of(newest)
    next(newest.rglob("*-learner/*.pt")).write_bytes(b"")
    done = completed("dreamer_v3", "resume=run", f"total_env_steps={env_steps}", cwd=tmp_path, before=UNDRAWN)
    assert "already complete" not in done.stdout and done.stdout.count("is damaged") == 1
    assert newest_sound(copied) == newest and RunDirectory(copied).finished_env_steps() == env_steps


def test_what_flies_and_its_counters_are_of_one_checkpoint(run_dir: Path, tmp_path: Path) -> None:
    """If the newest learner is damaged, the counters beside it do not count."""
    copied = shutil.copytree(run_dir, tmp_path / "run")
    newest = latest_checkpoint(copied)
    next(newest.rglob("*-learner/*.pt")).write_bytes(b"")
    restoring = recipe_module("composing.restoring")
    config = recipe_module("composing.saved").trained_config(copied)
    _, counters = restoring.restore_learner(config, copied, torch.device("cpu"))
    assert counters["env_steps"] == env_steps_of(newest_sound(copied)) < env_steps_of(newest)


def test_a_resumed_run_cannot_change_its_track(run_dir: Path) -> None:
    before = (run_dir / "config.yaml").read_text()
    said = refused("dreamer_v3", f"resume='{run_dir}'", "track=kidney", cwd=run_dir.parent)
    assert "trained with track=circle" in said
    assert (run_dir / "config.yaml").read_text() == before
    training = recipe_module("composing.launching")
    for override, there in (
        ("+decoys=paper", "decoys=null"), ("env.camera_tilt=10", "env.camera_tilt=25"), ("env=dmc", "env.suite=race"),
        ("init_from=kidney", "init_from=null"), ("env.control_rate=25", "env.control_rate=50.0"),
        ("env.preset=faithful", "env.preset=easy"), ("env=betaflight", "env.preset=easy"),
        ("tuned=race", "env.control_rate=50.0"),
    ):  # fmt: skip
        with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
            config, _, known = training.resumed_config("dreamer_v3", str(run_dir), [override])
        with pytest.raises(ValueError, match=f"trained with {there}.*, which cannot change"):
            training.keep_trained_on(config, known, [override])
    with pytest.raises(ValueError, match="was trained by dreamer_v3: continue it with recipes/dreamer_v3.py."):
        training.resumed_config("latent_ppo", str(run_dir), [])
    same = ["track=circle", "env.control_rate=50", "seed=1"]
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        config, overrides, known = training.resumed_config("dreamer_v3", str(run_dir), same)
    training.keep_trained_on(config, known, same)
    assert config.env.control_rate == 50
    names = [override.partition("=")[0] for override in overrides]
    assert len(names) == len(set(names)), "an override stands twice"


def test_evaluations_stand_where_they_were_measured(run_dir: Path) -> None:
    table = {int(row["env_steps"]): row for row in rows(run_dir) if row["evaluation/return_mean"]}
    files = {int(path.stem): path for path in (run_dir / "evaluations").glob("*[0-9].json")}
    assert table.keys() == files.keys()
    for env_steps, path in files.items():
        assert float(table[env_steps]["evaluation/return_mean"]) == pytest.approx(
            json.loads(path.read_text())["return_mean"], rel=1e-5
        )


def test_evaluate_reports_both_policies(run_dir: Path) -> None:
    options = ("episodes=3", "num_envs=2", "start_noise=1")
    done = completed("evaluate", f"checkpoint='{run_dir}'", *options, cwd=run_dir.parent)
    report = json.loads((run_dir / "evaluation" / "evaluation.json").read_text())
    assert report["provenance"]["start_noise"] == 1.0
    returns = {episode["reward_sum"] for episode in report["deterministic"]["episodes"]}
    assert len(returns) == 3, "every episode begins elsewhere"
    for policy in ("deterministic", "stochastic"):
        assert policy in done.stdout
        assert len(report[policy]["episodes"]) == 3
        for key in ("success_rate", "gates_per_episode", "lap_time_best", "lap_time_mean", "speed_max",
                    "gate_offset_mean", "crashes", "crashes_by_gate", "action_change_mean"):  # fmt: skip
            assert key in report[policy]
        assert (run_dir / "evaluation" / "videos" / f"{policy}.mp4").stat().st_size > 0


KILLED_BEHIND_THE_FIRST_POLICY = """
import os, signal
from dreamer_racing.figures.report import EvaluationReport
write = EvaluationReport.write
EvaluationReport.write = lambda *given: (write(*given), os.kill(os.getpid(), signal.{signal}))
"""


def test_an_evaluation_that_was_killed_is_not_mixed_into_the_next(run_dir: Path, tmp_path: Path) -> None:
    options = [f"checkpoint='{run_dir}'", "episodes=1", "num_envs=1", "video_steps=5", "run_dir=evaluation"]
    for name, status in (("SIGINT", 130), ("SIGKILL", -9)):
        before = UNDRAWN + KILLED_BEHIND_THE_FIRST_POLICY.format(signal=name)
        said = refused("evaluate", *options, status=status, cwd=tmp_path, before=before)
        assert ("interrupted" in said) == (name == "SIGINT")
    left = {folder.name for folder in tmp_path.iterdir()}
    assert left == {"evaluation", "evaluation_2"} and not list(tmp_path.rglob("evaluation.json"))
    before = everything_in(tmp_path)
    assert "writing to evaluation_3" in completed("evaluate", *options, cwd=tmp_path, before=UNDRAWN).stdout
    assert (tmp_path / "evaluation_3" / "evaluation.json").exists()
    assert {path: file for path, file in everything_in(tmp_path).items() if "evaluation_3" not in path} == before


FULL = """
import resource, signal
from dreamer_racing.figures.report import EvaluationReport
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
write = EvaluationReport.write
def full(*given):
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.RLIM_INFINITY))
    write(*given)
EvaluationReport.write = full
"""


def test_an_evaluation_on_a_full_disk_ends_in_a_line(run_dir: Path, tmp_path: Path) -> None:
    options = [f"checkpoint='{run_dir}'", "episodes=1", "num_envs=1", "video_steps=5", "run_dir=evaluation"]
    said = refused("evaluate", *options, status=1, cwd=tmp_path, before=FULL)
    assert "error: [Errno 27] File too large" in said and "are incomplete" in said


@pytest.mark.slow
def test_the_full_protocol(run_dir: Path, tmp_path: Path) -> None:
    options = ("protocol=full", "episodes=2", "num_envs=2", "video_steps=20", "run_dir=full")
    done = completed("evaluate", f"checkpoint='{run_dir}'", *options, cwd=tmp_path)
    assert "asks for 100 episodes" in done.stdout
    report = json.loads((tmp_path / "full" / "evaluation.json").read_text())
    assert all(len(report[policy]["episodes"]) == 2 for policy in ("deterministic", "stochastic"))
    assert len(report["conditions"]) == 4 * 2 * 2
    origin = report["provenance"]
    assert (
        origin["command"].endswith("run_dir=full") and origin["env_steps"] >= 400 and origin["wall_clock_seconds"] > 0
    )
    assert (origin["algorithm"], origin["track"], origin["episodes"]) == ("dreamer_v3", "circle", 2)
    table = (tmp_path / "full" / "evaluation.md").read_text()
    assert table.count("| faithful | ") == 8
    for plot in ("conditions", "crashes_easy", "crashes_faithful", "easy_nominal_deterministic"):
        assert (tmp_path / "full" / "plots" / f"{plot}.png").exists()
    assert len(list((tmp_path / "full" / "videos").glob("*.mp4"))) == 4


@pytest.mark.slow
def test_the_perception_report(run_dir: Path, tmp_path: Path) -> None:
    options = ["episodes=1", "num_envs=1", "run_dir=seen"]
    completed("perception", f"checkpoint='{run_dir}'", "track=figure8", *options, cwd=tmp_path)
    report = json.loads((tmp_path / "seen" / "perception.json").read_text())
    assert set(report["flights"]) == {"without decoys", "with decoys"}
    for flights in report["flights"].values():
        assert {"next gate", "nearest visible gate", "gate 1", "decoy 1", "decoy 2"} <= set(flights["sights"])
    corrupted = [(record["start_noise"], record["images"], record["policy"]) for record in report["image_corruptions"]]
    modes = ("deterministic", "stochastic")
    assert corrupted == [(noise, name, mode) for noise in (0.0, 1.0) for name in CORRUPTIONS for mode in modes]
    assert (tmp_path / "seen" / "perception.png").exists() and (tmp_path / "seen" / "perception.md").exists()
    said = refused("perception", f"checkpoint='{run_dir}'", "+decoys=paper", *options, cwd=tmp_path)
    assert "decoys=paper is for track=figure8" in said


def test_checkpoint_of_another_size_is_refused(run_dir: Path) -> None:
    size = ("model=cpu_small", "total_env_steps=9000")
    said = refused("dreamer_v3", f"resume='{run_dir}'", *size, cwd=run_dir.parent)
    assert "debug" in said and "cpu_small" in said


def test_a_new_run_needs_its_own_directory(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted((run_dir / "checkpoints").iterdir())
    with pytest.raises(SystemExit):
        build(f"run_dir='{run_dir}'")
    message = capsys.readouterr().err
    assert "holds a run already" in message and f"resume={run_dir}" in message and before[-1].name in message
    assert sorted((run_dir / "checkpoints").iterdir()) == before


def test_a_run_goes_on_with_its_settings_whatever_today_s_are(run_dir: Path, tmp_path: Path) -> None:
    """As after an update: what is saved is none of today's defaults, and what is not saved did not exist."""
    copied = shutil.copytree(run_dir, tmp_path / "run")
    saved = OmegaConf.load(copied / "config.yaml")
    saved.model.replay_ratio, saved.loss.discount, saved.env.num_envs = 3.0, 0.9, 2
    saved.device = saved.env.device = "cuda"
    del saved.model.average_rate
    OmegaConf.save(saved, copied / "config.yaml")
    resumed = recipe_module("composing.launching").resumed_config

    def composed(*overrides: str) -> DictConfig:
        with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
            return resumed("dreamer_v3", str(copied), list(overrides))[0]

    config = composed()
    assert (config.model.replay_ratio, config.loss.discount, config.env.num_envs) == (3.0, 0.9, 2)
    assert (config.tuned, config.model.average_rate, config.device) == ("none", None, "auto")
    assert config.env.device == "cuda", "the state of its worlds is that of worlds there"
    assert composed("env.device=cpu").env.device == "cpu"
    config = composed("model.replay_ratio=5", "loss=decoder_free", "schedule.discount.to=0.99")
    assert (config.model.replay_ratio, config.loss.discount, config.env.num_envs) == (5.0, 0.997, 2)
    assert config.loss.world_model == "decoder_free" and config.schedule.discount.to == 0.99
    assert composed("tuned=race", "env.control_rate=50").loss.world_model == "privileged"


def test_a_kill_while_a_run_is_continued_leaves_its_configuration_whole(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = RunDirectory(shutil.copytree(run_dir, tmp_path / "run"))
    places = (copied.config, copied.best.config, copied.overrides)
    before, left = {place: place.read_text() for place in places}, [0]
    saved = recipe_module("composing.launching").saved_config(copied.path)
    saved.seed = 7
    config = OmegaConf.to_object(saved)
    write, sync = recipe_module("composing.launching").write_configuration, os.fsync

    def killed(descriptor: int) -> None:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        sync(descriptor)

    for written in range(len(places)):
        left[0] = written
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", killed)
            with pytest.raises(KeyboardInterrupt):
                write(copied, config, ["seed=7"], 800)
        for index, place in enumerate(places):
            assert (place.read_text() == before[place]) == (index >= written), place


def test_an_incomplete_run_is_not_resumed(run_dir: Path, tmp_path: Path) -> None:
    resumed = recipe_module("composing.launching").resumed_config
    with pytest.raises(ValueError, match=r"networks of a run's best evaluation: set resume=.*first läuf .*b\)\."):
        resumed("dreamer_v3", str(run_dir / "best"), [])
    with pytest.raises(ValueError, match=r"run_dir=elsewhere: a resumed run stays in its own directory, .*first läuf"):
        resumed("dreamer_v3", str(run_dir), ["run_dir=elsewhere"])
    best = shutil.copytree(run_dir, tmp_path / "best")  # a run may have any name
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        assert resumed("dreamer_v3", str(best), [])[0].track == "circle"
    copied = shutil.copytree(run_dir, tmp_path / "run")
    whole = (copied / "config.yaml").read_text()
    for damage in (
        whole[: len(whole) // 3] + "]: {",
        "a: !!python/object:os.system x",
        "- 1",
        "\x00",
        "env: 3",
        "",
        "garbage",
    ):
        (copied / "config.yaml").write_text(damage)
        with pytest.raises(ValueError, match=r"config\.yaml( is damaged| cannot be read|: algorithm=None)") as refusal:
            resumed("dreamer_v3", str(copied), [])
        assert "\n" not in str(refusal.value)
    (copied / "config.yaml").write_text("algorithm: [1]")
    with pytest.raises(ValueError, match=r"config\.yaml: algorithm=\[1\]: must be one of dreamer_v3"):
        recipe_module("composing.saved").trained_config(copied)
    (copied / "config.yaml").write_text(whole)
    (copied / "overrides.yaml").unlink()
    with pytest.raises(ValueError, match=r"run cannot be continued: it lacks overrides.yaml"):
        resumed("dreamer_v3", str(copied), [])


def test_a_resumed_run_says_what_is_other_than_it_was(run_dir: Path) -> None:
    training = recipe_module("composing.launching")
    config = training.saved_config(run_dir)
    config.run_dir = str(run_dir)
    assert training.changed_settings(config) == []
    config.loss.discount, config.model.average_rate = 0.9, 0.5  # by an override, or by another version's defaults
    config.schedule.max_std.by = "known"
    assert training.changed_settings(config) == [
        "model.average_rate=0.5 (was null)", "loss.discount=0.9 (was 0.997)", "schedule.max_std.by=known (was run)",
    ]  # fmt: skip
