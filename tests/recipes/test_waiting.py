"""An actor that has come to where its model errs waits for it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from dreamer_racing.training.model_lag import LOOKS
from dreamer_racing.training.run import graceful_exit
from tests.running_recipes import TINY, compose, recipe_module

SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.flown=32",
    "loss.ppo.minibatch=32", "env.start_on_line=0", "schedule.start_on_line.to=null", "schedule.wait_every=32",
]  # fmt: skip


@pytest.mark.slow
def test_the_actor_waits_while_the_newest_records_are_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dreamer, given = recipe_module("dreamer_v3"), [*SETTINGS, f"run_dir={tmp_path}"]
    run = dreamer.build(OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", *given))), given)
    looked, error = [], 1e3
    said: list[str] = []
    run.say = said.append

    def measure(learner, windows):
        newest = torch.stack([run.replay.records(world)["reward"][-8:] for world in range(run.replay.num_streams)])
        assert torch.equal(windows["reward"], newest), "of all worlds, what the newest rollout brought"
        looked.append(learner.updates)
        return {"privileged_error": torch.tensor(error)}

    monkeypatch.setattr(dreamer, "world_model_metrics", measure)
    waited = []
    with graceful_exit() as stop:
        for number in range(12 + LOOKS):
            error = 1e3 if number < 12 else 0.0
            updates, before = run.learner.updates, [p.clone() for p in run.learner.agent.actor.parameters()]
            run.take_in(next(run.rollouts))
            run.learn(None, stop)
            if looked and run.learner.updates > updates:
                assert looked[-1] == updates, "before it learns from them"
                waits = all(map(torch.equal, before, run.learner.agent.actor.parameters()))
                assert waits is run.lag.waits
                waited.append(waits)
    assert True in waited and waited[-1] is False and waited == sorted(waited, reverse=True)
    assert len(said) == 2
    assert said[0].startswith("the actor waits: the model errs ") and said[0].endswith("(schedule.wait_for_model=2)")
    assert said[1].startswith("the actor goes on: ")
    run.close()


def test_an_actor_that_cannot_wait_is_not_watched(tmp_path: Path) -> None:
    dreamer, given = recipe_module("dreamer_v3"), [*SETTINGS, "loss.actor=reinforce", f"run_dir={tmp_path}"]
    given = [setting for setting in given if not setting.startswith(("loss.ppo", "schedule.wait_every"))]
    run = dreamer.build(OmegaConf.to_object(dreamer.resolve(compose("dreamer_v3", *given))), given)
    assert run.config.schedule.wait_for_model == 2 and run.lag.limit is None
    run.close()
