"""Holding the policy where it was while the world model learns: what counts, who learns from it, and that it holds."""

import copy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv

from dreamer_racing.experience.records import records_from_rollout
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.losses import Latents
from dreamer_racing.modules import SIZES
from dreamer_racing.modules.stored_latents import CONTEXT
from tests.dreamers import learner_of
from tests.learners.test_dreamer_v3 import make_batch
from tests.modules.test_policy import NoiseEnv

NO_DRAWS = replace(SIZES["debug"], sampled=False)


def make_learner(**numbers) -> DreamerV3:
    """Of latents that are not drawn, and an actor that tells them apart: a fresh one hardly does."""
    learner = learner_of(NO_DRAWS, seed=0, horizon=3, **numbers)
    nn.init.normal_(learner.agent.actor.mlp.output.weight, generator=torch.Generator().manual_seed(0))
    return learner


def latents_of(learner: DreamerV3, batch: TensorDictBase) -> Latents:
    return Latents(*(value.detach() for value in learner.world_model_loss(batch)[1]))


def stored_by(learner: DreamerV3) -> TensorDict:
    """A batch whose context is what the model makes of it now, of the record before, as a collector stores it."""
    batch = make_batch()
    batch["is_init"][:, 0] = True  # so that windows begin alike with a context and without
    seen = latents_of(learner, batch)
    before = (torch.roll(value, 1, 1) for value in seen)
    batch[CONTEXT] = learner.latent_format.pack(*before)
    return batch


def drift(learner: DreamerV3, batch: TensorDictBase) -> Tensor:
    return learner.compute_losses(batch)["policy_drift"]


def test_latents_that_stayed_are_no_drift():
    learner = make_learner(drift_scale=2.0)
    losses = learner.compute_losses(stored_by(learner))
    assert losses["policy_drift"] < 1e-3  # what float16 leaves
    assert losses["loss_drift"] == 2.0 * losses["policy_drift"]


def test_what_was_just_flown_has_not_drifted():
    """At every record of every window, whether the next one follows it or begins an episode."""
    learner = make_learner(drift_scale=1.0)
    policy = learner.policy()
    env = TransformedEnv(NoiseEnv(), InitTracker())
    env.append_transform(policy.make_primer())
    collector = Collector(env, policy, frames_per_batch=36, total_frames=36)
    records = records_from_rollout(next(iter(collector)), reward_keys=("reward",), latents=learner.latent_format)
    collector.shutdown()
    followed = []
    for stream in range(3):
        own = records[records["stream"] == stream]
        own = own[own["order"].argsort()]
        for start in range(len(own) - 1):
            window = own[start:].unsqueeze(0)
            before, after, same = learner.then_and_now(latents_of(learner, window), window)
            followed.append(same.flatten())
            torch.testing.assert_close(before[same.squeeze(-1)], after[same.squeeze(-1)], atol=2e-3, rtol=0)
    assert torch.cat(followed).any() and not torch.cat(followed).all()
    assert min(map(len, followed)) == 1 and max(map(len, followed)) > 10


def test_the_actor_of_an_update_learns_as_without_it():
    gradients = {}
    for scale in (0.0, 5.0):
        learner = make_learner(drift_scale=scale)
        batch = stored_by(learner)
        torch.manual_seed(0)  # of what is imagined
        learner._backward(batch)
        gradients[scale] = [parameter.grad.clone() for parameter in learner.agent.actor.parameters()]
    assert all(map(torch.equal, gradients[0.0], gradients[5.0])) and any(gradient.any() for gradient in gradients[0.0])


def test_what_an_episode_begins_after_is_not_its_own():
    """The latents that the first record of an episode has stored are not those that its predecessor was seen with."""
    learner = make_learner(drift_scale=1.0)
    batch = stored_by(learner)
    odd = copy.deepcopy(batch)
    odd[CONTEXT, "belief"][0, 3] = 1.0  # make_batch begins an episode there
    assert drift(learner, odd) == drift(learner, batch)
    odd[CONTEXT, "belief"][0, 2] = 1.0
    assert drift(learner, odd) > 10 * drift(learner, batch)


def test_records_without_latents_are_refused():
    with pytest.raises(
        KeyError, match=r"drift_scale=1 .* no 'context': replay with them \(replay.context=true\), or set"
    ):
        make_learner(drift_scale=1.0).update(make_batch())
    assert "loss_drift" not in make_learner().update(make_batch())


@pytest.mark.parametrize("few_kernels", [False, True])
def test_a_policy_that_is_held_moves_less_while_the_model_learns(few_kernels: bool):
    """The actor stands still, so what moves its actions on the same records is the model alone."""
    moved = {}
    for scale in (0.0, 3.0):
        learner = make_learner(drift_scale=scale, learning_rate=3e-3, warmup_updates=0, few_kernels=few_kernels)
        learner.optimizer.param_groups[1]["lr"] = 0.0  # actor and critic
        batch = stored_by(learner)
        actor = learner.agent.actor
        with torch.no_grad():
            before = actor(latents_of(learner, batch).features)
        for _ in range(20):
            learner.update(batch)
        with torch.no_grad():
            moved[scale] = before.divergence(actor(latents_of(learner, batch).features)).mean()
    assert moved[3.0] < 0.2 * moved[0.0]
