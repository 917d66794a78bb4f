"""Baselines: PPO, SAC, and their networks."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives.value import GAE

from dreamer_racing.experience.replay import make_replay
from dreamer_racing.learners import NetworkSize, PPOConfig, PPOLearner, SACConfig, SACLearner
from dreamer_racing.learners.baseline import ImageTrunk, ObservationNetwork
from dreamer_racing.learners.gradient_step import NonFiniteLossError
from dreamer_racing.modules import Interface, symlog
from dreamer_racing.modules.interface import IMU
from tests.dreamers import differing

SMALL, NUMBERS = NetworkSize(2, 16), Interface(action_dim=1, pixels=False, vector_dim=1)
SEES_IMU = Interface(vector_dim=6, vector_key=IMU)


def make_rollout(
    vector: Tensor, following: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor
) -> TensorDict:
    """A rollout ``[N, T]`` of columns ``(N, T)``."""
    batch = list(vector.shape)
    ended = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
    return TensorDict(
        {
            "vector": vector.unsqueeze(-1),
            "action": torch.zeros(*batch, 1),
            "action_log_prob": torch.zeros(batch),
            "next": {
                "vector": following.unsqueeze(-1),
                "reward": reward.unsqueeze(-1),
                **{key: value.unsqueeze(-1) for key, value in ended.items()},
            },
        },
        batch,
    )


def random_rollout(num_envs: int = 4, steps: int = 12) -> TensorDict:
    """Episodes that end either way; what comes next is what is seen in the next step unless one ended."""
    generator = torch.Generator().manual_seed(0)
    ends = torch.rand(2, num_envs, steps, generator=generator) < 0.15
    terminated, truncated = ends[0], ends[1] & ~ends[0]
    vector, following, reward = torch.randn(3, num_envs, steps, generator=generator)
    goes_on = ~(terminated | truncated)[:, :-1]
    following[:, :-1][goes_on] = vector[:, 1:][goes_on]
    return make_rollout(vector, following, reward, terminated, truncated)


class Echo(nn.Module):
    """A critic that finds what it sees."""

    def forward(self, vector: Tensor) -> Tensor:
        return vector


def test_advantages_by_hand() -> None:
    learner = PPOLearner(SMALL, NUMBERS, PPOConfig(discount=0.5, lambda_=0.5, reward_scale=2.0), seed=0)
    learner.critic = TensorDictModule(Echo(), ["vector"], ["state_value"])
    vector, following = torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([[2.0, 9.0, 8.0, 6.0]])
    terminated, truncated = (torch.arange(4).unsqueeze(0) == step for step in (1, 2))
    records = learner.with_advantages(make_rollout(vector, following, torch.ones(1, 4), terminated, truncated))
    # 2 r + γ V(next) − V: the last two bootstrap from what came next, the second from nothing.
    last = 2 + 0.5 * 6 - 4
    cut = 2 + 0.5 * 8 - 3
    crash = 2 - 2
    first = 2 + 0.5 * 2 - 1 + 0.25 * crash
    advantage = torch.tensor([first, crash, cut, last]).float()
    torch.testing.assert_close(records["advantage"].flatten(), advantage)
    torch.testing.assert_close(records["value_target"].flatten(), advantage + vector.flatten())


def test_advantages_equal_torchrls() -> None:
    learner = PPOLearner(SMALL, NUMBERS, PPOConfig(reward_scale=1.0), seed=0)
    rollout = random_rollout()
    oracle = GAE(gamma=0.99, lmbda=0.95, value_network=learner.critic)(rollout.clone())
    records = learner.with_advantages(rollout)
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(records[key], oracle[key].flatten(0, 1), atol=1e-5, rtol=1e-5)


def test_evaluations_are_told_values_in_units_of_the_reward() -> None:
    learner = PPOLearner(SMALL, NUMBERS, PPOConfig(reward_scale=0.25, minibatches=2), seed=0)
    learner.critic = TensorDictModule(Echo(), ["vector"], ["state_value"])
    seen = torch.tensor([[1.0], [2.0], [-3.0]])
    acted = TensorDict({"vector": seen, "action": torch.zeros(3, 1)}, [3])
    assert torch.equal(learner.value_function()(acted), 4 * seen)


def bandit(learner: PPOLearner, rounds: int) -> float:
    """Reward −(a − 0.5)², episodes of one step; return the mean action that was learnt."""
    for _ in range(rounds):
        seen = torch.zeros(256, 1, 1)
        acted = learner.policy()(TensorDict({"vector": seen}, [256, 1]))
        reward = -(acted["action"] - 0.5).square().squeeze(-1)
        no = torch.zeros(256, 1, dtype=torch.bool)
        rollout = make_rollout(seen.squeeze(-1), seen.squeeze(-1), reward, ~no, no)
        learner.update(rollout.update(acted.select("action", "action_log_prob")))
    return learner.policy(deterministic=True)(TensorDict({"vector": torch.zeros(1, 1)}, [1]))["action"].item()


def test_it_learns_a_bandit() -> None:
    torch.manual_seed(0)
    learner = PPOLearner(SMALL, NUMBERS, seed=0)
    assert abs(bandit(learner, 0)) < 0.05
    assert bandit(learner, 25) == pytest.approx(0.5, abs=0.1)
    assert learner.updates == 25 * 5 * 8


@pytest.mark.parametrize("kind", [PPOLearner, SACLearner])
def test_networks_of_another_size_are_refused(kind: type[PPOLearner | SACLearner]) -> None:
    saved = kind(NetworkSize(3, 8), NUMBERS, seed=0).state_dict()
    with pytest.raises(ValueError, match="network.layers=3, this learner's with 2: set network.layers=3"):
        kind(SMALL, NUMBERS, seed=0).load_state_dict(saved)


@pytest.mark.parametrize(
    ("there", "here", "words"),
    [
        (Interface(image_size=96), Interface(), "env.image_size=96, this learner's with 64"),
        (NUMBERS, Interface(), "env.from_pixels=false, this learner's with true: set env.from_pixels=false"),
        (Interface(), SEES_IMU, "made without env.imu, and this learner's are made with it"),
        (SEES_IMU, Interface(), "made with env.imu, and this learner's are made without it"),
        (
            NUMBERS,
            replace(NUMBERS, vector_dim=9),
            rf"made for {NUMBERS.vector_dim} observed numbers, .* learner's for 9",
        ),
    ],
    ids=["size", "no images", "no imu", "imu", "numbers"],
)
def test_networks_of_other_observations_are_refused(there: Interface, here: Interface, words: str) -> None:
    saved = PPOLearner(SMALL, there, seed=0).state_dict()
    with pytest.raises(ValueError, match=words):
        PPOLearner(SMALL, here, seed=0).load_state_dict(saved)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PPOLearner(SMALL, NUMBERS, PPOConfig(epochs=0)), "epochs=0: must be at least 1"),
        (lambda: SACLearner(SMALL, NUMBERS, SACConfig(initial_alpha=0.0)), "initial_alpha=0.0: must be above 0"),
    ],
)
def test_settings_out_of_range_are_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(("minibatches", "steps"), [(1, 1), (7, 7), (48, 48)])
def test_there_are_as_many_minibatches_as_were_asked_for(minibatches: int, steps: int) -> None:
    learner = PPOLearner(SMALL, NUMBERS, PPOConfig(minibatches=minibatches, epochs=1), seed=0)
    learner.update(random_rollout(num_envs=4, steps=12))  # 48 records, which 7 does not divide
    assert {int(state["step"]) for state in learner.optimizer.state.values()} == {steps}


def test_more_minibatches_than_records_are_refused() -> None:
    with pytest.raises(ValueError, match="minibatches=49: must be at most 48"):
        PPOLearner(SMALL, NUMBERS, PPOConfig(minibatches=49), seed=0).update(random_rollout(num_envs=4, steps=12))


# Networks of the baselines: what they read, in which order, and what the acting step writes.


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


def test_an_imu_is_seen_by_its_symlog() -> None:
    image, sample = torch.zeros(5, 64, 64, 3, dtype=torch.uint8), 20.0 * torch.randn(5, 6)
    network = ObservationNetwork(SEES_IMU, 2, NetworkSize(0, 8))
    assert network.in_keys == ["pixels", "imu"]
    features = torch.cat((network.trunk(image), symlog(sample)), -1)
    assert torch.equal(network(image, sample), network.mlp(features))


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


# SAC: transitions of replay records, learning on a bandit, and states that come back.


WIDE = NetworkSize(2, 32)


def make_windows(batch: int = 6) -> TensorDict:
    """Windows ``[B, 2]`` of replay records, none of which begins or ends an episode."""
    generator = torch.Generator().manual_seed(0)
    flags = {key: torch.zeros(batch, 2, 1, dtype=torch.bool) for key in ("is_init", "terminated", "truncated")}
    numbers = {key: torch.randn(batch, 2, 1, generator=generator) for key in ("vector", "previous_action", "reward")}
    return TensorDict({**numbers, **flags}, [batch, 2])


def test_a_transition_leads_from_one_record_to_the_next() -> None:
    windows = make_windows()
    windows["is_init"][1, 1] = True
    windows["terminated"][2, 1] = True
    windows["truncated"][3, 1] = True
    windows["terminated"][4, 0] = True  # of the transition before
    batch = SACLearner(WIDE, NUMBERS, SACConfig(reward_scale=0.5), seed=0).transitions(windows)
    assert torch.equal(batch["vector"], windows["vector"][:, 0])
    assert torch.equal(batch["next", "vector"], windows["vector"][:, 1])
    assert torch.equal(batch["action"], windows["previous_action"][:, 1])
    assert torch.equal(batch["next", "reward"], 0.5 * windows["reward"][:, 1])
    assert batch["next", "terminated"].flatten().tolist() == [False, False, True, False, False, False]
    assert batch["next", "done"].flatten().tolist() == [False, False, True, True, False, False]
    assert batch["priority_weight"].tolist() == pytest.approx([1, 0, 1, 1, 1, 1], abs=1e-20)


def test_a_batch_without_a_transition_is_survived() -> None:
    windows = make_windows()
    windows["is_init"][:, 1] = True
    metrics = SACLearner(WIDE, NUMBERS, seed=0).update(windows)
    assert all(value.isfinite() for value in metrics.values())


def test_what_is_no_transition_has_no_influence() -> None:
    losses = []
    for reward in (0.0, 1e6):
        windows = make_windows()
        windows["is_init"][1, 1] = True
        windows["reward"][1, 1] = reward
        torch.manual_seed(0)
        losses.append(SACLearner(WIDE, NUMBERS, seed=0).update(windows))
    for name in ("loss_qvalue", "loss_actor", "gradient_norm/critic"):
        assert torch.equal(losses[0][name], losses[1][name]), name


def test_it_learns_a_bandit_through_the_replay() -> None:
    torch.manual_seed(0)
    learner = SACLearner(WIDE, NUMBERS, SACConfig(learning_rate=5e-3, reward_scale=1.0), seed=0)
    replay = make_replay(8000, 64, 128, 2, observation_keys=["vector"], reward_keys=["reward"])
    policy, best = learner.policy(), learner.policy(deterministic=True)
    ended = torch.ones(64, 4, 1, dtype=torch.bool)
    for _ in range(80):
        seen = TensorDict({"vector": torch.zeros(64, 4, 1), "is_init": ended}, [64, 4])
        acted = policy(seen)
        following = {
            "vector": torch.zeros(64, 4, 1),
            "reward": -(acted["action"] - 0.5).square(),
            "terminated": ended,
            "truncated": ~ended,
        }
        replay.extend(acted.select("vector", "is_init", "action").set("next", TensorDict(following, [64, 4])))
        for _ in range(4):
            learner.update(replay.sample())
    action = best(TensorDict({"vector": torch.zeros(1, 1)}, [1]))["action"].item()
    assert action == pytest.approx(0.5, abs=0.15)


def test_the_target_critics_follow_slowly() -> None:
    learner = SACLearner(WIDE, NUMBERS, SACConfig(target_rate=0.25), seed=0)
    target = {name: value.clone() for name, value in learner._loss.target_qvalue_network_params.items(True, True)}
    learner.update(make_windows())
    for name, value in learner._loss.target_qvalue_network_params.items(True, True):
        critic = learner._loss.qvalue_network_params[name]
        torch.testing.assert_close(value, 0.75 * target[name] + 0.25 * critic.detach())


@pytest.mark.parametrize(
    ("kind", "size", "make_batch"), [(PPOLearner, SMALL, random_rollout), (SACLearner, WIDE, make_windows)]
)
def test_a_restored_learner_goes_on_as_the_one_that_was_saved(
    kind: Callable[..., PPOLearner | SACLearner], size: NetworkSize, make_batch: Callable[[], TensorDict]
) -> None:
    torch.manual_seed(0)
    learner, other = kind(size, NUMBERS, seed=0), kind(size, NUMBERS, seed=1)
    learner.update(make_batch())
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    metrics = []
    for each in (learner, other):
        torch.manual_seed(1)
        metrics.append(each.update(make_batch()))
    assert not differing(*metrics)
    seen = make_batch().select("vector")
    actions = [each.policy(deterministic=True)(seen.clone())["action"] for each in (learner, other)]
    assert torch.equal(*actions)
    assert other.updates == learner.updates


@pytest.mark.parametrize("bad", [math.inf, math.nan])
@pytest.mark.parametrize(
    ("kind", "config", "make_batch", "reward"),
    [
        (PPOLearner, PPOConfig(minibatches=1), random_rollout, ("next", "reward")),
        (SACLearner, SACConfig(), make_windows, "reward"),
    ],
)
def test_a_reward_that_is_not_finite_changes_no_network(
    kind: Any, config: Any, make_batch: Callable[[], TensorDict], reward: NestedKey, bad: float
) -> None:
    learner, batch = kind(WIDE, NUMBERS, config, seed=0), make_batch()
    before = copy.deepcopy(learner.networks)
    batch[reward][0, 1] = bad
    with pytest.raises(NonFiniteLossError):
        learner.update(batch)
    for name, parameters in learner.networks.items():
        assert all(map(torch.equal, parameters, before[name])), name
