"""The losses that docs/losses.md writes, run as a reader would run them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from dreamer_racing.learners.dreamer import make_dreamer
from dreamer_racing.losses import (
    ACTOR_LOSSES,
    CRITIC_LOSSES,
    WORLD_MODEL_LOSSES,
    ActorLoss,
    LossConfig,
    find_loss,
    kl_losses,
)
from dreamer_racing.losses.contract import set_number
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of

PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
REGISTRIES = (WORLD_MODEL_LOSSES, ACTOR_LOSSES, CRITIC_LOSSES)


@pytest.fixture
def example() -> Iterator[dict[str, Any]]:
    """Names that the page's code leaves behind; what it registers is taken back after the test."""
    before = [dict(registry) for registry in REGISTRIES]
    torch.manual_seed(0)
    names: dict[str, Any] = {"__name__": "example"}
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"docs/losses.md, block {number}", "exec"), names)
    yield names
    for registry, entries in zip(REGISTRIES, before, strict=True):
        registry.clear()
        registry.update(entries)


def test_metrics_of_the_custom_loss_are_among_those_of_the_update(example):
    metrics = example["metrics"]
    assert {"loss_overshooting", "overshooting_kl", "loss_image", "loss_actor"} < metrics.keys()
    assert all(value.isfinite() for value in metrics.values())
    assert metrics["overshooting_kl"] > 0
    assert example["learner"].updates == 5
    total = sum(value for key, value in metrics.items() if key.startswith("loss_"))
    torch.testing.assert_close(metrics["loss"], total)


def test_custom_loss_is_what_its_text_says(example):
    """The prior after three blind steps, by hand; nothing is compared across a reset."""
    loss, batch = example["learner"].losses["world_model"], example["batch"].clone()
    batch["is_init"] = batch["is_init"].clone()
    batch["is_init"][:, 7] = True
    rssm = loss.world_model.rssm
    rssm.draw_noise = lambda *shape: torch.full((*shape, rssm.latents, 1), 0.5)
    loss.free_nats = 0.0
    posterior = loss.world_model.observe(batch, batch["previous_action"], batch["is_init"].squeeze(-1))
    kl = []
    for start in range(13):
        belief, state = posterior.belief[:, start], posterior.state[:, start]
        for step in (1, 2, 3):
            belief, state = rssm.imagine_step(belief, state, batch["previous_action"][:, start + step])
        target = posterior.posterior_logits[:, start + 3]
        kl.append(kl_losses(target, rssm.prior_logits(belief), 0.0, rssm.unimix)[2])
    counted = [value for start, value in enumerate(kl) if not start < 7 <= start + 3]
    losses = loss(batch)
    torch.testing.assert_close(losses["overshooting_kl"], torch.stack(counted).mean())
    torch.testing.assert_close(losses["loss_overshooting"], 0.3 * torch.stack(counted).sum() / (13 * 4))


def test_custom_loss_trains_the_prior_and_not_the_heads(example):
    world_model = example["learner"].agent.world_model
    example["learner"].losses["world_model"](example["batch"])["loss_overshooting"].backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in world_model.rssm.prior.parameters())
    assert all(parameter.grad is None for parameter in world_model.decoder.parameters())


def test_custom_actor_updates_and_reports(example):
    config = {"actor": "cautious", "horizon": 5}
    metrics = learner_of(seed=0, **config).update(example["batch"])
    assert metrics["loss_actor"].isfinite()
    torch.testing.assert_close(metrics["danger"], 1 - metrics["continuation"])


def test_the_number_of_a_custom_actor_comes_from_the_configuration_and_moves(example):
    @dataclasses.dataclass
    class PricedConfig(LossConfig):
        price: float = 2.5

    ACTOR_LOSSES["priced"] = example["PricedActorLoss"]  # the fixture takes it back
    learner = make_dreamer("debug", losses=PricedConfig(actor="priced"), horizon=5, seed=0)
    actor = learner.losses["actor"]
    assert (actor.horizon, float(actor.price)) == (5, 2.5)
    assert learner.update(example["batch"])["loss_actor"].isfinite()
    set_number(learner.losses.values(), "price", 1.5, captured=True)
    assert float(actor.price) == 1.5


def test_a_plain_number_that_a_graph_would_not_read_again_is_refused():
    losses = make_dreamer("debug", seed=0).losses.values()
    set_number(losses, "lambda_", 0.9)
    with pytest.raises(ValueError, match=r"adjust\(lambda_=...\): \w+ has it as a plain number.*scheduled"):
        set_number(losses, "lambda_", 0.8, captured=True)


def test_page_names_every_loss_and_key():
    quoted = set(re.findall(r"`([^`]+)`", PAGE))
    for registry in REGISTRIES:
        for name, loss in registry.items():
            assert re.search(rf"^\| `{name}` \| `{loss.__name__}` \|", PAGE, re.MULTILINE), name
    interface = Interface(vector_dim=3, privileged_dim=5)
    for name in WORLD_MODEL_LOSSES:
        learner = learner_of("debug", interface, world_model=name)
        for loss in learner.losses.values():
            for key in (*loss.in_keys, *loss.out_keys):
                assert str(key).replace("'", '"') in quoted or key in quoted, (name, key)


def test_a_loss_is_found_in_a_module_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "my_losses.py").write_text("from dreamer_racing.losses import ReinforceLoss as MyLoss\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_loss(ActorLoss, "my_losses:MyLoss") is ACTOR_LOSSES["reinforce"]
    with pytest.raises(ValueError, match="'my_losses:Other', given as module:Class, cannot be imported"):
        find_loss(ActorLoss, "my_losses:Other")
    with pytest.raises(ValueError, match=r"Unknown loss 'mine'. Known here: reinforce, dynamics"):
        find_loss(ActorLoss, "mine")
    (tmp_path / "my_critics.py").write_text("from dreamer_racing.losses import CriticLoss as Mine\nThis = 3\n")
    for name in ("my_critics:Mine", "my_critics:This"):
        with pytest.raises(ValueError, match=f"Loss '{name}' is no ActorLoss: subclass that"):
            find_loss(ActorLoss, name)
