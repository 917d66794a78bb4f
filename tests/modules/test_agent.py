"""Policies, and latents that are stored beside what they did."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv

from dreamer_racing.experience.streams import records_from_rollout
from dreamer_racing.modules.agent import Agent, DreamerPolicy
from dreamer_racing.modules.interface import Interface
from dreamer_racing.modules.rssm import CONTEXT, LatentFormat
from dreamer_racing.modules.sizes import SIZES
from tests.dreamers import rssm_of
from tests.experience.test_replay import CountingEnv


class NoiseEnv(CountingEnv):
    """Drones that see noise; drone i crashes every i + 2 steps, so that resets are partial."""

    def __init__(self) -> None:
        super().__init__(3, image_shape=(64, 64, 3))
        self.steps = torch.zeros(3, 1, dtype=torch.int64)

    def _observation(self) -> dict[str, torch.Tensor]:
        return {"pixels": torch.randint(0, 256, (3, 64, 64, 3), dtype=torch.uint8, generator=self.generator)}

    def _reset(self, tensordict: TensorDict | None = None) -> TensorDict:
        self.steps[... if tensordict is None or "_reset" not in tensordict else tensordict["_reset"]] = 0
        return super()._reset(tensordict)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        assert tensordict["action"].abs().max() <= 1
        self.steps += 1
        done = self.steps >= torch.arange(2, 5).unsqueeze(-1)
        return super()._step(tensordict).update({"done": done, "terminated": done, "truncated": torch.zeros_like(done)})


def make_policy(deterministic: bool = False, sampled: bool = True) -> tuple[Agent, DreamerPolicy]:
    torch.manual_seed(0)
    agent = Agent(replace(SIZES["debug"], sampled=sampled), Interface())
    with torch.no_grad():
        agent.actor.mlp.output.weight.mul_(200.0)  # so that actions differ from one another
    return agent, DreamerPolicy(agent.world_model, agent.actor, deterministic)


def make_env(policy: DreamerPolicy) -> TransformedEnv:
    env = TransformedEnv(NoiseEnv(), InitTracker())
    env.append_transform(policy.make_primer())
    return env


def collected(policy: DreamerPolicy) -> TensorDict:
    """A collector's rollout [3, 12]."""
    collector = Collector(make_env(policy), policy, frames_per_batch=36, total_frames=36)
    rollout = next(iter(collector))
    collector.shutdown()
    return rollout


def streams_of(rollout: TensorDict, latents: LatentFormat) -> Iterator[TensorDict]:
    """Records of each environment, in their order, with stored latents."""
    records = records_from_rollout(rollout, reward_keys=("reward",), latents=latents)
    for stream in range(3):
        own = records[records["stream"] == stream]
        yield own[own["order"].argsort()]


def test_collected_latents_equal_those_of_training():
    """Across partial resets, unrolling over what a collector recorded gives the latents that acted."""
    agent, policy = make_policy(deterministic=True)
    data = collected(policy)
    is_init = data["is_init"].squeeze(-1)
    assert data.batch_size == (3, 12)
    assert is_init.sum(-1).tolist() == [6, 4, 3]
    posterior = agent.world_model.observe(data, data["previous_action"], is_init, deterministic=True)
    torch.testing.assert_close(posterior.belief, data["next", "belief"])
    torch.testing.assert_close(posterior.state, data["next", "state"])
    follows = ~is_init[:, 1:]
    assert torch.equal(data["previous_action"][:, 1:][follows], data["action"][:, :-1][follows])
    assert data["action"].std() > 0.01


@pytest.mark.parametrize("sampled", [True, False])
def test_stored_context_lets_a_window_go_on_from_where_acting_was(sampled):
    """At every record of a window: also where an episode ends inside it, and at the first record of all."""
    agent, policy = make_policy(deterministic=True, sampled=sampled)
    rssm = agent.world_model.rssm
    for own in streams_of(collected(policy), rssm.latent_format):
        acted = agent.world_model.observe(
            own.unsqueeze(0), own["previous_action"][None], own["is_init"].squeeze(-1)[None], deterministic=True
        )
        for start in range(len(own)):
            window = own[start:].unsqueeze(0)
            seen = rssm.observe(
                agent.world_model.encoder(window),
                window["previous_action"],
                window["is_init"].squeeze(-1),
                initial=rssm.latent_format.unpack(window[CONTEXT][:, 0]),
                deterministic=True,
            )
            torch.testing.assert_close(seen.belief, acted.belief[:, start:], atol=2e-3, rtol=0)


def test_the_policy_samples_without_gradient_unless_it_is_deterministic():
    _, policy = make_policy()
    data = make_env(policy).rollout(5, policy, auto_reset=True, break_when_any_done=False)
    assert data["action"].shape == (3, 5, 4)
    assert not data["action"].requires_grad and not data["next", "belief"].requires_grad
    root = make_env(policy).reset()
    assert not torch.equal(policy(root.clone())["action"], policy(root.clone())["action"])
    policy.deterministic = True
    assert torch.equal(policy(root.clone())["action"], policy(root.clone())["action"])


@pytest.mark.parametrize("batch", [[], [4], [2, 3]])
def test_policy_takes_any_batch_size(batch):
    _, policy = make_policy()
    size = SIZES["debug"]
    tensordict = TensorDict(
        {
            "pixels": torch.zeros(*batch, 64, 64, 3, dtype=torch.uint8),
            "is_init": torch.ones(*batch, 1, dtype=torch.bool),
            "belief": torch.zeros(*batch, size.belief),
            "state": torch.zeros(*batch, size.state),
            "previous_action": torch.zeros(*batch, 4),
        },
        batch,
    )
    out = policy(tensordict)
    assert out["action"].shape == (*batch, 4)
    assert out["next", "state"].shape == (*batch, size.state)


# Latents that a replay keeps come back as they were.


@pytest.mark.parametrize(("sampled", "large"), [(True, 512 + 16), (False, 512 + 512)])
def test_latents_survive_packing_in_the_bytes_that_are_told(sampled, large):
    rssm = rssm_of(sampled=sampled)
    posterior = rssm.observe(torch.randn(2, 5, 8), torch.randn(2, 5, 4), torch.zeros(2, 5, dtype=torch.bool))
    packed = rssm.latent_format.pack(posterior.belief, posterior.state)
    belief, state = rssm.latent_format.unpack(packed)
    torch.testing.assert_close(belief, posterior.belief, atol=5e-4, rtol=0)
    torch.testing.assert_close(state, posterior.state, atol=0 if sampled else 5e-4, rtol=0)
    stored = sum(value.element_size() * value[0, 0].numel() for value in packed.values())
    assert stored == rssm.latent_format.bytes
    assert LatentFormat(belief=256, latents=16, classes=16, sampled=sampled).bytes == large, "by hand"


def test_probabilities_draw_nothing_and_sum_to_one():
    rssm = rssm_of(sampled=False)
    belief, state = torch.randn(6, 16), torch.rand(6, 12)
    torch.manual_seed(1)
    first = rssm.imagine_step(belief, state, torch.zeros(6, 4))
    second = rssm.imagine_step(belief, state, torch.zeros(6, 4), deterministic=True)
    torch.testing.assert_close(first[1], second[1], atol=0, rtol=0)
    torch.testing.assert_close(first[1].unflatten(-1, (3, 4)).sum(-1), torch.ones(6, 3))
