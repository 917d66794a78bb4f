"""Losses of the world model, and one's own."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.dreamer_v3 import categorical_kl_terms

from dreamer_racing.experience.replay import make_replay
from dreamer_racing.losses import TARGETS, LossConfig, WorldModelLoss, kl_losses, open_loop_loss
from dreamer_racing.modules import SIZES, Agent, Interface
from dreamer_racing.modules.rssm import CONTEXT
from tests.dreamers import latent_ppo_of, learner_of, make_windows
from tests.experience.test_replay import CountingEnv, collect
from tests.learners.test_dreamer_v3 import CONFIG, make_batch
from tests.learners.test_latent_ppo import PPO, make_rollout
from tests.losses.test_targets import ADDED


def make_records(image_size: int = 64) -> TensorDict:
    return make_windows(2, 4, is_init=[(0, 2)], terminated=[(0, 1)], image_size=image_size)


def test_kl_with_unimix_by_hand():
    posterior, prior = torch.tensor([[[math.log(3.0), 0.0]]]), torch.zeros(1, 1, 2)
    first, second = 0.99 * 0.75 + 0.005, 0.99 * 0.25 + 0.005
    expected = first * math.log(first / 0.5) + second * math.log(second / 0.5)
    _, _, kl = kl_losses(posterior, prior, free_nats=0.0, unimix=0.01)
    torch.testing.assert_close(kl, torch.tensor([expected]))


def test_kl_agrees_with_torchrl():
    torch.manual_seed(0)
    ours = [torch.randn(2, 3, 4, 8, requires_grad=True) for _ in range(2)]
    theirs = [value.detach().clone().requires_grad_() for value in ours]
    dynamics, representation, _ = kl_losses(*ours, free_nats=1.0, unimix=0.01)
    expected = categorical_kl_terms(*theirs, free_nats=1.0, unimix=0.01)
    torch.testing.assert_close((dynamics.mean(), representation.mean()), expected)
    (dynamics.mean() + 0.1 * representation.mean()).backward()
    (expected[0] + 0.1 * expected[1]).backward()
    for our, their in zip(ours, theirs, strict=True):
        torch.testing.assert_close(our.grad, their.grad)


def test_free_nats_bound_the_sum_over_latents():
    """Eight latents of 0.3 nats each are 2.4 nats: above the threshold, though each is below it."""
    prior = torch.zeros(1, 8, 2, requires_grad=True)
    posterior = torch.tensor([1.8, 0.0]).expand(1, 8, 2)
    dynamics, _, kl = kl_losses(posterior, prior, free_nats=1.0, unimix=0.0)
    assert kl.item() / 8 < 1 < kl.item()
    torch.testing.assert_close(dynamics, kl)
    dynamics.sum().backward()
    assert prior.grad.abs().sum() > 0
    close = torch.zeros(1, 8, 2, requires_grad=True)
    clamped, _, _ = kl_losses(posterior * 0.1, close, free_nats=1.0, unimix=0.0)
    assert clamped.item() == 1.0
    clamped.sum().backward()
    assert close.grad.abs().sum() == 0


@pytest.mark.parametrize("image_size", [32, 64, 96])
def test_losses_of_a_new_model(image_size):
    batch = make_records(image_size)
    loss = WorldModelLoss(Agent(SIZES["debug"], Interface(image_size=image_size)), LossConfig())
    losses, latents = loss(batch)
    # Uniform over 255 bins, whatever the reward.
    assert losses["loss_reward"].item() == pytest.approx(math.log(255), rel=1e-5)
    torch.testing.assert_close(losses["loss_image"], losses["image_error"] * image_size**2 * 3)
    torch.testing.assert_close(losses["reward_error"], batch["reward"].abs().mean())
    assert latents.belief.shape[:2] == (2, 4) and latents.belief.requires_grad
    losses["loss_image"].backward()
    for network in (loss.world_model.encoder, loss.world_model.decoder):
        assert all(parameter.grad.abs().sum() > 0 for parameter in network.parameters())


def agent_that_goes_on() -> Agent:
    """An agent whose model says everywhere that the episode goes on with a probability of 0.75."""
    agent = Agent(SIZES["debug"], Interface())
    output = agent.world_model.continue_head.mlp.output
    with torch.no_grad():
        output.weight.zero_()
        output.bias.fill_(math.log(3.0))
    return agent


def test_continue_target_is_one_minus_terminated():
    agent = agent_that_goes_on()
    batch = make_records()
    batch["truncated"][1, 1] = True
    loss = WorldModelLoss(agent, LossConfig())(batch)[0]["loss_continue"]
    expected = -(7 * math.log(0.75) + 1 * math.log(0.25)) / 8
    assert loss.item() == pytest.approx(expected, rel=1e-5)


def test_rewards_and_ends_ahead_are_learned_within_an_episode():
    agent, batch = agent_that_goes_on(), make_records()  # an episode begins at the first window's third record
    latents = WorldModelLoss(agent, LossConfig())(batch)[1]
    loss = open_loop_loss(agent.world_model, latents, batch, steps=2)
    within = 1 + 4  # from the first window the end of its first episode, from both starts of the second both steps
    expected = math.log(255) - (4 * math.log(0.75) + 1 * math.log(0.25)) / within
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match=r"open_loop_steps=4 must be less than the 4 records of a window"):
        open_loop_loss(agent.world_model, latents, batch, steps=4)


def test_dynamics_learn_from_rewards_ahead():
    agent, batch = Agent(SIZES["debug"], Interface()), make_records()
    with torch.no_grad():
        agent.world_model.reward_head.mlp.output.weight.normal_()  # zero at first, which hides what lies below
    latents = WorldModelLoss(agent, LossConfig())(batch)[1]
    open_loop_loss(agent.world_model, latents, batch, steps=3).backward()
    for network in (agent.world_model.rssm.prior, agent.world_model.rssm.cell, agent.world_model.encoder):
        assert any(parameter.grad.abs().sum() > 0 for parameter in network.parameters())


def test_a_refreshed_context_is_what_the_next_window_begins_with():
    """From the learner's update through the replay into the next sample."""
    learner = learner_of(seed=0, imagination_starts=4, **CONFIG)
    rollout = collect(CountingEnv(2, end=0.0, image_shape=(64, 64, 3)), steps=9, batches=1)[0]
    rollout["next", "belief"], rollout["next", "state"] = torch.zeros(2, 9, 32), torch.zeros(2, 9, 16)
    replay = make_replay(20, 2, 1, 10, latents=learner.latent_format)
    replay.extend(rollout)
    batch = replay.sample()
    learner.update(batch)
    replay.refresh(batch["index"], learner.latents["belief"], learner.latents["state"])
    again = replay.records(int(batch["index"][0, 0]) // 10)[CONTEXT]
    belief, state = learner.latent_format.unpack(again)
    torch.testing.assert_close(belief[1:], learner.latents["belief"][0, :-1], atol=5e-4, rtol=0)
    assert torch.equal(state[1:], learner.latents["state"][0, :-1].round())


# The losses that docs/losses.md writes, run as a reader would run them.


PAGE = (Path(__file__).parents[2] / "docs" / "losses.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
LARGER = (Path(__file__).parents[2] / "examples" / "losses" / "overshooting.py").read_text(encoding="utf-8")


@pytest.fixture
def my_losses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The page's file and its larger example, in the folder that one starts from."""
    (tmp_path / "my_losses.py").write_text("\n\n".join([*BLOCKS, LARGER]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    learner_of(world_model="my_losses:Overshooting")
    yield sys.modules["my_losses"]
    del sys.modules["my_losses"]


@pytest.mark.usefixtures("my_losses")
def test_a_target_is_learned_beside_others():
    learner = learner_of(seed=0, world_model="reconstruction+my_losses:Overshooting", **CONFIG)
    for _ in range(3):
        metrics = learner.update(make_batch())
    assert {"loss_overshooting", "overshooting_kl", "loss_image", "loss_actor"} < metrics.keys()
    assert all(value.isfinite() for value in metrics.values()) and metrics["overshooting_kl"] > 0
    total = sum(value for key, value in metrics.items() if key.startswith("loss_"))
    torch.testing.assert_close(metrics["loss"], total)


@pytest.mark.usefixtures("my_losses")
def test_the_smallest_target_is_learned():
    metrics = learner_of(seed=0, world_model="reconstruction+my_losses:LastAction", **CONFIG).update(make_batch())
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


@pytest.mark.parametrize(
    ("built_in", "own", "metric"),
    [("dynamics", "smooth_dynamics", "roughness"), ("reinforce", "weighted_regression", "entropy")],
)
def test_an_objective_of_ones_own_is_what_moves_the_actor_of_dreamer_v3(my_losses, built_in, own, metric):
    gradients = []
    for actor in (built_in, f"my_losses:{own}"):
        learner = learner_of(seed=0, actor=actor, **CONFIG)
        torch.nn.init.normal_(learner.agent.actor.mlp.output.weight, generator=torch.Generator().manual_seed(0))
        torch.manual_seed(1)
        metrics = learner._backward(make_batch())
        gradients.append([parameter.grad for parameter in learner.agent.actor.parameters()])
    assert metrics[metric] > 0
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
    assert "loss_vector" in quoted
    for name, targets in TARGETS.items():
        row = re.search(rf"^\| `{name}` \| (.*?) \|", PAGE, re.MULTILINE)
        listed = re.findall(r"`(\w+)`", row[1]) if row else []
        assert listed == [target.__name__ for target in targets], name
        assert ADDED[name] <= quoted, name
