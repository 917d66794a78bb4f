"""The actor waits where the model lags behind, and only where it steps alone."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dreamer_racing.training.model_lag import LOOKS
from tests.running_recipes import TINY, open_session, prepared, recipe_module

SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.steps=32",
    "loss.ppo.minibatch=32", "env.start_on_line=0", "schedule.start_on_line.to=null", "schedule.wait_every=32",
]  # fmt: skip


@pytest.mark.slow
def test_the_actor_waits_while_the_newest_records_are_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dreamer = recipe_module("dreamer_v3")
    config, session = open_session(*SETTINGS, f"run_dir={tmp_path}", f"total_env_steps={32 * (12 + LOOKS)}")
    looked, waited = [], []

    def measure(learner, windows):
        replay = session.parts["replay"]
        newest = torch.stack([replay.records(world)["reward"][-8:] for world in range(replay.num_streams)])
        assert torch.equal(windows["reward"], newest), "of all worlds, what the newest rollout brought"
        looked.append(learner.updates)
        return {"privileged_error": torch.tensor(1e3 if session.env_steps <= 12 * 32 else 0.0)}

    def watched(self, batch, timed, update=dreamer.LatentPPO.update):
        before = [parameter.clone() for parameter in self.agent.actor.parameters()]
        if looked and looked[-1] == self.updates:  # the first update after a look
            waited.append(self.actor_waits)
        metrics = update(self, batch, timed)
        if self.actor_waits:
            assert all(map(torch.equal, before, self.agent.actor.parameters()))
        assert self.actor_waits is session.parts["lag"].waits
        return metrics

    monkeypatch.setattr(dreamer, "world_model_metrics", measure)
    monkeypatch.setattr(dreamer.LatentPPO, "update", watched)
    dreamer.train(config, session)
    session.close()
    assert True in waited and waited[-1] is False and waited == sorted(waited, reverse=True)


def test_an_actor_that_cannot_wait_is_not_watched(tmp_path: Path) -> None:
    given = [setting for setting in SETTINGS if not setting.startswith(("loss.ppo", "schedule.wait_every"))]
    session = prepared(*given, "loss.actor=reinforce", f"run_dir={tmp_path}")
    assert session.config.schedule.wait_for_model == 2 and session.parts["lag"].limit is None
    session.close()
