"""What networks take and give, and how large they are."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.modules import (
    SIZES,
    DreamerPolicy,
    ImageEncoder,
    Interface,
    ObservationEncoder,
    VectorDecoder,
    VectorEncoder,
    WorldModel,
    get_size,
)
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.interface import IMU, PIXELS, PRIVILEGED
from tests.dreamers import make_windows


class SpecEnv(EnvBase):
    """Nothing but specs."""

    def __init__(self, num_envs: int, action_dim: int, **observation) -> None:
        super().__init__(batch_size=[num_envs])
        self.observation_spec = Composite(observation, shape=[num_envs])
        self.action_spec = Bounded(-1, 1, (num_envs, action_dim))
        self.reward_spec = Unbounded((num_envs, 1))

    def _reset(self, tensordict: TensorDict | None = None) -> TensorDict: ...

    def _step(self, tensordict: TensorDict) -> TensorDict: ...

    def _set_seed(self, seed: int | None) -> None: ...


def images(num_envs: int, height: int = 64, width: int = 64) -> Bounded:
    return Bounded(0, 255, (num_envs, height, width, 3), dtype=torch.uint8)


def privileged_of(num_envs: int, **widths: int) -> Composite:
    return Composite({key: Unbounded((num_envs, width)) for key, width in widths.items()}, shape=[num_envs])


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(
    ("make_observation", "expected", "keys"),
    [
        (lambda n: {"pixels": images(n)}, Interface(action_dim=2), ["pixels"]),
        (lambda n: {"pixels": images(n, 96, 96)}, Interface(action_dim=2, image_size=96), ["pixels"]),
        (
            lambda n: {"pixels": images(n), "vector": Unbounded((n, 5)), "privileged": privileged_of(n, vector=9, x=3)},
            Interface(action_dim=2, vector_dim=5, privileged_dim=9),
            ["pixels", "vector", PRIVILEGED],
        ),
        # Privileged entries other than the vector do not count.
        (lambda n: {"pixels": images(n), "privileged": privileged_of(n, x=3)}, Interface(action_dim=2), ["pixels"]),
        (lambda n: {"vector": Unbounded((n, 5))}, Interface(action_dim=2, pixels=False, vector_dim=5), ["vector"]),
        (
            lambda n: {"vector": Unbounded((n, 5)), "privileged": privileged_of(n, vector=9)},
            Interface(action_dim=2, pixels=False, vector_dim=5, privileged_dim=9),
            ["vector", PRIVILEGED],
        ),
    ],
    ids=["pixels", "large", "all", "other", "vector", "vector and privileged"],
)
def test_interface_of_any_environment(make_observation, expected, keys, num_envs):
    """The last dimension counts, whatever the number of environments; the encoder never reads what is privileged."""
    env = SpecEnv(num_envs, 2, **make_observation(num_envs))
    assert Interface.of(env) == Interface.of(TransformedEnv(env, InitTracker())) == expected
    assert expected.image_shape == (expected.image_size, expected.image_size, 3)
    assert expected.observation_keys == [key for key in keys if key != PRIVILEGED]
    assert expected.replay_keys == keys


def test_an_agent_that_sees_nothing_or_no_squares_is_refused():
    with pytest.raises(ValueError, match="neither 'pixels' nor 'vector'"):
        Interface.of(SpecEnv(3, 4, sound=Unbounded((3, 5))))
    with pytest.raises(ValueError, match="sees nothing"):
        Interface(pixels=False)
    with pytest.raises(ValueError, match="48 × 32 pixels: agents need square images"):
        Interface.of(SpecEnv(3, 4, pixels=images(3, 48, 32)))


@pytest.mark.parametrize("from_pixels", [False, True])
@pytest.mark.parametrize("privileged", [False, True])
def test_interface_of_the_race(from_pixels, privileged):
    env = DroneRacingEnv(track="circle", num_envs=2, seed=0, from_pixels=from_pixels, privileged=privileged)
    interface, reset = Interface.of(env), env.reset()
    env.close()
    assert interface == Interface(
        action_dim=4,
        pixels=from_pixels,
        vector_dim=0 if from_pixels else reset["vector"].shape[-1],
        privileged_dim=reset[PRIVILEGED].shape[-1] if privileged else 0,
    )
    seen = PIXELS if from_pixels else "vector"
    assert interface.replay_keys == ([seen, PRIVILEGED] if privileged else [seen])
    assert all(reset[key].shape[0] == 2 for key in interface.replay_keys)


def test_interface_of_a_race_with_an_imu():
    env = DroneRacingEnv("circle", 1, imu="exact", camera=Camera(32, 32), privileged=True)
    interface = Interface.of(env)
    env.close()
    assert (interface.vector_key, interface.vector_dim, interface.image_size) == (IMU, 6, 32)
    assert interface.replay_keys == [PIXELS, IMU, PRIVILEGED]


# Numbers in place of images: encoder, decoder, and an agent that sees them.


SIZE = SIZES["debug"]
VECTOR_DIM = 7
SIGHTS = {"vector": Interface(pixels=False, vector_dim=VECTOR_DIM), "both": Interface(vector_dim=VECTOR_DIM)}


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
    encoder = ObservationEncoder(replace(SIZE, name="wider", vector_layers=4, units=24), SIGHTS[sight])
    assert encoder.keys == list(encoder.encoders) == SIGHTS[sight].observation_keys
    seen = {
        "pixels": torch.randint(0, 256, (2, 3, 64, 64, 3), dtype=torch.uint8),
        "vector": torch.randn(2, 3, VECTOR_DIM),
        "reward": torch.randn(2, 3, 1),
    }
    embedding = encoder(seen)
    assert embedding.shape == (2, 3, encoder.embedding_size)
    assert torch.equal(embedding, torch.cat([encoder.encoders[key](seen[key]) for key in encoder.keys], -1))
    of_numbers = encoder.encoders["vector"]
    assert isinstance(of_numbers, VectorEncoder)
    assert (len(of_numbers.hidden), of_numbers.embedding_size) == (4, 24), "as the size says"
    if sight == "both":
        assert isinstance(encoder.encoders["pixels"], ImageEncoder)
        assert encoder.embedding_size == 24 + encoder.encoders["pixels"].embedding_size > 24


@pytest.mark.parametrize("recurrence", ["dense", "block"])
@pytest.mark.parametrize("sight", SIGHTS)
def test_acting_and_training_give_the_same_latents(sight, recurrence, monkeypatch):
    """Sampled actions and states, carried by the policy's own keys from step to step, with resets in the middle."""
    torch.manual_seed(0)
    size = replace(SIZE, name="variant", recurrence=recurrence, blocks=2, learned_initial=True)
    agent = Agent(size, SIGHTS[sight])
    rssm = agent.world_model.rssm
    history = make_windows(2, 8, is_init=[(0, 0), (1, 0), (1, 3), (1, 4)], vector=VECTOR_DIM)
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
    previous_action = acted["action"].roll(1, 1).masked_fill(history["is_init"], 0.0)
    posterior = agent.world_model.observe(history, previous_action, history["is_init"].squeeze(-1))
    torch.testing.assert_close(posterior.belief, acted["next", "belief"])
    torch.testing.assert_close(posterior.state, acted["next", "state"])
    assert acted["action"].std() > 0.1


def test_policy_of_an_agent_that_sees_numbers_asks_for_no_images():
    agent = Agent(SIZE, SIGHTS["vector"])
    keys = DreamerPolicy(agent.world_model, agent.actor).in_keys
    assert keys == ["vector", "is_init", "belief", "state", "previous_action"]


def test_the_world_model_reads_both_and_decodes_both() -> None:
    torch.manual_seed(0)
    model = WorldModel(get_size("debug"), Interface(image_size=32, vector_dim=6, vector_key=IMU))
    assert model.encoder.keys == [PIXELS, IMU]
    assert model.vector_decoder is not None
    seen = {PIXELS: torch.zeros(2, 3, 32, 32, 3, dtype=torch.uint8), IMU: torch.randn(2, 3, 6)}
    embedding = model.encoder(seen)
    assert not torch.equal(embedding, model.encoder({**seen, IMU: seen[IMU] + 1.0}))


# Parameters in millions, counted in other implementations of the same architectures.
PARAMETERS = {
    "size1m": 0.69,
    "size12m": 10.5,
    "size25m": 23.5,
    "size50m": 41.6,
    "size100m": 93.5,
    "size200m": 166,
    "paper_large": 76.7,
}


@pytest.mark.parametrize("name", SIZES)
def test_sizes_have_their_number_of_parameters(name):
    with torch.device("meta"):
        agent = Agent(SIZES[name], Interface())
    count = sum(parameter.numel() for parameter in agent.parameters() if parameter.requires_grad)
    assert count / 1e6 == pytest.approx(PARAMETERS.get(name, count / 1e6), rel=0.01)
    assert get_size(name) is SIZES[name]


@pytest.mark.parametrize(
    ("size", "changed", "words"),
    [
        ("size1m", {"cnn_depth": 3}, "cnn_depth times the last of cnn_multipliers=12: must be a multiple of blocks=8"),
        ("size1m", {"belief": 100}, "belief=100: must be a multiple of blocks=8"),
        ("debug", {"classes": 300}, "classes=300: at most 256"),
        ("debug", {"norm": "batch"}, "norm=batch: must be one of rms, layer"),
        ("debug", {"prior_layers": 0}, "prior_layers=0: must be at least 1"),
    ],
)
def test_sizes_of_which_no_sound_networks_can_be_made_are_refused(size, changed, words):
    with pytest.raises(ValueError, match=words):
        replace(SIZES[size], **changed)


def test_unknown_size_lists_the_known_ones():
    with pytest.raises(ValueError, match="model=huge: must be one of debug, cpu_small.*paper_large"):
        get_size("huge")
