"""Numbers in place of images: encoder, decoder, and an agent that sees them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.modules import (
    SIZES,
    DreamerPolicy,
    ImageEncoder,
    Interface,
    ObservationEncoder,
    VectorDecoder,
    VectorEncoder,
)
from dreamer_racing.modules.agent import Agent

SIZE = SIZES["debug"]
VECTOR_DIM = 7
SIGHTS = {
    "vector": Interface(pixels=False, vector_dim=VECTOR_DIM),
    "both": Interface(vector_dim=VECTOR_DIM),
}


@pytest.mark.parametrize("norm", ["rms", "layer"])
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_vector_encoder_and_decoder_shapes(norm, layers, batch):
    encoder = VectorEncoder(VECTOR_DIM, layers, units=16, norm=norm)
    assert len(encoder.hidden) == layers
    embedding = encoder(torch.randn(*batch, VECTOR_DIM))
    assert embedding.shape == (*batch, encoder.embedding_size) == (*batch, 16)
    decoder = VectorDecoder(16, VECTOR_DIM, layers, units=8, norm=norm)
    assert decoder(embedding).shape == (*batch, VECTOR_DIM)
    assert decoder.squared_error(embedding, torch.zeros(*batch, VECTOR_DIM)).shape == ()


def test_vector_encoder_sees_symlogs():
    encoder = VectorEncoder(3, layers=1, units=4)
    seen = []
    encoder.hidden.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    encoder(torch.tensor([[0.0, math.e - 1, -(math.e**5 - 1)]]))
    torch.testing.assert_close(seen[0], torch.tensor([[0.0, 1.0, -5.0]]))


def test_vector_decoder_gives_the_numbers_whose_symlogs_it_was_trained_on():
    """Numbers of very different size are fitted alike, and come back in their own unit."""
    torch.manual_seed(0)
    decoder = VectorDecoder(4, 3, layers=1, units=16)
    features, target = torch.randn(1, 4), torch.tensor([[0.5, -30.0, 1000.0]])
    optimizer = torch.optim.Adam(decoder.parameters(), lr=3e-2)
    for _ in range(300):
        optimizer.zero_grad()
        error = decoder.squared_error(features, target)
        error.backward()
        optimizer.step()
    assert error.item() < 1e-3
    torch.testing.assert_close(decoder(features), target, rtol=0.05, atol=0.05)


def test_squared_error_by_hand():
    decoder = VectorDecoder(4, 2, layers=1, units=8)
    with torch.no_grad():
        decoder.mlp.output.weight.zero_()
        decoder.mlp.output.bias.copy_(torch.tensor([1.0, -2.0]))
    vector = torch.tensor([[math.e - 1, 0.0], [0.0, 0.0]])
    # ((1 − 1)² + 2²) and (1² + 2²), averaged.
    torch.testing.assert_close(decoder.squared_error(torch.randn(2, 4), vector), torch.tensor(4.5))
    torch.testing.assert_close(decoder(torch.randn(4)), torch.tensor([math.e - 1, 1 - math.e**2]))


@pytest.mark.parametrize("sight", SIGHTS)
def test_observation_encoder_puts_embeddings_side_by_side(sight):
    interface = SIGHTS[sight]
    encoder = ObservationEncoder(SIZE, interface)
    assert encoder.keys == interface.observation_keys
    assert list(encoder.encoders) == encoder.keys
    seen = {
        "pixels": torch.randint(0, 256, (2, 3, 64, 64, 3), dtype=torch.uint8),
        "vector": torch.randn(2, 3, VECTOR_DIM),
        "reward": torch.randn(2, 3, 1),
    }
    embedding = encoder(seen)
    assert embedding.shape == (2, 3, encoder.embedding_size)
    parts = [encoder.encoders[key](seen[key]) for key in encoder.keys]
    assert torch.equal(embedding, torch.cat(parts, -1))
    assert isinstance(encoder.encoders["vector"], VectorEncoder)
    if sight == "both":
        assert isinstance(encoder.encoders["pixels"], ImageEncoder)
        widths = [part.embedding_size for part in encoder.encoders.values()]
        assert encoder.embedding_size == sum(widths) and min(widths) > 0


def test_observation_encoder_takes_its_widths_from_the_size():
    size = replace(SIZE, name="wider", vector_layers=4, units=24)
    encoder = ObservationEncoder(size, SIGHTS["vector"]).encoders["vector"]
    assert len(encoder.hidden) == 4
    assert encoder.embedding_size == 24


def make_history(sight: str, batch: int = 2, time: int = 8) -> TensorDict:
    """What two drones saw and did, one of which crashed twice."""
    torch.manual_seed(1)
    is_init = torch.zeros(batch, time, 1, dtype=torch.bool)
    is_init[:, 0] = is_init[1, 3] = is_init[1, 4] = True
    seen = {"vector": torch.randn(batch, time, VECTOR_DIM) * 3}
    if sight == "both":
        seen["pixels"] = torch.randint(0, 256, (batch, time, 64, 64, 3), dtype=torch.uint8)
    return TensorDict({**seen, "is_init": is_init}, [batch, time])


@pytest.mark.parametrize("recurrence", ["dense", "block", "ssm"])
@pytest.mark.parametrize("sight", SIGHTS)
def test_acting_and_training_give_the_same_latents(sight, recurrence, monkeypatch):
    """Sampled actions and states, carried by the policy's own keys from step to step, with resets in the middle."""
    torch.manual_seed(0)
    size = replace(SIZE, name="variant", recurrence=recurrence, blocks=2, learned_initial=True)
    agent, history = Agent(size, SIGHTS[sight]), make_history(sight)
    rssm = agent.world_model.rssm
    with torch.no_grad():
        rssm.initial_belief.normal_()
        agent.actor.mlp.output.weight.mul_(100.0)
    noise = torch.rand(8, 2, rssm.latents, 1)
    policy = DreamerPolicy(agent.world_model, agent.actor)
    carried = {"belief": torch.randn(2, 32), "state": torch.randn(2, 16), "previous_action": torch.randn(2, 4)}
    acted = []
    for step in range(8):
        monkeypatch.setattr(rssm, "draw_noise", lambda *batch, step=step: noise[step])
        root = policy(history[:, step].clone().update(carried))
        carried = {key: root["next", key] for key in carried}
        acted.append(root)
    acted = torch.stack(acted, 1)

    monkeypatch.setattr(rssm, "draw_noise", lambda *batch: noise)
    # As a replay stores it: the action that led to each observation, zero at a first one.
    previous_action = torch.cat((torch.zeros(2, 1, 4), acted["action"][:, :-1]), 1)
    previous_action = previous_action.masked_fill(history["is_init"], 0.0)
    posterior = agent.world_model.observe(history, previous_action, history["is_init"].squeeze(-1))
    torch.testing.assert_close(posterior.belief, acted["next", "belief"])
    torch.testing.assert_close(posterior.state, acted["next", "state"])
    assert acted["action"].std() > 0.1


def test_policy_of_an_agent_that_sees_numbers_asks_for_no_images():
    agent = Agent(SIZE, SIGHTS["vector"])
    policy = DreamerPolicy(agent.world_model, agent.actor)
    assert policy.in_keys == ["vector", "is_init", "belief", "state", "previous_action"]
