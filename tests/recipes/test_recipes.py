"""The recipes, run as a user runs them: every configuration composes, a run leaves what it promises and goes on."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.transforms import Transform

from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.evaluation.lesions import LESIONS
from dreamer_racing.modules import Interface
from dreamer_racing.training.directory import latest_checkpoint
from dreamer_racing.training.pass_share import PassShare
from dreamer_racing.training.schedule import Clock
from tests.running_recipes import CONFIG, ROOT, compose, recipe, recipe_module, rows

SMALL = [
    "track=circle", "model=debug", "env.num_envs=4", "prefill=400", "total_env_steps=800", "replay.capacity=4000",
    "evaluation.every=400", "evaluation.episodes=2", "evaluation.video_steps=60", "checkpoint.every=400",
    "logger.every=200",
]  # fmt: skip


TINY = [
    "track=circle", "model=debug", "model.batch_size=2", "env.num_envs=4", "env.episode_steps=40", "prefill=100",
    "total_env_steps=200", "replay.capacity=1000", "replay.held_out=1", "evaluation.every=0", "evaluation.episodes=1",
    "evaluation.video_steps=20", "checkpoint.every=0", "logger=csv", "logger.every=100", "device=cpu",
]  # fmt: skip


AT_THE_END = "evaluation.every=1000000"


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished debug run."""
    directory = tmp_path_factory.mktemp("runs") / "first run"
    done = recipe("dreamer_v3", *SMALL, f"run_dir='{directory}'", cwd=directory.parent)
    assert done.returncode == 0, done.stderr
    assert "device: cpu (device=auto)" in done.stdout and "renderer: " in done.stdout and "GB when full" in done.stdout
    return directory


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*/*.yaml")), ids=lambda path: f"{path.parent.name}={path.stem}")
def test_every_group_composes(path: Path) -> None:
    group = path.parent.name
    append = "+" if group == "decoys" else ""  # not among the defaults
    config = compose({"network": "ppo"}.get(group, "dreamer_v3"), f"{append}{group}={path.stem}")
    assert OmegaConf.select(config, group) is not None


def test_every_model_config_names_a_known_size() -> None:
    from dreamer_racing.modules import SIZES

    named = {path.stem: OmegaConf.load(path)["size"] for path in (CONFIG / "model").glob("*.yaml")}
    assert named.pop("auto") == "auto"
    assert named.keys() == set(SIZES) and all(name == size for name, size in named.items())


@pytest.mark.parametrize("name", recipe_module("composing.schema").RECIPES)
def test_every_algorithm_has_its_recipe_its_files_and_its_learner(name: str) -> None:
    schema, recipe = recipe_module("composing.schema"), recipe_module(name)
    config = OmegaConf.to_object(recipe.resolve(compose(name, "budget=smoke", "device=cpu", "env.from_pixels=false")))
    assert type(config) is schema.RECIPES[name] and callable(recipe.build)
    if isinstance(config, schema.ReplayRunConfig):
        ratio = config.replay_ratio
        assert OmegaConf.select(OmegaConf.structured(config), ratio.setting) == ratio.ratio
        assert ratio.updates(config.total_env_steps) > 0
    interface = Interface(pixels=False, vector_dim=21)
    learner = recipe_module("composing.learners").make_learner(config, interface, "cpu")
    assert (learner.updates, learner.device) == (0, torch.device("cpu"))
    for policy in (learner.policy(), learner.evaluation_policy()):
        assert policy.deterministic is False and isinstance(policy.make_primer(), Transform)
    learner.check_finite()
    learner.load_state_dict(learner.state_dict())


def test_an_algorithm_without_a_learner_is_a_defect_that_says_so() -> None:
    config = recipe_module("composing.schema").RunConfig()
    with pytest.raises(NotImplementedError, match=r"make_learner\(\) knows no learner of a RunConfig"):
        recipe_module("composing.learners").make_learner(config, Interface(), "cpu")


def test_a_run_leaves_what_it_promises(run_dir: Path) -> None:
    table = rows(run_dir)
    assert [int(row["env_steps"]) for row in table] == sorted(int(row["env_steps"]) for row in table)
    last = table[-1]
    assert int(last["env_steps"]) >= 800
    for column in ("episode/return", "episode/gates_passed", "loss_image", "evaluation/gates_per_episode",
                   "time/collect", "rate/env_steps", "curriculum/body_rate_weight"):  # fmt: skip
        assert any(row[column] for row in table), column
    assert list((run_dir / "videos").glob("*.mp4")) and list((run_dir / "plots").glob("*.png"))
    assert list((run_dir / "tensorboard").rglob("events*"))
    assert OmegaConf.load(run_dir / "config.yaml").model.batch_size == 4


def test_resume_continues_where_the_run_stopped(run_dir: Path) -> None:
    before = rows(run_dir)
    done = recipe("dreamer_v3", f"resume='{run_dir}'", "total_env_steps=1000", cwd=run_dir.parent)
    assert done.returncode == 0, done.stderr
    assert "resumed" in done.stdout
    after = rows(run_dir)
    assert [row["env_steps"] for row in after[: len(before)]] == [row["env_steps"] for row in before]
    assert int(after[-1]["env_steps"]) >= 1000
    config = OmegaConf.load(run_dir / "config.yaml")
    assert config.track == "circle" and config.model.size == "debug" and config.total_env_steps == 1000


def test_a_resumed_run_cannot_change_its_track(run_dir: Path) -> None:
    before = (run_dir / "config.yaml").read_text()
    done = recipe("dreamer_v3", f"resume='{run_dir}'", "track=kidney", cwd=run_dir.parent)
    assert done.returncode == 2 and "trained with track=circle" in done.stderr and "Traceback" not in done.stderr
    assert (run_dir / "config.yaml").read_text() == before
    training = recipe_module("composing.launching")
    with pytest.raises(ValueError, match="trained with decoys=None"):
        training.resumed_config("dreamer_v3", str(run_dir), ["+decoys=paper"])
    recipe_module("composing.schema").register()
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        _, overrides = training.resumed_config("dreamer_v3", str(run_dir), ["track=circle", "seed=1"])
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
    done = recipe("evaluate", f"checkpoint='{run_dir}'", *options, cwd=run_dir.parent)
    assert done.returncode == 0, done.stderr
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


def test_an_earlier_evaluation_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fresh = recipe_module("composing.restoring").fresh_directory
    assert fresh(tmp_path / "evaluation", "evaluation.json").name == "evaluation"
    assert capsys.readouterr().out == ""
    for number in (1, 2):
        holding = tmp_path / ("evaluation" if number == 1 else f"evaluation_{number}")
        (holding / "evaluation.json").write_text("{}")
        assert fresh(tmp_path / "evaluation", "evaluation.json").name == f"evaluation_{number + 1}"
        assert f"evaluation_{number + 1}" in capsys.readouterr().out


def test_decoys_are_a_config_group() -> None:
    arena, dreamer = recipe_module("composing.arena"), recipe_module("dreamer_v3")
    config = OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", "track=figure8", "+decoys=paper")))
    assert arena.worlds_of(config)["track"] == load_track("figure8_decoys")
    config.track = "circle"
    with pytest.raises(ValueError, match=r"decoys=paper is for track=figure8; track 'circle'"):
        arena.worlds_of(config)
    assert OmegaConf.to_object(compose("evaluate", "checkpoint=x", "+decoys=none")).decoys == "none"


@pytest.mark.slow
def test_the_full_protocol(run_dir: Path, tmp_path: Path) -> None:
    done = recipe("evaluate", f"checkpoint='{run_dir}'", "protocol=full", "episodes=2", "num_envs=2", "video_steps=20",
                  "run_dir=full", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "asks for 100 episodes" in done.stdout
    report = json.loads((tmp_path / "full" / "evaluation.json").read_text())
    assert all(len(report[policy]["episodes"]) == 2 for policy in ("deterministic", "stochastic"))
    assert len(report["conditions"]) == 4 * 2 * 2
    origin = report["provenance"]
    assert (
        origin["command"].endswith("run_dir=full") and origin["env_steps"] >= 800 and origin["wall_clock_seconds"] > 0
    )
    assert (origin["algorithm"], origin["track"], origin["episodes"]) == ("dreamer_v3", "circle", 2)
    table = (tmp_path / "full" / "evaluation.md").read_text()
    assert table.count("| faithful | ") == 8
    for plot in ("conditions", "crashes_easy", "crashes_faithful", "easy_nominal_deterministic"):
        assert (tmp_path / "full" / "plots" / f"{plot}.png").exists()
    assert len(list((tmp_path / "full" / "videos").glob("*.mp4"))) == 4


@pytest.mark.slow
def test_the_perception_report(run_dir: Path, tmp_path: Path) -> None:
    options = ["episodes=2", "num_envs=2", "run_dir=seen"]
    done = recipe("perception", f"checkpoint='{run_dir}'", "track=figure8", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "seen" / "perception.json").read_text())
    assert set(report["flights"]) == {"without decoys", "with decoys"}
    for flights in report["flights"].values():
        assert {"next gate", "nearest visible gate", "decoy 1", "decoy 2"} <= set(flights["sights"])
    lesions = [(record["start_noise"], record["images"], record["policy"]) for record in report["lesions"]]
    modes = ("deterministic", "stochastic")
    assert lesions == [(noise, name, mode) for noise in (0.0, 1.0) for name in LESIONS for mode in modes]
    assert (tmp_path / "seen" / "perception.png").exists() and (tmp_path / "seen" / "perception.md").exists()
    refused = recipe("perception", f"checkpoint='{run_dir}'", "+decoys=paper", *options, cwd=tmp_path)
    assert refused.returncode == 2 and "Traceback" not in refused.stderr
    assert "decoys=paper is for track=figure8" in refused.stderr


def test_an_unknown_protocol_is_refused() -> None:
    config = OmegaConf.to_object(compose("evaluate", "checkpoint=nowhere", "protocol=quick"))
    with pytest.raises(ValueError, match="protocol=quick: there are nominal, full"):
        recipe_module("evaluate").check(config)
    config = OmegaConf.to_object(compose("evaluate", "checkpoint=nowhere", "protocol=full", "start_noise=1"))
    with pytest.raises(ValueError, match="start_noise=1.0 is for protocol=nominal"):
        recipe_module("evaluate").check(config)


def test_checkpoint_of_another_size_is_refused(run_dir: Path) -> None:
    done = recipe("dreamer_v3", f"resume='{run_dir}'", "model=cpu_small", cwd=run_dir.parent)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "debug" in done.stderr and "cpu_small" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_exits_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "recipes" / "dreamer_v3.py"), *SMALL, "total_env_steps=1000000",
               "evaluation.every=0", "checkpoint.every=1000000", "run_dir=run"]  # fmt: skip
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as process:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            if (tmp_path / "run" / "metrics.csv").exists() and rows(tmp_path / "run"):
                break
            time.sleep(0.2)
        process.send_signal(number)
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number, output
    assert number.name in output and "of 1,000,000 env_steps" in output
    assert list((tmp_path / "run" / "checkpoints").glob("checkpoint-*"))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["total_env_steps=abc"], ["total_env_steps", "abc"]),
        (["track=monza"], ["monza", "kidney"]),
        (["run_dir=/dev/null/run"], ["/dev/null/run"]),
        (["env.preset=hard"], ["hard", "easy", "faithful"]),
        (["env.renderer=directx"], ["directx", "egl"]),
        (["device=cuda:7"], ["cuda:7", "cpu"]),
        (["env.device=gpu"], ["env.device=gpu", "cpu", "cuda"]),
        (["env.device=cuda:7"], ["cuda:7", "finds no CUDA device", "cpu"]),
        (["env.device=cuda", "collection=overlapped"], ["overlapped", "env.device=cpu"]),
        (["env.looks=pretty"], ["pretty", "nominal", "randomised"]),
        (["env.looks=randomised", "env.from_pixels=false"], ["env.looks=randomised", "nominal"]),
        (["loss.actor=magic"], ["magic", "reinforce"]),
        (["resume=/nowhere"], ["/nowhere"]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_bad_input_gets_a_plain_error(overrides: list[str], words: list[str], tmp_path: Path) -> None:
    done = recipe("dreamer_v3", "model=debug", *overrides, cwd=tmp_path)
    assert done.returncode != 0
    assert "Traceback" not in done.stderr
    assert all(word in done.stderr for word in words), done.stderr
    assert len(done.stderr.strip().splitlines()) <= 6


def build(*overrides: str) -> None:
    """Resolve and build a run as `recipes/dreamer_v3.py` does, in this process."""
    dreamer, command_line = recipe_module("dreamer_v3"), recipe_module("composing.command_line")
    with command_line.plain_errors():
        config = dreamer.resolve(compose("dreamer_v3", "model=debug", "env.from_pixels=false", *overrides))
        dreamer.build(OmegaConf.to_object(config), list(overrides)).close()


REFUSED = [
    (["model.replay_ratio=0"], ["model.replay_ratio=0", "above 0"]),
    (["prefill=100", "env.num_envs=8"], ["prefill=100", "12 records", "batch_length=16", "at least 128"]),
    (["prefill=4000", "total_env_steps=4000"], ["total_env_steps=4000", "above prefill=4000"]),
    (["env.num_envs=0"], ["env.num_envs=0", "at least 1"]),
    (["model.batch_length=1"], ["model.batch_length=1", "at least 2"]),
    (["model.learning_rate=-1"], ["model.learning_rate=-1", "above 0"]),
    (["env.image_size=40"], ["env.image_size=40", "multiple of 16", "32, 64 or 96"]),
    (["loss.discount=1.5"], ["loss.discount=1.5", "at least 0 and at most 1"]),
    (["checkpoint.keep=0"], ["checkpoint.keep=0", "at least 1"]),
    (["loss.world_model=nowhere:Loss"], ["nowhere:Loss", "cannot be imported"]),
    (["prefill=512", "total_env_steps=527"], ["total_env_steps=527", "64 records"]),  # 15 × 4 are less than 4 × 16
    (["replay.capacity=100000000000"], ["replay.capacity=100,000,000,000", " GB when full", "left", "memmap"]),
    (["replay.capacity=100"], ["capacity=100", "batch_length=16", "at least 512"]),
    (["replay.held_out=32"], ["held_out=32", "num_envs=32"]),
    (["replay.recent_share=1.5"], ["recent_share=1.5", "at least 0 and at most 1"]),
    (["env.suite=atari"], ["env.suite=atari", "race", "dmc"]),
    (["env=dmc", "env.from_pixels=false", "loss=privileged"], ["loss.world_model=privileged", "reconstruction"]),
    (["env=dmc", "task=walker_fly"], ["walker_fly", "walker_walk"]),
    (["device=quantum"], ["device=quantum", "cpu"]),
    (["env.control_rate=5"], ["env.control_rate=5", "at least 10"]),
    (["env.control_rate=60"], ["env.control_rate=60", "whole number of physics steps of 2 ms"]),
    (["env.start_on_line=1.5"], ["env.start_on_line=1.5", "at least 0 and at most 1"]),
    (["schedule.discount.begin=0.6", "schedule.discount.end=0.5"], ["schedule.discount: begin=0.6 and end=0.5"]),
    (["schedule.learning_rates.to=0"], ["schedule.learning_rates.to=0.0: must be above 0"]),
    (["schedule.noise_correlation.to=1"], ["schedule.noise_correlation.to=1.0: must be at least 0 and at most 0.99"]),
    (["schedule.start_on_line.to=0.3"], ["schedule.start_on_line begins at env.start_on_line=0"]),
    (["model.imagine_recent=true"], ["model.imagine_recent=true, and replay.recent_share=0 draws none"]),
    (
        ["model.imagine_recent=true", "replay.recent_share=0.5", "model.imagination_starts=null"],
        ["model.imagination_starts=null begins from all"],
    ),
    (["loss.ppo.updates=0"], ["loss.ppo.updates=0: must be at least 1"]),
    (["loss.ppo.kl_target=0.03"], ["loss.ppo.kl_stop=0.03 ends improvements before loss.ppo.kl_target=0.03"]),
    (["model.average_rate=5"], ["model.average_rate=5.0: must be above 0 and at most 1"]),
    (["schedule.wait_for_model=1.2"], ["schedule.wait_for_model=1.2 is for loss.actor=ppo"]),
    (["schedule.wait_for_model=0.9", "loss.actor=ppo"], ["schedule.wait_for_model=0.9: a ratio of errors"]),
    (["env.miss_radius=0.5"], ["env.miss_radius=0.5", "more than 1.025 m"]),
    (["evaluation.start_noise=9"], ["evaluation.start_noise=9", "before the plane"]),
    (["env=dmc", "env.control_rate=25"], ["env.control_rate=25", "for races", "leave it at 50"]),
    (["env=dmc", "evaluation.start_noise=1"], ["evaluation.start_noise=1", "for races"]),
]


@pytest.mark.parametrize(("overrides", "words"), REFUSED, ids=[" ".join(overrides) for overrides, _ in REFUSED])
def test_what_cannot_work_is_refused_before_it_starts(
    overrides: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exited:
        build(f"run_dir={tmp_path / 'run'}", *overrides)
    assert exited.value.code == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("error: ") and "\n" not in message
    assert all(word in message for word in words), message
    assert not list((tmp_path / "run").glob("*.yaml")), "a run that was refused left its configuration"


def test_a_run_is_not_begun_over_another(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted((run_dir / "checkpoints").iterdir())
    with pytest.raises(SystemExit):
        build(f"run_dir='{run_dir}'")
    message = capsys.readouterr().err
    assert "holds a run already" in message and f"resume={run_dir}" in message and before[-1].name in message
    assert sorted((run_dir / "checkpoints").iterdir()) == before


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["task=walker_walk"], "task=walker_walk is for the Control Suite: add env=dmc"),
        (["env=dmc", "track=circle"], "track=circle is for races"),
        (["env=dmc", "+decoys=paper"], "decoys=paper are for races"),
    ],
)
def test_what_would_be_ignored_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        recipe_module("composing.checks").check_overrides(compose("dreamer_v3", *overrides), overrides)


def test_the_smallest_run_is_not_refused(tmp_path: Path) -> None:
    build(f"run_dir={tmp_path}", "env.num_envs=4", "prefill=64", "total_env_steps=80", "replay.capacity=1000")
    assert OmegaConf.load(tmp_path / "config.yaml").model.batch_length == 16


def test_a_single_world_holds_nothing_out(capsys: pytest.CaptureFixture[str]) -> None:
    dreamer = recipe_module("dreamer_v3")
    for num_envs, held_out in ((1, 0), (2, 1)):
        config = dreamer.resolve(compose("dreamer_v3", "model=debug", f"env.num_envs={num_envs}"))
        assert config.replay.held_out == held_out
        assert ("held out: nothing" in capsys.readouterr().out) == (num_envs == 1)


@pytest.mark.parametrize("override", ["loss.actor=dynamics", "loss.actor=reinforce", "replay.held_out=0"])
def test_what_races_goes_with_other_actors(override: str) -> None:
    config = recipe_module("dreamer_v3").resolve(compose("dreamer_v3", "tuned=race", override))
    recipe_module("composing.checks").check_dreamer(OmegaConf.to_object(config))


@pytest.mark.slow
def test_a_run_in_the_control_suite(tmp_path: Path) -> None:
    try:
        ControlSuiteEnv("cartpole_swingup", 1).close()
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    settings = [setting for setting in TINY if not setting.startswith(("track=", "env."))]
    settings += ["env=dmc", "task=cartpole_swingup", "prefill=1000", "total_env_steps=1050", AT_THE_END]
    done = recipe("dreamer_v3", *settings, "run_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = rows(tmp_path / "run")
    assert any(row["episode/return"] for row in table), "an episode has 500 records"
    for column in ("evaluation/return_mean", "loss_image", "held_out/image_error"):
        assert any(row[column] for row in table), column
    assert not any(name.startswith("curriculum/") or "gates" in name for name in table[0])
    assert list((tmp_path / "run" / "videos").glob("*.mp4"))
    for other in ("evaluate", "export"):
        refused = recipe(other, "checkpoint=run", cwd=tmp_path)
        assert refused.returncode == 2 and "Traceback" not in refused.stderr, refused.stderr
        assert "cartpole_swingup" in refused.stderr and "race" in refused.stderr
    resumed = recipe("dreamer_v3", "resume=run", "task=walker_walk", cwd=tmp_path)
    assert resumed.returncode == 2 and "Traceback" not in resumed.stderr, resumed.stderr


@pytest.mark.slow
def test_an_overlapped_run(tmp_path: Path) -> None:
    done = recipe("dreamer_v3", *TINY, "collection=overlapped", "run_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = rows(tmp_path / "run")
    # The rollout that was under way at the end is kept too.
    assert [int(row["env_steps"]) for row in table] == [128, 224, 256]
    assert any(float(row["loss_image"] or "nan") > 0 for row in table)
    assert latest_checkpoint(tmp_path / "run").name.endswith("256")


@pytest.mark.slow
def test_a_run_without_images(tmp_path: Path) -> None:
    done = recipe("dreamer_v3", *TINY, "env.from_pixels=false", AT_THE_END, "run_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run_dir = tmp_path / "run"
    table = rows(run_dir)
    for column in ("loss_vector", "evaluation/gates_per_episode", "evaluation/success_rate"):
        assert any(row[column] for row in table), column
    assert "loss_image" not in table[0]
    assert list((run_dir / "plots").glob("*.png")) and list((run_dir / "evaluations").glob("*.json"))
    done = recipe("evaluate", "checkpoint=run", "episodes=2", "num_envs=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(json.loads((run_dir / "evaluation" / "evaluation.json").read_text())["stochastic"]["episodes"]) == 2
    done = recipe("dreamer_v3", "resume=run", "env.from_pixels=true", cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    assert "environment of other observations" in done.stderr


@pytest.mark.slow
def test_a_run_on_small_images(tmp_path: Path) -> None:
    done = recipe("dreamer_v3", *TINY, "env.image_size=32", AT_THE_END, "run_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    last = [row for row in rows(tmp_path / "run") if row["loss_image"]][-1]
    assert float(last["loss_image"]) == pytest.approx(float(last["image_error"]) * 32 * 32 * 3, rel=1e-3)
    assert list((tmp_path / "run" / "videos").glob("*.mp4"))
    done = recipe("evaluate", "checkpoint=run", "episodes=2", "num_envs=2", "video_steps=20", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_privileged_run_is_evaluated(tmp_path: Path) -> None:
    done = recipe("dreamer_v3", *TINY, "loss=privileged", "run_dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = recipe("evaluate", "checkpoint=run", "episodes=2", "num_envs=2", "video_steps=20", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "run" / "evaluation" / "evaluation.json").read_text())
    assert all(len(report[policy]["episodes"]) == 2 for policy in ("deterministic", "stochastic"))
    assert (tmp_path / "run" / "evaluation" / "videos" / "deterministic.mp4").stat().st_size > 0


POISON = """
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
step, steps = DroneRacingEnv._step, []

def poisoned(env, tensordict):
    steps.append(0)
    data = step(env, tensordict)
    return data if len(steps) < 45 else data.set("reward_base", data["reward_base"] + float("inf"))

DroneRacingEnv._step = poisoned
"""


@pytest.mark.slow
@pytest.mark.parametrize("every", [100, 0], ids=["checkpoint", "no checkpoint"])
def test_a_loss_that_is_not_finite_ends_the_run(every: int, tmp_path: Path) -> None:
    settings = [*TINY, "env.from_pixels=false", f"checkpoint.every={every}", "total_env_steps=2000"]
    done = recipe("dreamer_v3", *settings, "run_dir=run", cwd=tmp_path, before=POISON)
    assert done.returncode == 1, done.stderr
    run_dir, message = tmp_path / "run", done.stderr[done.stderr.index("error:") :].strip()
    assert "is not finite" in message and "nonfinite_batch.pt" in message and "model.learning_rate" in message
    assert "Traceback" not in message and "\n" not in message
    batch = torch.load(run_dir / "nonfinite_batch.pt", weights_only=True)
    assert batch["reward"].shape == (2, 16, 1) and math.inf in batch["reward"]
    if not every:
        assert "there is no checkpoint yet" in message
        return
    kept = latest_checkpoint(run_dir)
    assert kept.name in message
    for path in kept.rglob("*learner*/**/*.pt"):
        weights = torch.load(path, weights_only=True)["agent"]
        assert all(value.isfinite().all() for value in weights.values()), "what was saved is not the last good state"
    assert int(kept.name.rpartition("-")[2]) >= 100


def test_settings_that_race_yield_to_the_command_line() -> None:
    tuned = compose("dreamer_v3", "tuned=race")
    assert (tuned.model.size, tuned.loss.world_model, tuned.loss.privileged_scale) == ("cpu_small", "privileged", 50)
    assert (tuned.env.control_rate, tuned.env.start_on_line, tuned.loss.discount) == (25, 0.7, 0.98)
    assert (tuned.loss.actor, tuned.model.sampled, tuned.replay.context) == ("ppo", False, True)
    changed = compose("dreamer_v3", "tuned=race", "loss=informed", "env.control_rate=50")
    assert (changed.loss.world_model, changed.env.control_rate, changed.loss.discount) == ("informed", 50, 0.98)


def test_dreamer_as_published_is_one_word_away() -> None:
    """Every number of losses, model and schedule as in the reference, or as its size says."""
    faithful, schema = compose("dreamer_v3", "tuned=none"), recipe_module("composing.schema")
    assert OmegaConf.to_container(faithful.loss) == OmegaConf.to_container(OmegaConf.structured(schema.LossConfig))
    assert OmegaConf.to_container(faithful.env) | {"num_envs": None} == OmegaConf.to_container(
        OmegaConf.structured(schema.EnvConfig(num_envs=1))
    ) | {"num_envs": None}
    assert faithful.model.sampled and faithful.model.average_rate is None and not faithful.replay.context
    schedule = OmegaConf.to_container(faithful.schedule)
    assert schedule == OmegaConf.to_container(OmegaConf.structured(schema.ScheduleConfig))
    assert schedule.pop("wait_for_model") is None and schedule.pop("wait_every")
    assert all(ramp["to"] is None for ramp in schedule.values())


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["track=kidney"], "race"),
        (["track=kidney", "env=faithful", "loss=informed", "budget=cpu"], "race"),
        (["model=debug"], "none"),
        (["model=size12m"], "none"),
        (["model=cpu_small"], "race"),
        (["budget=smoke"], "none"),
        (["env.from_pixels=false"], "none"),
        (["env=dmc", "task=walker_walk"], "none"),
    ],
)
def test_what_races_is_chosen_where_it_does(
    overrides: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert recipe_module("dreamer_v3").tune(compose("dreamer_v3", *overrides, "device=cpu")) == expected
    assert ("tuned=race" in capsys.readouterr().out) == (expected == "race")


def test_control_rate_line_starts_and_noise_reach_training_and_evaluation(tmp_path: Path) -> None:
    options = ["env.control_rate=25", "env.start_on_line=0.5", "env.miss_radius=2", "evaluation.start_noise=1"]
    options.append("evaluation.episodes=3")
    resolved = recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *TINY, *options, "env.episode_steps=null"))
    assert resolved.env.episode_steps == 500
    config, arena = OmegaConf.to_object(resolved), recipe_module("composing.arena")
    env = arena.make_env(config)
    assert (env.worlds.parameters.control_dt, env.worlds.race.episode_steps) == (0.04, 500)
    assert (env.worlds._starts._on_line, env.worlds.race._sweep._miss_radius) == (0.5, 2)
    learner = recipe_module("composing.learners").make_learner(config, Interface.of(env), "cpu")
    env.close()
    report = arena.make_report(config, tmp_path, learner, 3, 20, config.evaluation.start_noise)
    assert report._course.base.worlds.parameters.control_dt == 0.04
    assert report._course.base.worlds.race._sweep._miss_radius == 0
    assert report._course.base.worlds.num_envs == 3, "all begin at once, so that every agent meets the same starts"
    assert len({episode.reward_sum for episode in report.evaluate(deterministic=True).episodes}) == 3
    report.close()


def test_a_run_goes_on_at_its_control_rate(run_dir: Path) -> None:
    resumed = recipe_module("composing.launching").resumed_config
    with pytest.raises(ValueError, match=r"trained with env.control_rate=50.0, and goes on with it"):
        resumed("dreamer_v3", str(run_dir), ["env.control_rate=25"])
    recipe_module("composing.schema").register()
    with hydra.initialize_config_dir(str(CONFIG), version_base="1.3"):
        config, _ = resumed("dreamer_v3", str(run_dir), ["env.control_rate=50"])
    assert config.env.control_rate == 50


def test_a_resumed_run_says_what_is_other_than_it_was(run_dir: Path) -> None:
    training = recipe_module("composing.launching")
    config = training.saved_config("dreamer_v3", run_dir)
    config.run_dir = str(run_dir)
    assert training.changed_settings(config) == []
    config.loss.discount, config.model.average_rate = 0.9, 0.5  # by an override, or by another version's defaults
    assert training.changed_settings(config) == ["model.average_rate=0.5 (was null)", "loss.discount=0.9 (was 0.997)"]


def test_settings_that_another_version_had_are_left_out_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    saved = OmegaConf.create({"algorithm": "dreamer_v3", "model": {"size": "debug", "decay_updates": 8}, "old": 1})
    config = recipe_module("composing.saved").with_schema(saved, "dreamer_v3")
    assert config.model.size == "debug" and "decay_updates" not in config.model
    assert "settings of another version, left out: old=1, model.decay_updates=8" in capsys.readouterr().out


def test_the_control_suite_is_evaluated_in_images_of_the_size_trained_on():
    overrides = ["env=dmc", "task=cartpole_swingup", "env.image_size=96", "model=debug", "device=cpu", "seed=3"]
    config = OmegaConf.to_object(recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *overrides)))
    evaluated = recipe_module("composing.arena").make_suite(config, 1, 4)
    assert evaluated.observation_spec["pixels"].shape == (1, 96, 96, 3)
    evaluated.close()


def test_what_goes_by_gates_passed_moves_with_them_and_not_with_the_run():
    overrides = ["tuned=none", "model=debug", "device=cpu", "schedule.min_std.to=0.05", "schedule.min_std.begin=0.5"]
    overrides += ["schedule.min_std.end=0.7", "schedule.min_std.by=passes", "total_env_steps=100000"]
    config = OmegaConf.to_object(recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *overrides)))
    recipe_module("composing.checks").check_dreamer(config)
    learners, passes = recipe_module("composing.learners"), PassShare(1)
    assert learners.scheduled(config, learners.clock_times(config, 100_000, passes))["min_std"] == pytest.approx(0.1)
    passes.best = 0.6
    assert learners.scheduled(config, learners.clock_times(config, 0, passes))["min_std"] == pytest.approx(0.075)


def test_a_ramp_with_the_name_of_a_number_of_the_losses_moves_it():
    learners, names = recipe_module("composing.learners"), recipe_module("composing.schema").LOSS_RAMPS
    assert set(names) == {"discount", "entropy_scale", "min_std", "noise_correlation"}
    overrides = ["tuned=none", "model=debug", "device=cpu", "env.from_pixels=false"]
    overrides += [f"schedule.{name}.to=0.5" for name in (*names, "learning_rates")]
    config = OmegaConf.to_object(recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *overrides)))
    begin, end = (learners.scheduled(config, {Clock.run: share}) for share in (0.0, 1.0))
    assert begin == {"rates": 1.0} | {name: getattr(config.loss, name) for name in names}
    assert end == dict.fromkeys(("rates", *names), 0.5)
    learner = learners.make_learner(config, Interface(pixels=False, vector_dim=21), "cpu")
    learner.adjust(**end)
    assert float(learner.losses["actor"].noise_correlation) == learner.discount == 0.5


def test_nothing_goes_by_gates_where_there_are_none():
    overrides = ["env=dmc", "model=debug", "device=cpu", "schedule.discount.to=0.9", "schedule.discount.by=passes"]
    config = OmegaConf.to_object(recipe_module("dreamer_v3").resolve(compose("dreamer_v3", *overrides)))
    with pytest.raises(ValueError, match=r"schedule.discount.by=passes goes by gates, and env.suite=dmc has none"):
        recipe_module("composing.checks").check_dreamer(config)
