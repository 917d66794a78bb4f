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
from dreamer_racing.learners.baseline import NetworkSize, ObservationNetwork, check_layers, layers_of
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
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.interface import IMU, PIXELS, PRIVILEGED


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


@pytest.mark.parametrize("num_envs", [1, 3])
def test_interface_of_any_environment(num_envs):
    """The last dimension counts, whatever the number of environments."""
    privileged = Composite(vector=Unbounded((num_envs, 9)), position=Unbounded((num_envs, 3)), shape=[num_envs])
    env = SpecEnv(num_envs, 2, pixels=images(num_envs), vector=Unbounded((num_envs, 5)), privileged=privileged)
    interface = Interface.of(env)
    assert interface == Interface(action_dim=2, pixels=True, vector_dim=5, privileged_dim=9)
    assert interface.observation_keys == ["pixels", "vector"]
    assert interface.replay_keys == ["pixels", "vector", PRIVILEGED]


def test_privileged_entries_other_than_the_vector_do_not_count():
    privileged = Composite(position=Unbounded((3, 3)), shape=[3])
    assert Interface.of(SpecEnv(3, 4, pixels=images(3), privileged=privileged)) == Interface()


def test_interface_of_a_transformed_environment():
    env = TransformedEnv(SpecEnv(3, 4, vector=Unbounded((3, 5))), InitTracker())
    assert Interface.of(env) == Interface(pixels=False, vector_dim=5)


def test_size_of_the_images():
    assert Interface.of(SpecEnv(3, 4, pixels=images(3, 96, 96))) == Interface(image_size=96)
    assert Interface(image_size=96).image_shape == (96, 96, 3)
    with pytest.raises(ValueError, match="48 × 32 pixels: agents need square images"):
        Interface.of(SpecEnv(3, 4, pixels=images(3, 48, 32)))


def test_an_agent_that_sees_nothing_is_refused():
    with pytest.raises(ValueError, match="neither 'pixels' nor 'vector'"):
        Interface.of(SpecEnv(3, 4, sound=Unbounded((3, 5))))
    with pytest.raises(ValueError, match="sees nothing"):
        Interface(pixels=False)


@pytest.mark.parametrize(
    ("interface", "observation_keys", "replay_keys"),
    [
        (Interface(), ["pixels"], ["pixels"]),
        (Interface(privileged_dim=3), ["pixels"], ["pixels", PRIVILEGED]),
        (Interface(pixels=False, vector_dim=2), ["vector"], ["vector"]),
        (Interface(pixels=False, vector_dim=2, privileged_dim=3), ["vector"], ["vector", PRIVILEGED]),
        (Interface(vector_dim=2), ["pixels", "vector"], ["pixels", "vector"]),
    ],
)
def test_keys(interface, observation_keys, replay_keys):
    """The encoder never reads what is privileged."""
    assert interface.observation_keys == observation_keys
    assert interface.replay_keys == replay_keys


@pytest.mark.parametrize("privileged", [False, True])
@pytest.mark.parametrize("from_pixels", [False, True])
def test_interface_of_the_race(from_pixels, privileged):
    env = DroneRacingEnv(track="circle", num_envs=2, from_pixels=from_pixels, privileged=privileged, seed=0)
    interface = Interface.of(env)
    reset = env.reset()
    env.close()
    assert interface.action_dim == 4
    assert interface.pixels == from_pixels == ("pixels" in reset.keys())  # noqa: SIM118
    assert interface.vector_dim == (0 if from_pixels else reset["vector"].shape[-1])
    assert interface.privileged_dim == (reset[PRIVILEGED].shape[-1] if privileged else 0)
    for key in interface.replay_keys:
        assert reset[key].shape[0] == 2


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


@pytest.mark.parametrize("recurrence", ["dense", "block"])
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


# Networks that see what an IMU tells beside images: the world model's, and the baselines'.


SEEN = Interface(image_size=32, vector_dim=6, vector_key=IMU)


def test_the_interface_is_read_off_the_environment() -> None:
    env = DroneRacingEnv("circle", 1, imu="exact", camera=Camera(32, 32), privileged=True)
    interface = Interface.of(env)
    env.close()
    assert (interface.vector_key, interface.vector_dim, interface.image_size) == (IMU, 6, 32)
    assert interface.observation_keys == [PIXELS, IMU]
    assert interface.replay_keys == [PIXELS, IMU, PRIVILEGED]


def test_the_world_model_reads_both_and_decodes_both() -> None:
    torch.manual_seed(0)
    model = WorldModel(get_size("debug"), SEEN)
    assert model.encoder.keys == [PIXELS, IMU]
    assert model.vector_decoder is not None
    seen = {PIXELS: torch.zeros(2, 3, 32, 32, 3, dtype=torch.uint8), IMU: torch.randn(2, 3, 6)}
    embedding = model.encoder(seen)
    assert not torch.equal(embedding, model.encoder({**seen, IMU: seen[IMU] + 1.0}))


def test_baselines_see_its_symlog() -> None:
    torch.manual_seed(0)
    image, sample = torch.zeros(5, 36, 36, 3, dtype=torch.uint8), 20.0 * torch.randn(5, 6)
    network = ObservationNetwork(Interface(image_size=36, vector_dim=6, vector_key=IMU), 2, NetworkSize(0, 8))
    assert network.in_keys == [PIXELS, IMU]
    assert network.trunk is not None
    features = torch.cat((network.trunk(image), symlog(sample)), -1)
    assert torch.equal(network(image, sample), network.mlp(features))


def test_a_checkpoint_without_an_imu_is_refused_by_networks_with_one() -> None:
    without, with_one = (layers_of(NetworkSize(), seen) for seen in (Interface(image_size=32), SEEN))
    check_layers(without, without)
    with pytest.raises(ValueError, match="made without env.imu, and this learner's are made with it"):
        check_layers(without, with_one)
    with pytest.raises(ValueError, match="made with env.imu, and this learner's are made without it"):
        check_layers(with_one, without)


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


def test_unknown_size_lists_the_known_ones():
    with pytest.raises(ValueError, match="model=huge: must be one of debug, cpu_small.*paper_large"):
        get_size("huge")
