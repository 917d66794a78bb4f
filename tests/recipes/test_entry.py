"""How a recipe starts: signals, packages that are missing, and what is said while one waits."""

from __future__ import annotations

import ast
import signal
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import hydra
import pytest
import torch
from hydra.errors import HydraException

from dreamer_racing.figures.plotting import PlotConfig
from dreamer_racing.training.schedule import MEDIAN_WINDOW
from tests.running_recipes import CONFIG, ROOT, TINY, compose, open_session, recipe_module, refused


@pytest.mark.parametrize(
    ("argument", "taken"),
    [
        ("total_env_steps=1e6", "total_env_steps=1000000"),
        ("total_env_steps=1.5E+6", "total_env_steps=1500000"),
        ("loss.entropy_scale=1e-3", "loss.entropy_scale=1e-3"),
        ("run_dir=1e6x", "run_dir=1e6x"),
        ("run_dir=2026.10", "run_dir='2026.10'"),
        ("run_dir=null", "run_dir=null"),
        ("betaflight=2026.10", "betaflight='2026.10'"),
        ("resume=läufe/k=1 (2)", "resume='läufe/k=1 (2)'"),
        ("resume=~/k1", f"resume={Path.home()}/k1"),
        ("env.preset=~/drone.yaml", f"env.preset={Path.home()}/drone.yaml"),
        ("init_from=~/2 runs/k1", f"init_from={Path.home()}/2 runs/k1"),
        ("runs=läufe/k1,läufe/k2", "runs=läufe/k1,läufe/k2"),
        ("total_env_steps=1e5,2e5,7", "total_env_steps=100000,200000,7"),
        ("variants.slow=['env.num_envs=4']", "variants.slow=['env.num_envs=4']"),
        ("--multirun", "--multirun"),
        ("seed=1e999999999", "seed=1e999999999"),
    ],
)
def test_whole_numbers_may_be_written_short_and_paths_as_they_are(argument: str, taken: str) -> None:
    assert recipe_module("composing.entry").normalise_argument(argument) == taken


@pytest.mark.parametrize("text", ["runs/a-b_1.2", "läufe/k1", "a,b", "it's", "a\\'b\\", "(x)[y]{z}=1#&", "null", "1e3"])
def test_any_text_can_be_said_to_hydra(text: str) -> None:
    command_line = recipe_module("composing.entry")
    override = command_line.as_override("run_dir", text)
    assert command_line.override_value(override) == text
    assert (override == f"run_dir={text}") is (text == "runs/a-b_1.2")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (
            "env.num_env=3",
            "env.num_env: there is no such setting of recipes/dreamer_v3.py (did you mean env.num_envs?). docs/options",
        ),
        ("discont=0.9", "(did you mean loss.discount?)"),
        ("xyzzy=1", "xyzzy: there is no such setting of recipes/dreamer_v3.py. docs/options.md has them all."),
        ("model=cpu_smal", "(did you mean cpu_small?)."),
        ("total_env_steps=many", "total_env_steps=many: Value 'many' of type 'str' is not a whole number."),
        ("env.from_pixels=maybe", "env.from_pixels=maybe: Value 'maybe' is neither true nor false."),
        ("schedule.discount=0.99", "schedule.discount=0.99: a schedule is set by NAME.to="),
        ("decoys=paper", "decoys: must be added with a plus: +decoys=..."),
        (
            "schedule.max_std.by=gates",
            "schedule.max_std.by=gates: Invalid value 'gates', expected one of [run, passes, known].",
        ),
        ("kidney", "kidney: an override is written name=value"),
        ("run_dir=[a", "run_dir=[a: overrides are written name=value, and a value with brackets"),
    ],
)
def test_what_hydra_refuses_is_said_in_plain_words(override: str, words: str) -> None:
    entry = recipe_module("composing.entry")
    with pytest.raises(HydraException) as refusal:
        compose("dreamer_v3", override)
    said = entry.in_plain_words(refusal.value, "dreamer_v3", [override])
    assert words in said and "schema" not in said and "\n" not in said and "hydra.cc" not in said


@pytest.mark.parametrize(
    ("recipe_name", "taken"),
    [
        ("dreamer_v3", ["+decoys=paper", "track=kidney", "++seed=1", "+hydra.launcher.ray.remote.num_gpus=1", "-m"]),
        ("dreamer_v3", ["schedule.max_std.to=0.1", "schedule={}", "hydra/launcher=slurm", "budget=smoke,cpu"]),
        ("experiment", ["+variants.slow=['env.num_envs=4']", "variant=slow", "--multirun"]),  # docs/baselines.md
        ("experiment", ["--config-n=race_ablation", "--config-name", "ablation", "-m", "'name=--a=b'", "anything=1"]),
        ("doctor", ["--json"]),
    ],
)
def test_known_settings_are_accepted(recipe_name: str, taken: list[str]) -> None:
    recipe_module("composing.options").check_arguments(recipe_name, taken)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["env=[[[]]]"], r"env=\[\[\[\]\]\]: must be the name of one"),
        (["+trak=kidney"], r"trak: there is no such setting .*did you mean track"),
        (["--track", "kidney"], "--track: settings are written without dashes, track=VALUE"),
        (["-m", "--total-env-steps=9"], "--total-env-steps=9: settings are written without dashes, total_env_steps=9"),
    ],
)
def test_unknown_settings_are_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        recipe_module("composing.options").check_arguments("dreamer_v3", overrides)


def test_a_recipe_is_still_its_function(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    start = recipe_module("composing.entry").recipe("plot", PlotConfig)(lambda config: seen.append(config.window))
    monkeypatch.setattr(sys, "argv", ["plot.py", "window=1e3"])
    monkeypatch.setattr(sys, "excepthook", recipe_module("composing.messages").end_quietly)
    start()
    assert sys.excepthook is sys.__excepthook__, "what ends while packages are loaded is no concern any more"
    assert seen == [1000.0] and Path(CONFIG).is_dir() and not hydra.core.global_hydra.GlobalHydra().is_initialized()


LOADING = """
import atexit, os, runpy, signal, sys
class Interrupted:
    def find_spec(name, path=None, target=None):
        if name == "torchrl.collectors":
            sys.meta_path.remove(Interrupted)
            os.kill(os.getpid(), signal.SIGINT)
atexit.register(exec, "")  # as packages do when they import one more at the exit: the interpreter forgets the signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # shells have what they start in the background ignore it
sys.meta_path.insert(0, Interrupted)
sys.path.insert(0, {recipes!r})
runpy.run_path({recipes!r} + "/ppo.py", run_name="__main__")
"""
SETTING_UP = """
import os, signal
from dreamer_racing.training import directory
directory.RunLock.__init__ = lambda *given: os.kill(os.getpid(), signal.SIGINT)
"""


def test_ctrl_c_while_packages_are_loaded_is_no_traceback(tmp_path: Path) -> None:
    program = LOADING.format(recipes=str(ROOT / "recipes"))
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == -signal.SIGINT, done.stderr
    assert done.stderr == "interrupted\n" and not list(tmp_path.iterdir())


def test_ctrl_c_before_anything_is_there_is_no_traceback(tmp_path: Path) -> None:
    settings = ("track=circle", "env.from_pixels=false", "run_dir=run")
    said = refused("ppo", *settings, status=130, cwd=tmp_path, before=SETTING_UP)
    assert said.strip().splitlines()[-1] == "interrupted"


def test_a_configuration_of_ones_own_stays_when_settings_are_chosen_for_it(tmp_path: Path) -> None:
    """`tuned=auto` composes anew, from the configuration that was named."""
    own = "defaults: [dreamer_v3, _self_]\nprefill: 123456789\n"
    (tmp_path / "own.yaml").write_text(own, encoding="utf-8")
    flags = ("--config-dir", str(tmp_path), "--config-name", "own")
    assert "prefill=123456789" in refused("dreamer_v3", *flags, cwd=tmp_path)


def test_a_race_does_without_dm_control_which_opens_a_display(tmp_path: Path) -> None:
    without = "import sys; sys.modules['dm_control'] = None"
    assert "prefill" in refused("dreamer_v3", "model=debug", "total_env_steps=1", cwd=tmp_path, before=without)


# A recipe that is started by a Python without the project's packages.


OLDER = """
import datetime, enum, itertools, runpy, sys, typing
del datetime.UTC, enum.StrEnum, itertools.pairwise, typing.Self  # as in Python 3.9
sys.argv.pop(0)
sys.path.insert(0, sys.argv[0].rpartition("/")[0])
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.py")), ids=lambda path: path.stem)
def test_every_recipe_says_how_to_run_it_to_an_older_python_too(tmp_path: Path, path: Path) -> None:
    messages = (path.parent / "composing" / "messages.py").read_text(encoding="utf-8")
    assert "from __future__ import annotations" in messages, "its hints are of newer Pythons"
    ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 9))
    command = [sys.executable, "-S", "-E", "-c", OLDER, str(path)]  # no packages
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "has no dreamer_racing" in done.stderr and f"{ROOT}/dev python {path}" in done.stderr


# The actor waits where the model lags behind.


SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.steps=32",
    "loss.ppo.minibatch=32", "env.start_on_line=0", "schedule.start_on_line.to=null", "schedule.wait_every=32",
]  # fmt: skip


@pytest.mark.slow
def test_the_actor_waits_while_the_newest_records_are_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latent_ppo = recipe_module("latent_ppo")
    config, session = open_session(
        *SETTINGS, f"run_dir={tmp_path}", f"total_env_steps={32 * (12 + MEDIAN_WINDOW)}", name="latent_ppo"
    )
    looked, waited = [], []

    def measure(learner, windows):
        replay = session.parts["replay"]
        newest = torch.stack([replay.records(world)["reward"][-8:] for world in range(replay.num_streams)])
        assert torch.equal(windows["reward"], newest), "of all worlds, what the newest rollout brought"
        looked.append(learner.updates)
        return {"privileged_error": torch.tensor(1e3 if session.env_steps <= 12 * 32 else 0.0)}

    def watched(self, batch, timed, update=latent_ppo.LatentPPO.update):
        before = [parameter.clone() for parameter in self.agent.actor.parameters()]
        if looked and looked[-1] == self.updates:  # the first update after a look
            waited.append(self.actor_waits)
        metrics = update(self, batch, timed)
        if self.actor_waits:
            assert all(map(torch.equal, before, self.agent.actor.parameters()))
        assert self.actor_waits is session.parts["lag"].waits
        return metrics

    monkeypatch.setattr("dreamer_racing.evaluation.held_out.world_model_metrics", measure)
    monkeypatch.setattr(latent_ppo.LatentPPO, "update", watched)
    latent_ppo.train(config, session)
    session.close()
    assert True in waited and waited[-1] is False and waited == sorted(waited, reverse=True)


def test_no_number_is_taken_for_text() -> None:
    entry = recipe_module("composing.entry")
    for path in sorted((ROOT / "recipes").glob("*.py")):
        recipe_module(path.stem)
    for schema in entry.SCHEMAS.values():
        kinds = get_type_hints(schema)
        numbers = {name for name, kind in kinds.items() if {int, float, bool} & {kind, *get_args(kind)}}
        assert numbers.isdisjoint(entry.TEXTS), schema
