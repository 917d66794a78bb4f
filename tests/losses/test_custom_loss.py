"""The losses that docs/losses.md writes, run as a reader would run them."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch

from dreamer_racing.losses import TARGETS, kl_losses
from dreamer_racing.modules import Interface
from tests.dreamers import latent_ppo_of, learner_of
from tests.learners.test_dreamer_v3 import make_batch
from tests.learners.test_latent_ppo import PPO, make_rollout

PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
LARGER = (Path(__file__).parents[2] / "examples" / "losses" / "overshooting.py").read_text(encoding="utf-8")
CONFIG = {"horizon": 4, "learning_rate": 1e-3, "warmup_updates": 0}


@pytest.fixture
def my_losses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The page's file and its larger example, in the folder that one starts from."""
    (tmp_path / "my_losses.py").write_text("\n\n".join([*BLOCKS, LARGER]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    learner_of(world_model="my_losses:Overshooting")
    yield sys.modules["my_losses"]
    del sys.modules["my_losses"]


def test_a_target_is_learned_beside_others(my_losses):
    learner = learner_of(seed=0, world_model="reconstruction+my_losses:Overshooting", **CONFIG)
    for _ in range(3):
        metrics = learner.update(make_batch())
    assert {"loss_overshooting", "overshooting_kl", "loss_image", "loss_actor"} < metrics.keys()
    assert all(value.isfinite() for value in metrics.values()) and metrics["overshooting_kl"] > 0
    total = sum(value for key, value in metrics.items() if key.startswith("loss_"))
    torch.testing.assert_close(metrics["loss"], total)


def test_the_smallest_target_is_learned(my_losses):
    learner = learner_of(seed=0, world_model="reconstruction+my_losses:LastAction", **CONFIG)
    metrics = learner.update(make_batch())
    assert metrics["loss_last_action"] > 0 and "loss_image" in metrics


def test_the_target_is_what_its_text_says(my_losses):
    """The prior after three blind steps, by hand; nothing is compared across a reset."""
    learner = learner_of(seed=0, world_model="my_losses:Overshooting", free_nats=0.0)
    batch = make_batch(time=16)
    batch["is_init"] = torch.zeros_like(batch["is_init"])
    batch["is_init"][:, 7] = True
    model = learner.agent.world_model
    rssm = model.rssm
    rssm.draw_noise = lambda *shape: torch.full((*shape, rssm.latents, 1), 0.5)
    posterior = model.observe(batch, batch["previous_action"], batch["is_init"].squeeze(-1))
    kl = []
    for start in range(13):
        belief, state = posterior.belief[:, start], posterior.state[:, start]
        for step in (1, 2, 3):
            belief, state = rssm.imagine_step(belief, state, batch["previous_action"][:, start + step])
        target = posterior.posterior_logits[:, start + 3]
        kl.append(kl_losses(target, rssm.prior_logits(belief), 0.0, rssm.unimix)[2])
    counted = [value for start, value in enumerate(kl) if not start < 7 <= start + 3]
    losses, _ = learner.world_model_loss(batch)
    torch.testing.assert_close(losses["overshooting_kl"], torch.stack(counted).mean())
    torch.testing.assert_close(losses["loss_overshooting"], 0.3 * torch.stack(counted).sum() / (13 * 3))
    losses["loss_overshooting"].backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in rssm.prior.parameters())
    assert all(parameter.grad is None for parameter in model.reward_head.parameters())


def test_an_objective_of_the_default_algorithm_is_what_moves_the_actor(my_losses):
    gradients = []
    for actor in ("reinforce", "my_losses:smooth_reinforce"):
        learner = learner_of(seed=0, actor=actor, **CONFIG)
        torch.nn.init.normal_(learner.agent.actor.mlp.output.weight, generator=torch.Generator().manual_seed(0))
        torch.manual_seed(1)
        metrics = learner._backward(make_batch())
        gradients.append([parameter.grad for parameter in learner.agent.actor.parameters()])
    assert metrics["roughness"] > 0
    assert not any(map(torch.equal, *gradients))


def test_an_objective_of_latent_ppo_is_what_moves_the_actor(my_losses):
    """Where nothing is paid, all that is left is to be smooth."""
    rough = []
    for _ in range(2):
        torch.manual_seed(0)
        learner = latent_ppo_of(seed=0, actor="my_losses:smooth_clipped", ppo=PPO, entropy_scale=0.0)
        rollouts = [make_rollout(learner, 3, 4) for _ in range(2)]
        for rollout in rollouts:
            rollout["next", "reward"].zero_()
            learner.collect(rollout)
        rough.append(learner.update_actor()["ppo/roughness"])
    assert rough[0] == rough[1] > 0
    steps = learner.storage.steps
    after = learner.agent.actor(steps["features"]).mean - steps["previous_action"]
    before = steps["behavior"].chunk(2, -1)[0] - steps["previous_action"]
    assert after.square().sum() < before.square().sum()


def test_the_page_names_every_target_and_what_it_adds():
    quoted = set(re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL)))
    for name, targets in TARGETS.items():
        row = re.search(rf"^\| `{name}` \| (.*?) \|", PAGE, re.MULTILINE)
        listed = re.findall(r"`(\w+)`", row[1]) if row else []
        assert listed == [target.__name__ for target in targets], name
        learner = learner_of(interface=Interface(vector_dim=3, privileged_dim=5), world_model=name)
        batch = make_batch()
        batch["vector"] = torch.zeros(*batch.shape, 3)
        batch["privileged", "vector"] = torch.zeros(*batch.shape, 5)
        added = learner.world_model_loss(batch)[0].keys()
        always = {"loss_reward", "loss_continue", "reward_error", "loss_dynamics", "loss_representation", "kl"}
        assert added - always <= quoted, name
