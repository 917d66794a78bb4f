"""Networks of the baselines: what they read, in which order, and what the acting step writes."""

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners import NetworkSize, PPOLearner, SACLearner
from dreamer_racing.learners.networks import ImageTrunk, ObservationNetwork
from dreamer_racing.modules import Interface

SMALL = NetworkSize(layers=2, units=16)


def test_the_papers_networks() -> None:
    network = ObservationNetwork(Interface(), 4, NetworkSize())
    widths = [layer.out_features for layer in network.mlp if isinstance(layer, torch.nn.Linear)]
    assert widths == [768, 768, 768, 768, 4]
    assert network.in_keys == ["pixels"]


def test_images_numbers_and_actions_are_read_side_by_side() -> None:
    network = ObservationNetwork(Interface(vector_dim=3), 2, SMALL, with_action=True)
    assert network.in_keys == ["pixels", "vector", "action"]
    assert network.mlp[0].in_features == ImageTrunk.features + 3 + 4
    pixels = torch.randint(0, 256, (5, 6, 64, 64, 3), dtype=torch.uint8)
    vector, action = torch.randn(5, 6, 3), torch.randn(5, 6, 4)
    outputs = network(pixels, vector, action)
    assert outputs.shape == (5, 6, 2)
    for position, other in ((0, 255 - pixels), (1, vector + 1), (2, action + 1)):
        inputs = [pixels, vector, action]
        inputs[position] = other
        assert not torch.allclose(network(*inputs), outputs), f"input {position} has no influence"


def test_images_are_scaled_to_one() -> None:
    trunk = ImageTrunk()
    seen = []
    trunk.convolutions[0].register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    trunk(torch.full((1, 64, 64, 3), 255, dtype=torch.uint8))
    assert seen[0].shape == (1, 3, 64, 64) and torch.all(seen[0] == 1.0)


def test_images_that_are_too_small_are_refused() -> None:
    with pytest.raises(ValueError, match=r"image_size=32: .* at least 36 × 36"):
        ImageTrunk(32)
    ImageTrunk(36)


def test_the_deterministic_policy_takes_the_mode() -> None:
    seen = TensorDict({"vector": torch.randn(8, 21)}, [8])
    interface = Interface(pixels=False, vector_dim=21)
    for kind in (PPOLearner, SACLearner):
        learner = kind(SMALL, interface, seed=0)
        policy = learner.policy(deterministic=True)
        first, second = policy(seen.clone())["action"], policy(seen.clone())["action"]
        assert torch.equal(first, second) and first.abs().max() < 0.1, "the first policy is near the middle"
        policy.deterministic = False
        assert not torch.equal(policy(seen.clone())["action"], policy(seen.clone())["action"])


def test_squashed_actions_stay_in_bounds() -> None:
    learner = SACLearner(SMALL, Interface(pixels=False, vector_dim=21), seed=0)
    action = learner.policy()(TensorDict({"vector": 100 * torch.randn(500, 21)}, [500]))["action"]
    assert action.abs().max() <= 1.0
