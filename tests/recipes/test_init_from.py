"""A run that begins with the weights of another, or of an agent that ships."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from dreamer_racing.export.shipped_agent import WEIGHTS
from dreamer_racing.export.weights_file import read_weights
from tests.running_recipes import ROOT, TINY, prepared, recipe_module

NUMBERS = [*TINY, "env.from_pixels=false", "prefill=64", "model.average_rate=0.1"]
AS_SHIPPED = ["tuned=race", "model=cpu_small", "prefill=4000", "total_env_steps=8000", "replay.capacity=20000"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with weights that no other begins with."""
    run_dir = tmp_path_factory.mktemp("runs") / "first"
    run = prepared(*NUMBERS, f"run_dir={run_dir}", "seed=7")
    with torch.no_grad():
        for parameter in (*run.learner.agent.parameters(), *run.learner.averaged.parameters()):
            parameter.add_(0.125)
    run.counters["env_steps"], run.learner.updates = 640, 11
    run.save()
    run.close()
    return run_dir


@pytest.fixture
def trained(saved: Path, tmp_path: Path) -> Path:
    """A copy of that run."""
    return shutil.copytree(saved, tmp_path / "first")


def test_all_weights_of_a_run_and_nothing_else(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = prepared(*NUMBERS, f"run_dir={trained.parent / 'next'}", f"init_from={trained}", "track=figure8")
    first = prepared(f"resume={trained}", *NUMBERS, f"run_dir={trained}", "seed=7")
    assert "weights: averaged, of" in capsys.readouterr().out
    for own, there in ((run.learner.agent, first.learner.agent), (run.learner.averaged, first.learner.averaged)):
        theirs = there.state_dict()
        assert all(torch.equal(value, theirs[name]) for name, value in own.state_dict().items())
    assert (run.learner.updates, run.counters["env_steps"], first.learner.updates) == (0, 0, 11)
    assert not run.learner.optimizer.state
    for one in (run, first):
        one.close()


@pytest.mark.parametrize("source", ["first", "kidney"])
def test_the_world_model_alone(source: str, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    overrides = [*NUMBERS, f"init_from={trained}"] if source == "first" else [*AS_SHIPPED, "init_from=kidney"]
    place = f"run_dir={trained.parent}"
    run, new = (prepared(*overrides, f"{place}/a", "init_behavior=false"), prepared(*overrides[:-1], f"{place}/b"))
    loaded = prepared(*overrides, f"{place}/c")
    begun = "world_model." if source == "first" else ("world_model.encoder.", "world_model.rssm.")
    for part in ("agent", "averaged"):
        own, theirs, initial = (getattr(each.learner, part).state_dict() for each in (run, loaded, new))
        for name, value in own.items():
            assert torch.equal(value, (theirs if name.startswith(begun) else initial)[name]), (part, name)
    actors = [list(each.learner.agent.actor.parameters()) for each in (run, loaded)]
    assert not all(map(torch.equal, *actors))
    said = capsys.readouterr().out
    assert ("the world model alone" if source == "first" else "encoder and RSSM of") in said
    for one in (run, new, loaded):
        one.close()


def test_a_run_with_a_damaged_configuration_is_refused_by_name(trained: Path) -> None:
    (trained / "config.yaml").write_text("env: {")
    with pytest.raises(ValueError, match=r"first/config\.yaml is damaged"):
        prepared(*NUMBERS, f"run_dir={trained.parent / 'next'}", f"init_from={trained}")


def test_a_resumed_run_goes_on_with_its_own_weights(trained: Path) -> None:
    again = prepared(f"resume={trained}", *NUMBERS, f"run_dir={trained}", "init_from=nowhere")
    assert again.learner.updates == 11
    again.close()


def test_the_networks_of_an_agent_that_ships(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = prepared(
        *AS_SHIPPED, f"run_dir={tmp_path / 'run'}", "init_from=kidney", "track=circle", "env.preset=faithful"
    )
    weights = read_weights(ROOT / "agents" / "kidney" / WEIGHTS)
    for agent in (run.learner.agent, run.learner.averaged):
        encoder = agent.get_submodule("world_model.encoder").state_dict()
        assert all(torch.equal(value, weights[f"encoder.{name}"]) for name, value in encoder.items())
    assert "encoder, RSSM and actor of" in capsys.readouterr().out
    run.close()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([*NUMBERS, "init_from=nowhere"], ["init_from=nowhere: there is no such file or folder", "by name: circle"]),
        ([*TINY, "init_from=kidney"], ["size 'cpu_small'", "size 'debug'"]),
        ([*AS_SHIPPED, "init_from=kidney", "env.control_rate=50"], ["control_rate"]),
        ([*AS_SHIPPED, "init_from=kidney", "env.camera_tilt=10"], ["camera_tilt"]),
        ([*NUMBERS, "init_from=first", "env.control_rate=25"], ["env.control_rate=25.0: init_from="]),
        (
            [*NUMBERS, "init_from=first", "model=size1m", "model.batch_length=8", "model.batch_size=2"],
            ["Weights cannot be converted between sizes"],
        ),
    ],
)
def test_what_does_not_fit_is_refused(
    overrides: list[str],
    words: list[str],
    saved: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(saved.parent)
    with pytest.raises(SystemExit), recipe_module("composing.entry").plain_errors():
        prepared(*overrides, f"run_dir={tmp_path / 'run'}")
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
