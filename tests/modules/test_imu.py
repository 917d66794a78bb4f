"""Networks that see what an IMU tells beside images: the world model's, and the baselines'."""

from __future__ import annotations

import pytest
import torch

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.learners.networks import NetworkSize, ObservationNetwork, check_layers, layers_of
from dreamer_racing.modules import Interface, get_size
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.interface import IMU, PIXELS, PRIVILEGED
from dreamer_racing.modules.world_model import WorldModel

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
    check_layers({name: value for name, value in without.items() if name != "imu"}, without)
    with pytest.raises(ValueError, match="made without env.imu, and this learner's are made with it"):
        check_layers(without, with_one)
    with pytest.raises(ValueError, match="made with env.imu, and this learner's are not"):
        check_layers(with_one, without)
