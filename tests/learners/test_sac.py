"""SAC: transitions of replay records, learning on a bandit, and states that come back."""

import copy

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.experience.replay import make_replay
from dreamer_racing.learners import NetworkSize, SACConfig, SACLearner
from dreamer_racing.learners.finite_guard import NonFiniteLossError
from dreamer_racing.modules import Interface

SMALL, NUMBERS = NetworkSize(2, 32), Interface(action_dim=1, pixels=False, vector_dim=1)


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
    batch = SACLearner(SMALL, NUMBERS, SACConfig(reward_scale=0.5), seed=0).transitions(windows)
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
    metrics = SACLearner(SMALL, NUMBERS, seed=0).update(windows)
    assert all(value.isfinite() for value in metrics.values())


def test_what_is_no_transition_has_no_influence() -> None:
    losses = []
    for reward in (0.0, 1e6):
        windows = make_windows()
        windows["is_init"][1, 1] = True
        windows["reward"][1, 1] = reward
        torch.manual_seed(0)
        losses.append(SACLearner(SMALL, NUMBERS, seed=0).update(windows))
    for name in ("loss_qvalue", "loss_actor", "gradient_norm/critic"):
        assert torch.equal(losses[0][name], losses[1][name]), name


def test_it_learns_a_bandit_through_the_replay() -> None:
    torch.manual_seed(0)
    learner = SACLearner(SMALL, NUMBERS, SACConfig(learning_rate=5e-3, reward_scale=1.0), seed=0)
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
    learner = SACLearner(SMALL, NUMBERS, SACConfig(target_rate=0.25), seed=0)
    target = {name: value.clone() for name, value in learner._loss.target_qvalue_network_params.items(True, True)}
    learner.update(make_windows())
    for name, value in learner._loss.target_qvalue_network_params.items(True, True):
        critic = learner._loss.qvalue_network_params[name]
        torch.testing.assert_close(value, 0.75 * target[name] + 0.25 * critic.detach())


def test_a_restored_learner_goes_on_as_the_one_that_was_saved() -> None:
    torch.manual_seed(0)
    learner, other = SACLearner(SMALL, NUMBERS, seed=0), SACLearner(SMALL, NUMBERS, seed=1)
    learner.update(make_windows())
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    metrics = []
    for each in (learner, other):
        torch.manual_seed(1)
        metrics.append(each.update(make_windows()))
    assert all(torch.equal(metrics[0][name], metrics[1][name]) for name in metrics[0])
    seen = TensorDict({"vector": torch.randn(5, 1)}, [5])
    actions = [each.policy(deterministic=True)(seen.clone())["action"] for each in (learner, other)]
    assert torch.equal(*actions)


def test_a_reward_that_is_not_finite_changes_no_network() -> None:
    learner = SACLearner(SMALL, NUMBERS, seed=0)
    before = {name: value.clone() for name, value in learner.actor.state_dict().items()}
    windows = make_windows()
    windows["reward"][0, 1] = float("nan")
    with pytest.raises(NonFiniteLossError):
        learner.update(windows)
    assert all(torch.equal(value, before[name]) for name, value in learner.actor.state_dict().items())


def test_networks_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="network.layers=3, this learner's with 2"):
        SACLearner(SMALL, NUMBERS).load_state_dict(SACLearner(NetworkSize(3, 8), NUMBERS).state_dict())
