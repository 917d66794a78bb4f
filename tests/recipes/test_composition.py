"""Configurations: every one composes, and what is left open is chosen as said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torchrl.envs.transforms import Transform

from dreamer_racing.envs.tracks import load_track
from dreamer_racing.figures.runs import flatten
from dreamer_racing.modules import Interface
from dreamer_racing.training.episodes import GatePassRate
from dreamer_racing.training.schedule import DreamerV3ScheduleConfig, Schedule
from tests.running_recipes import CONFIG, EXPERIMENTS, build, compose, prepared, recipe_module, run_config

STATE = ["tuned=none", "model=debug", "device=cpu", "env.from_pixels=false"]
"""What every short run here is of, unless it sees images."""


def schedule_of(config: Any) -> Schedule:
    return Schedule(config.schedule, config.scheduled, config.total_env_steps)


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*/*.yaml")), ids=lambda path: f"{path.parent.name}={path.stem}")
def test_every_group_composes(path: Path) -> None:
    group = path.parent.name
    append = "+" if group == "decoys" else ""  # not among the defaults
    config = compose({"network": "ppo"}.get(group, "dreamer_v3"), f"{append}{group}={path.stem}")
    assert OmegaConf.select(config, group) is not None


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_variant_of_an_experiment_is_a_run_that_differs_from_the_others(experiment: str) -> None:
    algorithm, variants, overrides = (compose(experiment)[name] for name in ("algorithm", "variants", "overrides"))
    recipe = recipe_module(algorithm)
    settings = set()
    for changes in variants.values():
        resolved = recipe.resolve(compose(algorithm, "device=cpu", "run_dir=run", *changes, *overrides))
        OmegaConf.to_object(resolved).check()
        settings.add(OmegaConf.to_yaml(resolved))
    assert len(settings) == len(variants)
    swept = OmegaConf.load(CONFIG / f"{experiment}.yaml").hydra.sweeper.params.variant
    assert swept.split(",") == list(variants)


def test_every_model_config_names_a_known_size() -> None:
    from dreamer_racing.modules import SIZES

    named = {path.stem: OmegaConf.load(path)["size"] for path in (CONFIG / "model").glob("*.yaml")}
    assert named.pop("auto") == "auto"
    assert named.keys() == set(SIZES) and all(name == size for name, size in named.items())


@pytest.mark.parametrize("name", recipe_module("composing.schema").RECIPES)
def test_every_algorithm_has_its_recipe_its_files_and_its_learner(name: str) -> None:
    schema, recipe = recipe_module("composing.schema"), recipe_module(name)
    config = OmegaConf.to_object(recipe.resolve(compose(name, "budget=smoke", "device=cpu", "env.from_pixels=false")))
    assert type(config) is schema.RECIPES[name] and callable(recipe.train)
    if isinstance(config, schema.ReplayRunConfig):
        ratio = config.make_replay_ratio()
        assert ratio.updates(config.total_env_steps) > 0
    interface = Interface(pixels=False, vector_dim=21)
    learner = recipe_module("composing.building").make_learner(config, interface, "cpu")
    assert (learner.updates, learner.device) == (0, torch.device("cpu"))
    for policy in (learner.policy(), learner.evaluation_policy()):
        assert policy.deterministic is False and isinstance(policy.make_primer(), Transform)
    learner.check_finite()
    learner.load_state_dict(learner.state_dict())


def test_an_algorithm_without_a_learner_is_a_defect_that_says_so() -> None:
    config = recipe_module("composing.schema").RunConfig()
    with pytest.raises(NotImplementedError, match=r"make_learner\(\) has no branch for RunConfig"):
        recipe_module("composing.building").make_learner(config, Interface(), "cpu")


def test_decoys_are_a_config_group() -> None:
    arena, config = recipe_module("composing.building"), run_config("track=figure8", "+decoys=paper")
    assert arena.shared_env_arguments(config)["track"] == load_track("figure8_decoys")
    config.track = "circle"
    with pytest.raises(ValueError, match=r"decoys=paper is for track=figure8; track 'circle'"):
        arena.shared_env_arguments(config)
    assert OmegaConf.to_object(compose("evaluate", "checkpoint=x", "+decoys=none")).decoys == "none"


@pytest.mark.parametrize(
    ("device", "overrides", "expected"),
    [
        ("cpu", [], "cpu"),
        ("cuda", [], "cuda"),
        ("cuda", ["env.renderer=warp"], "cuda"),
        ("cuda", ["env.renderer=egl"], "cpu"),
        ("cuda", ["env=dmc"], "cpu"),
        ("cuda", ["env.device=cpu"], "cpu"),
        ("cpu", ["collector=ray", "workers.gpus=0.5"], "cpu"),  # the learner's own
        ("cuda", ["collector=ray"], "cuda"),
    ],
)
def test_worlds_to_train_and_to_be_evaluated_in_are_where_the_learner_is(
    monkeypatch: pytest.MonkeyPatch, device: str, overrides: list[str], expected: str
) -> None:
    """Where they can be; the device is asked for, not looked for."""
    arena, config = recipe_module("composing.building"), resolved_on(device, monkeypatch, *overrides)
    assert config.env.device == expected
    if config.env.suite == "race":
        made = []
        monkeypatch.setattr(arena, "EvaluationReport", lambda *arguments, **options: made.append(arguments[2]))
        arena.make_evaluator(OmegaConf.to_object(config), Path(), None)
        assert made[0]["device"] == expected


def resolved_on(device: str, monkeypatch: pytest.MonkeyPatch, *overrides: str, name: str = "dreamer_v3") -> object:
    """A configuration for a device that is asked for, not looked for."""
    resolving = recipe_module("composing.resolving")
    monkeypatch.setattr(resolving, "choose_device", torch.device)
    monkeypatch.setattr(resolving, "choose_mixed_precision", lambda device: (True, "as the test says"))
    return recipe_module(name).resolve(compose(name, f"device={device}", *overrides))


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ([], ("size12m", 64, 16, True, True)),
        (["budget=paper"], ("paper_large", 64, 16, True, True)),
        (["model=paper_large"], ("paper_large", 16, 64, False, True)),  # a size that is named has numbers of its own
        (["budget=smoke"], ("debug", 4, 16, False, True)),
        (["model.batch_length=64"], ("size12m", 16, 64, False, True)),
        (["replay.context=false"], ("size12m", 16, 64, False, True)),
        (["model.cuda_graph=false"], ("size12m", 64, 16, True, False)),
        (["tuned=race"], ("cpu_small", 32, 16, True, True)),
        (["tuned=suite", "env=dmc"], ("cpu_small", 16, 32, True, True)),
    ],
)
def test_on_cuda_windows_are_short_with_stored_latents_and_updates_a_graph(
    monkeypatch: pytest.MonkeyPatch, overrides: list[str], expected: tuple
) -> None:
    config = resolved_on("cuda", monkeypatch, *overrides)
    model = config.model
    assert (model.size, model.batch_size, model.batch_length, config.replay.context, model.cuda_graph) == expected
    OmegaConf.to_object(config).check()


def test_on_a_cpu_windows_are_not_shortened_and_no_graph_is_captured(monkeypatch: pytest.MonkeyPatch) -> None:
    config = resolved_on("cpu", monkeypatch, "model=size12m")
    assert (config.model.batch_size, config.model.batch_length) == (16, 64)
    assert (config.replay.context, config.model.cuda_graph, config.model.few_kernels) == (False, False, None)


def test_several_processes_capture_what_does_not_imagine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert not resolved_on("cuda", monkeypatch).model.cuda_graph
    assert resolved_on("cuda", monkeypatch, "tuned=race", name="latent_ppo").model.cuda_graph


def test_the_smallest_run_is_not_refused(tmp_path: Path) -> None:
    build(f"run_dir={tmp_path}", "env.num_envs=4", "prefill=64", "total_env_steps=80", "replay.capacity=1000")
    assert OmegaConf.load(tmp_path / "config.yaml").model.batch_length == 16


def test_few_worlds_hold_nothing_out_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    dreamer = recipe_module("dreamer_v3")
    for num_envs, asked, held_out in ((2, "null", 0), (2, "1", 1), (4, "null", 1), (4, "0", 0)):
        given = (f"env.num_envs={num_envs}", f"replay.held_out={asked}")
        config = dreamer.resolve(compose("dreamer_v3", "model=debug", *given))
        assert config.replay.held_out == held_out
        assert ("held out: nothing" in capsys.readouterr().out) == (num_envs == 2 and asked == "null")


@pytest.mark.parametrize(
    ("name", "override"),
    [("dreamer_v3", "loss.actor=dynamics"), ("dreamer_v3", "replay.held_out=0"), ("latent_ppo", "loss.critic=latent")],
)
def test_tuned_race_works_with_other_actors(name: str, override: str) -> None:
    config = recipe_module(name).resolve(compose(name, "tuned=race", override))
    OmegaConf.to_object(config).check()


def test_the_command_line_overrides_tuned_race() -> None:
    changed = compose("latent_ppo", "tuned=race", "loss=informed", "env.control_rate=50")
    assert (changed.loss.world_model, changed.env.control_rate, changed.loss.discount) == ("informed", 50, 0.98)


def test_tuned_images_shows_no_network_the_state_in_training() -> None:
    """All else is as in `tuned=race`, and so are other settings that are asked for."""
    images, race = (compose("latent_ppo", f"tuned={name}") for name in ("images", "race"))
    assert (images.loss.world_model, images.loss.critic) == ("reconstruction", "latent")
    assert (images.env.start_on_line, images.env.start_at_gate, images.schedule.start_on_line.to) == (0, 0.5, None)
    arena = recipe_module("composing.building")
    recipe = recipe_module("latent_ppo")
    resolved = [recipe.resolve(compose("latent_ppo", f"tuned={name}", "device=cpu")) for name in ("images", "race")]
    readers = [arena.privileged_losses(OmegaConf.to_object(config)) for config in resolved]
    assert readers == [[], ["loss.world_model=privileged", "loss.critic=state"]]
    changed = set(flatten(OmegaConf.to_container(images))) ^ set(flatten(OmegaConf.to_container(race)))
    assert {name for name, _ in changed} == {
        "tuned", "total_env_steps", "env.start_on_line", "env.start_at_gate", "model.replay_ratio",
        "loss.world_model", "loss.critic", "loss.image_scale", "loss.image_share", "loss.free_nats",
        "schedule.start_on_line.to",
    }  # fmt: skip
    assert compose("dreamer_v3", "tuned=images", "loss=informed").loss.world_model == "informed"


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("replay.context=true", None),
        ("replay.context=false", "the replay stores no latents (replay.context=false)"),
        ("model.sampled=true", "latents are sampled (model.sampled=true)"),
    ],
)
def test_the_drift_penalty_needs_stored_latents_that_are_not_sampled(
    capsys: pytest.CaptureFixture[str], override: str, reason: str | None
) -> None:
    config = recipe_module("dreamer_v3").resolve(compose("dreamer_v3", "tuned=race", override))
    assert config.loss.drift_scale == (1 if reason is None else 0)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("policy drift penalty: ")]
    assert lines == ([] if reason is None else [f"policy drift penalty: off, because {reason}"])


def test_tuned_none_is_dreamer_as_published() -> None:
    """Every number of losses, model and schedule as in the reference, or as its size says."""
    faithful, schema = compose("dreamer_v3", "tuned=none"), recipe_module("composing.schema")
    assert OmegaConf.to_container(faithful.loss) == OmegaConf.to_container(OmegaConf.structured(schema.DreamerV3Losses))
    assert OmegaConf.to_container(faithful.env) | {"num_envs": None} == OmegaConf.to_container(
        OmegaConf.structured(schema.EnvConfig(num_envs=1))
    ) | {"num_envs": None}
    assert faithful.model.sampled and faithful.model.average_rate is None and not faithful.replay.context
    schedule = OmegaConf.to_container(faithful.schedule)
    assert schedule == OmegaConf.to_container(OmegaConf.structured(DreamerV3ScheduleConfig))
    assert all(ramp["to"] is None for ramp in schedule.values())


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["track=kidney", "env=faithful", "loss=informed", "budget=cpu"], "race"),
        (["model=cpu_small"], "race"),
        (["budget=smoke"], "none"),
        (["env.from_pixels=false"], "none"),
        (["env=dmc", "task=walker_walk"], "suite"),
    ],
)
def test_tuned_auto_chooses_by_environment_budget_and_model(
    overrides: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert recipe_module("composing.resolving").tune(compose("dreamer_v3", *overrides, "device=cpu")) == expected
    told = capsys.readouterr().out
    assert ("tuned=none, the algorithm as published; there are no tuned settings for" in told) == (expected == "none")


@pytest.mark.parametrize("algorithm", ["latent_ppo", "dreamer_v3"])
def test_a_gpu_trains_by_the_settings_that_are_known_and_says_first_what_is_not(
    algorithm: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    resolving = recipe_module("composing.resolving")
    monkeypatch.setattr(resolving, "choose_device", lambda device: torch.device("cuda" if device == "auto" else device))
    assert resolving.tune(compose(algorithm, "track=kidney", "device=auto")) == "race"
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("settings: tuned=race, measured on CPUs.")
    assert "tuned=gpu" in first and "model=size12m" in first and not others
    assert resolving.tune(compose(algorithm, "device=auto", "model=size12m")) == "none"
    assert "no tuned settings for model=size12m" in capsys.readouterr().out


def test_a_run_with_a_setting_of_another_version_is_refused_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("{algorithm: dreamer_v3, model: {size: debug, decay_updates: 8}}")
    with pytest.raises(ValueError, match=r"cannot be read: Key 'decay_updates' .*Use the version that wrote it"):
        recipe_module("composing.saved").saved_config(tmp_path)


def test_the_control_suite_is_evaluated_in_images_of_the_size_trained_on():
    overrides = ["env=dmc", "task=cartpole_swingup", "env.image_size=96", "model=debug", "device=cpu", "seed=3"]
    config = run_config(*overrides)
    evaluated = recipe_module("composing.building").make_suite(config, 1, 4)
    assert evaluated.observation_spec["pixels"].shape == (1, 96, 96, 3)
    evaluated.close()


def test_ramps_by_gates_follow_passed_gates_and_not_the_run():
    overrides = ["tuned=none", "model=debug", "device=cpu", "schedule.min_std.to=0.05", "schedule.min_std.begin=0.5"]
    overrides += ["schedule.min_std.end=0.7", "schedule.min_std.by=passes", "total_env_steps=100000"]
    config = run_config(*overrides)
    config.check()
    schedule = schedule_of(config)
    schedule.pass_rate = GatePassRate(num_gates=1)
    assert schedule.at(100_000)["min_std"] == pytest.approx(0.1)
    schedule.pass_rate.best = 0.6
    assert schedule.at(0)["min_std"] == pytest.approx(0.075)


def test_a_ramp_with_the_name_of_a_number_of_the_losses_moves_it():
    learners, names = recipe_module("composing.building"), ("discount", "entropy_scale", "max_std", "min_std")
    ramps = [f"schedule.{name}.to=0.5" for name in (*names, "learning_rates", "world_model_rate")]
    config = run_config(*STATE, *ramps, "schedule.imagination_horizon.to=2")
    begin, end = map(schedule_of(config).at, (0, config.total_env_steps))
    own = {"rates": 1.0, "world_model_rate": 1.0, "imagination_horizon": config.model.imagination_horizon}
    assert begin == own | {name: getattr(config.loss, name) for name in names}
    assert end == dict.fromkeys(("rates", "world_model_rate", *names), 0.5) | {"imagination_horizon": 2}
    learner = learners.make_learner(config, Interface(pixels=False, vector_dim=21), "cpu")
    learner.adjust(**end)
    assert "kl_target" not in end  # there is none to begin at
    assert float(learner.entropy_scale) == float(learner.discount) == 0.5 and learner.horizon == 2


def test_what_the_chosen_losses_do_not_have_moves_only_if_it_is_asked_for():
    """The race's ramps of `kl_target` and of the horizon belong to one algorithm each."""
    of_each = {"latent_ppo": {"kl_target"}, "dreamer_v3": {"imagination_horizon", "action_change_scale"}}
    for name, own in of_each.items():
        config = run_config("tuned=race", "device=cpu", "total_env_steps=100000", name=name)
        moved = set(schedule_of(config).at(0)) - {"rates", "world_model_rate", "start_on_line"}
        assert moved == {"min_std", "max_std"} | own


def test_a_run_begins_with_the_weights_that_restoring_makes_before_it_loads_any(tmp_path: Path) -> None:
    """What trains and what restores a learner make it alike."""
    overrides = [*STATE, "loss=informed", "seed=7", "loss.critic=state", "loss.min_std=0.2", "env.num_envs=2"]
    overrides += [f"run_dir={tmp_path / 'run'}"]
    learners, config = recipe_module("composing.building"), run_config(*overrides, name="latent_ppo")
    run = prepared(*overrides, name="latent_ppo")
    made = learners.make_learner(config, Interface.of(run.env), config.device).state_dict()
    begun = run.learner.state_dict()
    run.close()
    own = begun["own_networks"]
    assert own["world_model_loss"] and own["state_critic"], "there are weights that are no part of the agent"
    for part in ("agent", "own_networks"):
        torch.testing.assert_close(begun[part], made[part], rtol=0, atol=0)


def test_a_checkpoint_flies_as_it_did_after_its_run_was_made_longer(tmp_path: Path) -> None:
    """The networks' bounds of deviations are the checkpoint's; of what it does not hold the schedule tells."""
    overrides = [*STATE, "env.num_envs=2", "prefill=32", "schedule.max_std.to=0.2", "schedule.discount.to=0.9"]
    overrides += [f"run_dir={tmp_path / 'run'}"]
    config = run_config(*overrides, "total_env_steps=1000")
    run = prepared(*overrides, "total_env_steps=1000")
    run.counters["env_steps"] = 500
    run.learner.adjust(max_std=0.3)
    checkpoint = run.save()
    run.close()
    for total, discount in ((1000, 0.9485), (2000, 0.97275)):  # from 0.997
        longer = replace(config, total_env_steps=total)
        learner, _ = recipe_module("composing.restoring").restore_learner(longer, checkpoint, torch.device("cpu"))
        assert learner.agent.actor.max_std.item() == pytest.approx(0.3)
        assert learner.discount == pytest.approx(discount)


def test_records_in_files_lie_in_the_run_directory_as_long_as_the_run_goes_on(tmp_path: Path) -> None:
    run = prepared(
        *STATE, "env.num_envs=2", "replay.storage=memmap", "replay.capacity=1000", f"run_dir={tmp_path / 'run'}"
    )
    run.parts["replay"].extend(next(run.collected))
    files = sorted(path.name for path in (tmp_path / "run" / "replay" / "process-0").rglob("*.memmap"))
    assert len(run.parts["replay"]) and {"vector.memmap", "action.memmap", "reward.memmap"} & set(files)
    run.close()
    assert not (tmp_path / "run" / "replay" / "process-0").exists()


def test_a_run_that_is_refused_leaves_no_folder_but_what_was_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.txt").touch()
    for place in (tmp_path / "run", tmp_path, tmp_path):  # its lock is left to the next
        with pytest.raises(SystemExit):
            build("init_from=nowhere", f"run_dir={place}")
        assert "init_from=nowhere" in capsys.readouterr().err
        assert not (tmp_path / "run").exists() and (tmp_path / "log.txt").exists()


def test_settings_that_differ_from_a_derived_tuned_file_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    recipe = recipe_module("latent_ppo")
    recipe.resolve(compose("latent_ppo", "tuned=images", "device=cpu"))
    told = capsys.readouterr().out
    assert "settings: tuned=images, for latent PPO on Circle from images alone" in told
    assert "settings that differ" not in told and "length: 2,500,000 env_steps" in told
    changed = ["env.control_rate=50", "loss.image_scale=1", "env.start_on_line=0.7"]
    recipe.resolve(compose("latent_ppo", "tuned=images", "device=cpu", *changed))
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "settings that differ" in line)
    assert "env.control_rate=50.0 (25.0)" in line and "loss.image_scale=1.0 (0.003)" in line
    assert "env.start_on_line=0.7 (0.0)" in line, "the file sets the value that tuned=none has, too"


def test_settings_that_differ_from_tuned_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing for the settings as they are; else each with what the file has, also of a group that it takes."""
    recipe = recipe_module("latent_ppo")
    recipe.resolve(compose("latent_ppo", "tuned=race", "track=kidney", "seed=3", "device=cpu"))
    assert "settings that differ" not in capsys.readouterr().out
    recipe_module("dreamer_v3").resolve(compose("dreamer_v3", "tuned=race", "device=cpu"))
    told = capsys.readouterr().out
    assert "settings: tuned=race, for DreamerV3 on races" in told and "latent PPO" not in told
    changed = ["loss=reconstruction", "loss.critic=latent", "schedule.kl_target.to=null", "replay.context=false"]
    recipe.resolve(compose("latent_ppo", "tuned=race", "device=cpu", "loss.drift_scale=0", *changed))
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "settings that differ" in line)
    for words in (
        "loss.world_model=reconstruction (privileged)", "loss.critic=latent (state)",
        "schedule.kl_target.to=null (0.004)", "replay.context=false (true)", "loss.drift_scale=0.0 (1.0)",
    ):  # fmt: skip
        assert words in line
