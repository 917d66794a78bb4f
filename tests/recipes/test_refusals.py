"""What the training recipes refuse, in plain words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from tests.running_recipes import ROOT, build, compose, recipe_module, refused


@pytest.mark.parametrize("override", ["resume=/nowhere", "run_dir=/dev/null/run"])
def test_a_person_gets_a_plain_error(override: str, tmp_path: Path) -> None:
    said = refused("dreamer_v3", "model=debug", override, cwd=tmp_path)
    assert override.partition("=")[2] in said and len(said.strip().splitlines()) <= 6


REFUSED = [
    (["track=monza"], ["monza", "kidney"]),
    (["tuned=none", "loss.averaged_kl_scale=0.3"], ["averaged_kl_scale of up to 0.3", "set model.average_rate"]),
    (["tuned=none", "schedule.averaged_kl_scale.to=0.3"], ["averaged_kl_scale of up to 0.3", "set model.average_rate"]),
    (["env.preset=esay"], ["env.preset=esay", "did you mean easy?", "faithful"]),
    (["env.renderer=directx", "env.from_pixels=true"], ["directx", "egl"]),
    (["device=cuda:7"], ["cuda:7", "cpu"]),
    (["env.device=gpu"], ["env.device=gpu", "cpu", "cuda"]),
    (["env.device=cuda:7"], ["cuda:7", "finds no CUDA device", "cpu"]),
    (["num_workers=4"], ["num_workers=4 is for collector=ray"]),
    (["workers.cpus=2"], ["workers.cpus=2", "is for collector=ray"]),
    (["collector=ray", "num_workers=3"], ["env.num_envs=32", "num_workers=3", "env.num_envs=33"]),
    (["collector=ray", "workers.weight_interval=500"], ["weight_interval=500", "256 env_steps", "512 env_steps old"]),
    (["collector=ray", "workers.gpus=1.5"], ["workers.gpus=1.5", "fraction of one GPU", "workers.gpus=1."]),
    (["env.looks=pretty", "env.from_pixels=true"], ["pretty", "nominal", "randomised"]),
    (["env.looks=randomised", "env.from_pixels=false"], ["env.looks=randomised", "nominal"]),
    (["loss.actor=magic"], ["magic", "reinforce"]),
    (["loss.actor=clipped"], ["loss.actor=clipped learns from collected steps: use it with recipes/latent_ppo.py"]),
    (
        ["loss.critic=latent", "loss.actor=reinforce"],
        ["loss.actor=reinforce learns from imagined steps: use it with recipes/dreamer_v3.py"],
    ),
    (["model.replay_ratio=inf"], ["model.replay_ratio=inf", "above 0, and finite"]),
    (["prefill=100", "env.num_envs=8"], ["prefill=100", "12 records", "batch_length=16", "at least 128"]),
    (["prefill=4000", "total_env_steps=4000"], ["total_env_steps=4000", "above prefill=4000"]),
    (["env.image_size=0"], ["env.image_size=0", "multiple of 16"]),
    (["env.image_size=40"], ["env.image_size=40", "multiple of 16", "32, 64 or 96"]),
    (["loss.world_model=nowhere:Loss"], ["nowhere:Loss", "was not found", "set PYTHONPATH"]),
    (["prefill=512", "total_env_steps=527"], ["total_env_steps=527", "64 records"]),  # 15 × 4 are less than 4 × 16
    (["replay.capacity=100000000000"], ["replay.capacity=100,000,000,000", " GB when full", "left", "memmap"]),
    (["replay.capacity=100"], ["capacity=100", "batch_length=16", "at least 512"]),
    (["replay.held_out=32"], ["held_out=32", "num_envs=32"]),
    (["env.suite=atari"], ["env.suite=atari", "race", "dmc"]),
    (["env=dmc", "env.from_pixels=false", "loss=privileged"], ["loss.world_model=privileged", "reconstruction"]),
    (["env=dmc", "task=walker_fly"], ["walker_fly", "walker_walk"]),
    (["device=quantum"], ["device=quantum", "cpu"]),
    (["device=gpu"], ["device=gpu: there are auto, cpu, cuda and cuda:1 ... (did you mean cuda?)."]),
    (["env.control_rate=5"], ["env.control_rate=5", "at least 10"]),
    (["env.control_rate=inf"], ["env.control_rate=inf Hz: must be a finite number"]),
    (["env.control_rate=60"], ["env.control_rate=60", "whole number of physics steps of 2 ms"]),
    (["env.start_on_line=1", "env.start_beyond_gate=0.5"], ["env.start_beyond_gate=0.5", "env.start_on_line=1 leaves"]),
    (["env.start_on_line=0.5", "schedule.start_on_line.to=2"], ["schedule.start_on_line.to=2.0: must be at least 0"]),
    (
        ["schedule.discount.to=0.99", "schedule.discount.begin=0.6", "schedule.discount.end=0.5"],
        ["schedule.discount: begin=0.6 and end=0.5"],
    ),
    (["replay.storage=memmap", "replay.device=cpu"], ["replay.device=cpu is for replay.storage=tensor"]),
    (["replay.device=gpu"], ["replay.device=gpu: there are auto, cpu, cuda and cuda:1 ... (did you mean cuda?)"]),
    (["schedule.learning_rates.to=0"], ["schedule.learning_rates.to=0.0: must be above 0"]),
    (["schedule.start_on_line.to=0.3"], ["schedule.start_on_line starts from env.start_on_line=0"]),
    (["tuned=images", "env.from_pixels=false"], ["tuned=images is for agents that see images", "leave one out"]),
    (["env=dmc", "loss.critic=state"], ["loss.critic=state: read", "loss.critic=latent"]),
    (["schedule.imagination_horizon.to=0"], ["schedule.imagination_horizon.to=0.0: must be at least 1"]),
    (["loss.open_loop_steps=16"], ["loss.open_loop_steps=16", "less than", "model.batch_length=16"]),
    (["loss.ppo.kl_target=0.03"], ["loss.ppo.kl_stop=0.03 must be at least 1.5 times loss.ppo.kl_target=0.03"]),
    (
        ["loss.ppo.kl_target=0.01", "schedule.kl_target.to=0.03"],
        ["loss.ppo.kl_stop=0.03 must be at least 1.5 times schedule.kl_target.to=0.03"],
    ),
    (["schedule.kl_target.to=0.01"], ["schedule.kl_target.to=0.01 starts from loss.ppo.kl_target=null"]),
    (["loss.ppo.kl_target=0.01", "schedule.kl_target.to=0"], ["schedule.kl_target.to=0.0: must be above 0"]),
    (["model.average_rate=5"], ["model.average_rate=5.0: must be above 0 and at most 1"]),
    (["loss.min_std=0.5", "loss.max_std=0.5"], ["loss.min_std=0.5 must be below loss.max_std=0.5"]),
    (["loss.min_std=0.3", "schedule.max_std.to=0.15"], ["loss.min_std=0.3 must be below schedule.max_std.to=0.15"]),
    (["env.miss_radius=0.5"], ["env.miss_radius=0.5", "more than 1.025 m"]),
    (["evaluation.start_noise=9"], ["evaluation.start_noise=9", "before the plane"]),
    (["env=dmc", "env.control_rate=25"], ["env.control_rate=25", "for races", "leave it at 50"]),
    (["env=dmc", "env.renderer=egl"], ["env.renderer=egl", "for races", "leave it at auto"]),
    (["env=dmc", "env.start_at_gate=0"], ["env.start_at_gate=0", "for races", "leave it at 0.5"]),
    (
        ["env=dmc", "schedule.discount.to=0.9", "schedule.discount.by=passes"],
        ["schedule.discount.by=passes depends on gates", "env.suite=dmc has none"],
    ),
    (["env=dmc", "schedule.start_on_line.to=0"], ["schedule.start_on_line is for races", "leave it out"]),
    (["env=dmc", "evaluation.start_noise=1"], ["evaluation.start_noise=1", "for races"]),
]


OF_LATENT_PPO = ("loss.ppo", "loss.critic", "schedule.kl_target", "schedule.wait")


def taker(overrides: list[str]) -> str:
    """The recipe that has such settings."""
    return "latent_ppo" if any(override.startswith(OF_LATENT_PPO) for override in overrides) else "dreamer_v3"


@pytest.mark.parametrize(("overrides", "words"), REFUSED, ids=[" ".join(overrides) for overrides, _ in REFUSED])
def test_what_cannot_work_is_refused_before_it_starts(
    overrides: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exited:
        build(f"run_dir={tmp_path / 'run'}", *overrides, name=taker(overrides))
    assert exited.value.code == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("error: ") and "\n" not in message
    assert all(word in message for word in words), message
    assert not list((tmp_path / "run").glob("*.yaml")), "a run that was refused left its configuration"


def test_more_minibatches_than_records_are_refused() -> None:
    ppo = recipe_module("ppo")

    def check(minibatches: int) -> None:
        settings = ["env.num_envs=2", "rollout_steps=4", f"ppo.minibatches={minibatches}"]
        OmegaConf.to_object(ppo.resolve(compose("ppo", *settings))).check()

    check(8)
    with pytest.raises(ValueError, match=r"ppo.minibatches=9 are more than the 8 records of a rollout"):
        check(9)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["task=walker_walk"], "task=walker_walk is for the Control Suite: add env=dmc"),
        (["env=dmc", "track=circle"], "track=circle is for races"),
        (["env=dmc", "+decoys=paper"], "decoys=paper is for races"),
        (["env=dmc", "curriculum.maximum=0.02"], "curriculum.maximum=0.02 is for races"),
        (["track_description=x"], "track_description= is set by the run from its track file"),
    ],
)
def test_what_would_be_ignored_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        recipe_module("composing.launching").check_overrides(compose("dreamer_v3", *overrides), overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["loss=reconstruction", "loss.privileged_scale=3"], "privileged_scale=3.* is for loss=privileged or informed"),
        (["loss=privileged", "loss.image_scale=3"], "image_scale=3.* is for loss=reconstruction or informed"),
        (["loss=decoder_free", "loss.image_share=0.5"], "image_share=0.5 is for loss=reconstruction or informed"),
        (["env.from_pixels=false", "loss.image_share=0.5"], "is for loss=reconstruction or informed, from images"),
        (["loss=privileged", "loss.barlow_scale=3"], "loss.barlow_scale=3.* is for loss=decoder_free"),
        (["loss.critic=state", "model.imagination_every=2"], "imagination_every=2 is for recipes/dreamer_v3.py, whic"),
        (["loss.critic=state", "model.imagination_starts=8"], "imagination_starts=8 is for recipes/dreamer_v3.py, whi"),
        (["loss.drift_scale=1", "replay.context=true"], "drift_scale=1.* is for stored latents .*model.sampled=false"),
        (["loss.drift_scale=1", "model.sampled=false"], "drift_scale=1.* is for stored latents .replay.context=true"),
        (
            ["loss.replay_value_scale=0", "loss.replay_value_gradient=false"],
            "gradient=False is for loss.replay_value_sc",
        ),
        (["loss.slow_critic_scale=0", "model.slow_critic_rate=0.1"], "slow_critic_rate=0.1 is for loss.slow_critic_sc"),
        (
            ["loss.critic=state", "loss.replay_value_scale=0", "model.behavior_learning_rate=1e-4"],
            "behavior_learning_rate=0.0001 is for loss.replay_value_scale above 0",
        ),
        (["replay.recent_records=9"], "replay.recent_records=9 is for replay.recent_share above 0"),
        (["loss.continuation=false", "loss.crash_weight=4"], "crash_weight=4.* is for loss.continuation=true, which"),
        (
            ["loss.continuation=false", "schedule.crash_weight.to=4"],
            "crash_weight.to=4.* is for loss.continuation",
        ),
        (["schedule.discount.begin=0.5"], "discount.begin=0.5 is for schedule.discount.to, which is not chosen"),
        (["init_behavior=false"], "init_behavior=False is for init_from=, which is not chosen"),
        (["schedule.wait_every=9"], "wait_every=9 is for schedule.wait_for_model, which is not chosen"),
    ],
)
def test_settings_that_nothing_reads_are_refused(overrides: list[str], words: str) -> None:
    config = compose(taker(overrides), *overrides)
    with pytest.raises(ValueError, match=words):
        recipe_module("composing.launching").check_read(config, overrides)


@pytest.mark.parametrize(
    ("name", "setting", "other"),
    [
        ("dreamer_v3", "loss.ppo.epochs=2", "latent_ppo"),
        ("dreamer_v3", "loss.critic=state", "latent_ppo"),
        ("dreamer_v3", "schedule.kl_target.to=0.01", "latent_ppo"),
        ("dreamer_v3", "schedule.wait_for_model=2", "latent_ppo"),
        ("latent_ppo", "loss.return_decay=0.9", "dreamer_v3"),
        ("latent_ppo", "loss.continuation=false", "dreamer_v3"),
        ("latent_ppo", "sac.batch_size=2", "sac"),
        ("ppo", "loss.discount=0.9", "dreamer_v3.py and recipes/latent_ppo"),
    ],
)
def test_a_setting_of_another_algorithm_is_refused_with_the_recipe_that_takes_it(
    name: str, setting: str, other: str
) -> None:
    words = f"{setting.partition('=')[0]}: there is no such setting of recipes/{name}.py; it is for recipes/{other}.py."
    with pytest.raises(ValueError, match=f"^{re.escape(words)}$"):
        recipe_module("composing.options").check_arguments(name, [setting])


@pytest.mark.parametrize(
    "overrides",
    [
        ["tuned=race", "schedule.kl_target.to=null"],
        ["schedule.discount.to=0.99", "schedule.discount.by=passes"],
        ["loss.critic=latent", "loss.ppo.steps=200"],
        ["loss=informed", "loss.privileged_scale=3", "replay.recent_share=0.1", "replay.recent_records=9"],
        ["loss=informed", "loss.image_scale=3", "loss.image_share=0.5"],
        ["loss.actor=mine:objective", "loss.world_model=mine:Mine", "loss.image_scale=9", "loss.barlow_scale=9"],
    ],
)
def test_settings_that_are_read_or_not_given_are_accepted(
    overrides: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = "from dreamer_racing.losses import State, reinforce as objective\n\n\nclass Mine(State):\n    pass\n"
    (tmp_path / "mine.py").write_text(own)
    monkeypatch.syspath_prepend(tmp_path)
    recipe_module("composing.launching").check_read(compose(taker(overrides), *overrides), overrides)


def test_deviations_that_fall_together_are_compared_by_their_clock() -> None:
    def check(config: DictConfig) -> None:
        OmegaConf.to_object(config.schedule).check_deviations(config.loss)

    ramps = ["loss.min_std=0.5", "schedule.min_std.to=0.1", "schedule.max_std.to=0.15"]
    one_clock = [f"schedule.{name}.{key}" for name in ("min_std", "max_std") for key in ("begin=0.4", "end=0.8")]
    check(compose("dreamer_v3", *ramps, *one_clock, "schedule.min_std.by=known", "schedule.max_std.by=known"))
    with pytest.raises(ValueError, match=r"min_std=0.5 must be below schedule.max_std.to=0.15.*at different times"):
        check(compose("dreamer_v3", *ramps, *one_clock, "schedule.min_std.by=run", "schedule.max_std.by=known"))


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("evaluate", ["checkpoint=nowhere", "episodes=0"]),
        ("evaluate", ["checkpoint=nowhere", "start_noise=-1"]),
        ("perception", ["checkpoint=nowhere", "episodes=0"]),
        ("perception", ["checkpoint=nowhere", "num_envs=-3"]),
        ("export", ["checkpoint=nowhere", "steps=0"]),
        ("doctor", ["checkpoint.keep=0"]),
        ("plot", ["window=-1"]),
    ],
)
def test_numbers_out_of_their_range_are_refused_before_anything_is_read(
    name: str, overrides: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        recipe_module("composing.entry").to_checked_object(compose(name, *overrides))
    assert re.search(rf"{overrides[-1]}(\.0)?: must be at least", capsys.readouterr().err)


def test_an_unknown_protocol_is_refused() -> None:
    config = OmegaConf.to_object(compose("evaluate", "checkpoint=nowhere", "protocol=quick"))
    with pytest.raises(ValueError, match="protocol=quick: must be one of nominal, full"):
        config.check()
    config = OmegaConf.to_object(compose("evaluate", "checkpoint=nowhere", "protocol=full", "start_noise=1"))
    with pytest.raises(ValueError, match="start_noise=1.0 is for protocol=nominal"):
        config.check()


@pytest.mark.parametrize("name", ["circle", str(ROOT / "agents" / "circle")])
def test_an_agent_cannot_be_resumed(name: str) -> None:
    words = f"resume={name} is an agent, not a run to resume: start one with init_from={name}."
    with pytest.raises(ValueError, match=re.escape(words)):
        recipe_module("composing.launching").resumed_config("dreamer_v3", name, [])


def test_a_run_that_is_named_as_an_agent_is_resumed_where_it_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "circle").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="No complete checkpoint at .*circle: the path exists"):
        recipe_module("composing.launching").resumed_config("dreamer_v3", "circle", [])
