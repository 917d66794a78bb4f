"""Latents that a replay keeps come back as they were."""

import pytest
import torch

from dreamer_racing.modules.parallel_rssm import ParallelRSSM
from dreamer_racing.modules.rssm import RSSM
from dreamer_racing.modules.stored_latents import LatentFormat


def make_rssm(sampled: bool, kind: type[RSSM] = RSSM) -> RSSM:
    torch.manual_seed(0)
    return kind(embedding=8, action=4, belief=16, latents=3, classes=4, hidden=8, sampled=sampled)


@pytest.mark.parametrize("kind", [RSSM, ParallelRSSM])
@pytest.mark.parametrize("sampled", [True, False])
def test_latents_survive_packing(sampled, kind):
    rssm = make_rssm(sampled, kind)
    posterior = rssm.observe(torch.randn(2, 5, 8), torch.randn(2, 5, 4), torch.zeros(2, 5, dtype=torch.bool))
    packed = rssm.latent_format.pack(posterior.belief, posterior.state)
    belief, state = rssm.latent_format.unpack(packed)
    torch.testing.assert_close(belief, posterior.belief, atol=5e-4, rtol=0)
    torch.testing.assert_close(state, posterior.state, atol=0 if sampled else 5e-4, rtol=0)
    stored = sum(value.element_size() * value[0, 0].numel() for value in packed.values())
    assert stored == rssm.latent_format.bytes


def test_bytes_of_a_record_by_hand():
    assert LatentFormat(belief=256, latents=16, classes=16).bytes == 512 + 16
    assert LatentFormat(belief=256, latents=16, classes=16, sampled=False).bytes == 512 + 512


def test_probabilities_draw_nothing_and_sum_to_one():
    rssm = make_rssm(sampled=False)
    belief, state = torch.randn(6, 16), torch.rand(6, 12)
    torch.manual_seed(1)
    first = rssm.imagine_step(belief, state, torch.zeros(6, 4))
    second = rssm.imagine_step(belief, state, torch.zeros(6, 4), deterministic=True)
    torch.testing.assert_close(first[1], second[1], atol=0, rtol=0)
    torch.testing.assert_close(first[1].unflatten(-1, (3, 4)).sum(-1), torch.ones(6, 3))


@pytest.mark.parametrize("kind", [RSSM, ParallelRSSM])
@pytest.mark.parametrize("sampled", [True, False])
def test_a_window_that_goes_on_from_stored_latents_is_the_one_that_never_stopped(sampled, kind):
    rssm = make_rssm(sampled, kind)
    embedding, action = torch.randn(3, 9, 8), torch.randn(3, 9, 4)
    is_init = torch.zeros(3, 9, dtype=torch.bool)
    is_init[1, 6] = True
    whole = rssm.observe(embedding, action, is_init, deterministic=True)
    packed = rssm.latent_format.pack(whole.belief, whole.state)
    resumed = rssm.observe(
        embedding[:, 4:],
        action[:, 4:],
        is_init[:, 4:],
        initial=rssm.latent_format.unpack(packed[:, 3]),
        deterministic=True,
    )
    torch.testing.assert_close(resumed.belief, whole.belief[:, 4:], atol=1e-3, rtol=0)
    cold = rssm.observe(embedding[:, 4:], action[:, 4:], is_init[:, 4:], deterministic=True)
    assert (cold.belief - whole.belief[:, 4:]).abs().max() > 0.01  # so that the comparison above says something
