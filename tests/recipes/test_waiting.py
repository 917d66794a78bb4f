"""The actor waits where the model lags behind."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dreamer_racing.training.model_lag import LOOKS
from tests.running_recipes import TINY, open_session, recipe_module

SETTINGS = [
    *TINY, "tuned=race", "model=debug", "model.batch_size=4", "env.from_pixels=false", "loss.ppo.steps=32",
    "loss.ppo.minibatch=32", "env.start_on_line=0", "schedule.start_on_line.to=null", "schedule.wait_every=32",
]  # fmt: skip


@pytest.mark.slow
def test_the_actor_waits_while_the_newest_records_are_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    latent_ppo, measuring = recipe_module("latent_ppo"), recipe_module("composing.measuring")
    config, session = open_session(
        *SETTINGS, f"run_dir={tmp_path}", f"total_env_steps={32 * (12 + LOOKS)}", name="latent_ppo"
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

    monkeypatch.setattr(measuring, "world_model_metrics", measure)
    monkeypatch.setattr(latent_ppo.LatentPPO, "update", watched)
    latent_ppo.train(config, session)
    session.close()
    assert True in waited and waited[-1] is False and waited == sorted(waited, reverse=True)
