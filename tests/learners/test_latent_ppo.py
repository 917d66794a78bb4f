"""PPO in the latents of a world model: what moves and when, what the critics see, what is saved; PPO's own update."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from dreamer_racing.learners import latent_ppo
from dreamer_racing.learners.gradient_step import FiniteGuard, NonFiniteLossError
from dreamer_racing.learners.latent_ppo import LatentPPO, PPOUpdate
from dreamer_racing.losses import PPOUpdateConfig, rollout_return
from dreamer_racing.modules import Interface, join_features
from dreamer_racing.modules.heads import ActionDistribution, symlog
from tests.dreamers import differing, latent_ppo_of
from tests.launches import launches
from tests.learners.test_dreamer_v3 import make_batch, watch

N, T, P = 3, 4, 5
PPO = PPOUpdateConfig(steps=2 * N * T, epochs=4, minibatch=16, learning_rate=1e-2, kl_stop=1e9)
CONFIG = {"ppo": PPO, "discount": 0.9, "lambda_": 0.8, "entropy_scale": 0.0, "warmup_updates": 0}

of_each = pytest.mark.parametrize("critic", ["latent", "state"])


def make_learner(critic: str = "latent", **changes) -> LatentPPO:
    numbers = {**CONFIG, "critic": critic, "world_model": "privileged", **changes}
    return latent_ppo_of("debug", Interface(privileged_dim=P), seed=0, **numbers)


def make_rollout(learner: LatentPPO, number: int = N, steps: int = T) -> TensorDict:
    """As a collector yields it, with the latents that the policy saw under ``next``; nothing ends."""
    belief = torch.rand(number, steps, 32) * 2 - 1
    state = torch.rand(number, steps, 16).unflatten(-1, (4, 4)).softmax(-1).flatten(-2)
    policy = learner.agent.actor(torch.cat((belief, state), -1))
    action = policy.sample().detach().clamp(-1.0, 1.0)
    done, terminated = torch.zeros(2, number, steps, 1, dtype=torch.bool)
    came = {"reward": torch.randn(number, steps, 1), "done": done, "terminated": terminated}
    before = torch.nn.functional.pad(action[:, :-1], (0, 0, 1, 0))
    root = {"action": action, "previous_action": before, "loc": policy.mean.detach(), "scale": policy.std.detach()}
    privileged = {"vector": torch.randn(number, steps, P)}
    return TensorDict(
        {**root, "privileged": privileged, "next": {"belief": belief, "state": state, **came}}, [number, steps]
    )


def make_seen_batch() -> TensorDict:
    batch = make_batch()
    return batch.set(("privileged", "vector"), torch.randn(*batch.batch_size, P))


def collect(learner: LatentPPO, rollouts: int = 2) -> None:
    for _ in range(rollouts):
        learner.collect(make_rollout(learner))


@of_each
def test_an_update_of_the_actor_moves_actor_and_its_critic_and_nothing_else(critic):
    learner = make_learner(critic)
    parts = {"actor": learner.agent.actor, "own": learner.critic}
    others = {"model": learner.agent.world_model, "critic": learner.agent.critic}
    before = {name: copy.deepcopy(part.state_dict()) for name, part in (parts | others).items()}
    collect(learner)
    metrics = learner.update_actor()
    for name, part in (parts | others).items():
        assert bool(differing(part.state_dict(), before[name])) == (name in parts), name
    assert set(metrics) == {
        "ppo/loss", "ppo/kl", "ppo/clipped", "ppo/epochs", "ppo/learning_rate_scale", "ppo/critic_loss",
        "ppo/explained_variance", "entropy", "gradient_norm/actor", "gradient_norm/own_critic",
    }  # fmt: skip
    assert metrics["gradient_norm/own_critic"] > 0
    assert all(value.shape == () for value in metrics.values())
    assert all(parameter.grad is None for part in others.values() for parameter in part.parameters())
    assert not learner.storage.full, "what was learned from is not learned from again"


def test_the_actor_stands_still_until_enough_was_collected_and_while_it_waits():
    learner, batch = make_learner(), make_seen_batch()
    assert "ppo/kl" not in learner.update(batch)
    collect(learner, 1)  # half of the steps
    assert "ppo/kl" not in learner.update(batch)
    collect(learner, 2)
    learner.actor_waits = True
    before = copy.deepcopy(learner.agent.state_dict())
    assert "ppo/kl" not in learner.update(batch)
    moved = differing(learner.agent.state_dict(), before)
    assert any(name.startswith("world_model.") for name in moved)
    assert not any(name.startswith("actor.") for name in moved)
    learner.actor_waits = False
    assert "ppo/kl" in learner.update(batch)


@of_each
def test_nothing_is_imagined(critic, monkeypatch):
    learner = make_learner(critic)
    monkeypatch.setattr(learner.agent.world_model.rssm, "imagine_step", None)
    metrics = learner.update(make_seen_batch())
    assert "loss_replay_critic" in metrics
    assert not {"loss_actor", "loss_critic", "imagined_reward"} & set(metrics)
    assert learner.latents is not None, "the replay's context is refreshed all the same"


@of_each
def test_a_checkpoint_between_two_updates_of_the_actor_loses_nothing(critic):
    torch.manual_seed(0)
    learner = make_learner(critic)
    rollouts, batch = [make_rollout(learner) for _ in range(4)], make_seen_batch()
    for rollout in rollouts[:3]:  # one update of the actor, and half of the steps of the next
        learner.collect(rollout)
        learner.update(batch)
    resumed = make_learner(critic)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    for each in (learner, resumed):
        torch.manual_seed(5)
        each.collect(rollouts[3])
        assert "ppo/kl" in each.update(batch)
    assert not differing(learner.agent.state_dict(), resumed.agent.state_dict())
    assert not differing(learner.critic.state_dict(), resumed.critic.state_dict())


@of_each
def test_the_rates_of_both_fall_with_the_others(critic):
    learner = make_learner(critic, ppo=replace(PPO, learning_rate=1e-2, critic_learning_rate=1e-3))
    learner.adjust(rates=0.5, kl_target=0.7)
    updates = (learner.actor_update, learner.critic_update)
    assert [update.optimizer.param_groups[0]["lr"] for update in updates] == pytest.approx([5e-3, 5e-4])
    assert learner.actor_update.kl_target == 0.7


@of_each
def test_advantages_come_of_what_was_paid_and_of_the_critic_s_own_values(critic):
    """By hand: the objective sees normalised λ-returns less values, and neither latents nor the agent's critic."""
    learner = make_learner(critic, ppo=replace(PPO, steps=N * T, epochs=1, minibatch=1000))
    torch.nn.init.normal_(learner.critic.mlp.output.weight)
    torch.nn.init.normal_(learner.agent.critic.head.mlp.output.weight)
    rollout, seen = make_rollout(learner), watch(learner)
    inputs = rollout["privileged", "vector"]
    inputs = symlog(inputs) if critic == "state" else join_features(rollout["next", "belief"], rollout["next", "state"])
    with torch.no_grad():
        value = learner.critic.mean(inputs.transpose(0, 1))
    after = rollout["next"].transpose(0, 1)
    flags = (after["done"], after["terminated"])
    returns = rollout_return(after["reward"], value, *flags, torch.tensor(0.9), 0.8)
    learner.collect(rollout)
    torch.manual_seed(0)
    learner.update_actor()
    advantage = (returns - value).flatten(0, 1)
    expected = ((advantage - advantage.mean()) / advantage.std(unbiased=False)).flatten()
    torch.testing.assert_close(seen[0].advantage.flatten().sort().values, expected.sort().values, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(seen[0].lambda_return.flatten().sort().values, returns.flatten().sort().values)
    assert seen[0].previous_action.shape == seen[0].action.shape == (N * T, 4)


def test_what_pays_becomes_likelier():
    """Rewards that are the first dimension of the action: its mean rises, the others' stay."""
    torch.manual_seed(0)
    learner = make_learner(ppo=replace(PPO, steps=512, minibatch=64, critic_learning_rate=1e-9), discount=0.0)
    for _ in range(10):
        rollout = make_rollout(learner, 64, 8)
        rollout["next", "reward"] = rollout["action"][..., :1].clone()
        learner.collect(rollout)
        assert learner.update_actor()
    mean = learner.agent.actor(learner.storage.steps["features"]).mean
    assert mean[..., 0].mean() > 0.5
    assert mean[..., 1:].mean(dim=(0, 1)).abs().max() < 0.3


def test_the_ratio_is_one_before_the_first_step():
    """The first gradient step sees the policy that acted: nothing is clipped, nothing has diverged."""
    learner = make_learner(ppo=replace(PPO, epochs=1, minibatch=1000), mixed_precision=True)
    collect(learner)
    with learner.autocast():
        metrics = learner.update_actor()
    assert metrics["ppo/kl"].item() == pytest.approx(0.0, abs=1e-6)
    assert metrics["ppo/clipped"].item() == 0.0


def test_a_bound_that_came_down_since_the_flight_is_no_divergence_of_the_steps():
    learner = make_learner(ppo=replace(PPO, kl_stop=0.05, kl_target=0.05, learning_rate=1e-5))
    collect(learner)
    learner.adjust(max_std=0.2)
    steps = learner.storage.steps.flatten()
    behavior = ActionDistribution(*steps["behavior"].chunk(2, -1))
    with torch.no_grad():
        assert behavior.divergence(learner.agent.actor(steps["features"])).mean() > 1.0
    metrics = learner.update_actor()
    assert metrics["ppo/epochs"] == PPO.epochs and metrics["ppo/kl"] < 0.05


@of_each
def test_a_masked_update_of_the_actor_waits_for_nothing(critic, monkeypatch):
    monkeypatch.setattr(latent_ppo, "masks_steps", lambda device: True)
    learner = make_learner(critic, ppo=replace(PPO, steps=N * T, kl_target=0.01, kl_stop=0.02))
    collect(learner, 1)
    learner.update_actor()
    collect(learner, 1)
    seen = launches(learner.update_actor)
    assert seen.kernels["_fused_adam_"] >= 4 and (seen.waits, seen.mixed) == ([], [])


@pytest.mark.parametrize(("critic", "pays"), [("latent", ("next", "belief")), ("state", ("privileged", "vector"))])
def test_the_critic_learns_what_pays(critic, pays):
    """Rewards that what it sees tells: after some updates it explains nearly all of the returns."""
    torch.manual_seed(0)
    learner = make_learner(critic, ppo=PPOUpdateConfig(steps=512, epochs=4, minibatch=64), discount=0.0)
    for number in range(12):
        rollout = make_rollout(learner, 64, 8)
        rollout["next", "belief"].normal_()
        rollout["next", "reward"] = 3.0 * rollout[pays][..., :1]
        learner.collect(rollout)
        metrics = learner.update_actor()
        if number == 0:
            assert metrics["ppo/explained_variance"].item() == pytest.approx(0.0, abs=0.05)
    assert metrics["ppo/explained_variance"].item() > 0.8


@of_each
def test_evaluations_ask_the_critic_that_teaches_the_actor(critic):
    """At the state, or at the latents that the policy made of what it saw, not those that it remembered."""
    learner = make_learner(critic)
    size = learner.size
    torch.nn.init.normal_(learner.critic.mlp.output.weight)
    remembered = TensorDict({"belief": torch.randn(3, size.belief), "state": torch.rand(3, size.state)}, [3])
    seen = make_seen_batch()[:3, 0].select(
        *learner.agent.world_model.encoder.keys, "is_init", "previous_action", "privileged"
    )
    with torch.no_grad():
        acted = learner.evaluation_policy()(remembered.clone().update(seen))
        inputs = {
            "latent": join_features(acted["next", "belief"], acted["next", "state"]),
            "state": symlog(acted["privileged", "vector"]),
        }
        expected = learner.critic.mean(inputs[critic])
    value = learner.value_function()(acted)
    assert value.shape == (3, 1) and not value.requires_grad and torch.equal(value, expected)
    assert not any("privileged" in str(key) for key in learner.policy().in_keys), "what flies needs no state"


def test_what_it_needs_and_does_not_get_is_refused_by_name():
    with pytest.raises(ValueError, match=r"critic='state' needs the simulator's state.*critic='latent'"):
        latent_ppo_of("debug", Interface(), critic="state")
    with pytest.raises(ValueError, match=r"loss.critic=sate: must be one of latent, state \(did you mean state\?\)"):
        latent_ppo_of("debug", Interface(), critic="sate")
    learner = make_learner("state")
    with pytest.raises(KeyError, match=r"lacks \[\('privileged', 'vector'\)\]"):
        learner.collect(make_rollout(learner).exclude("privileged"))


RECORDS = 24


def make_update(masked: bool, monkeypatch: pytest.MonkeyPatch, **numbers: Any) -> tuple[PPOUpdate, Any]:
    """An update of a linear network, and a loss whose divergence grows with the distance from where it began."""
    monkeypatch.setattr(latent_ppo, "masks_steps", lambda device: masked)
    torch.manual_seed(0)
    network, inputs, targets = nn.Linear(3, 1), torch.randn(RECORDS, 3), torch.randn(RECORDS, 1)
    begun = network.weight.detach().clone()
    kl_target = numbers.pop("kl_target", None)
    config = PPOUpdateConfig(**{"epochs": 4, "minibatch": 16, "kl_stop": 1e9, **numbers})
    update = PPOUpdate(network, 1e-2, config, kl_target)

    def loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        error = (network(inputs[chosen]) - targets[chosen]).square().mean()
        return error, {"ppo/kl": (network.weight.detach() - begun).square().sum()}

    return update, loss


@pytest.mark.parametrize(
    ("numbers", "epochs"),
    [({}, 4.0), ({"kl_stop": 1e-5}, 1.0), ({"kl_stop": 0.002, "kl_target": 0.001}, None)],
    ids=["all", "stopped at the second step", "controlled"],
)
def test_masked_updates_are_those_that_break_off(monkeypatch, numbers, epochs):
    of_each = []
    for masked in (False, True):
        update, loss = make_update(masked, monkeypatch, **numbers)
        metrics = []
        for seed in range(3):
            torch.manual_seed(seed)
            metrics.append(update.run(RECORDS, loss))
        of_each.append((metrics, update.network.state_dict(), update.learning_rate_scale))
    torch.testing.assert_close(of_each[1], of_each[0], rtol=1e-4, atol=1e-5)
    stopped = of_each[0][0][0]["ppo/epochs"].item()
    assert stopped == epochs if epochs else stopped < 4.0, "or the test sees no masks"


@pytest.mark.parametrize("masked", [False, True])
def test_a_gradient_that_is_no_number_leaves_weights_and_moments_as_they_were(monkeypatch, masked):
    update, loss = make_update(masked, monkeypatch)
    update.run(RECORDS, loss)  # there are moments
    before = copy.deepcopy((update.network.state_dict(), update.optimizer.state_dict()))
    metrics = update.run(RECORDS, lambda chosen: (loss(chosen)[0] * float("nan"), {}))
    assert not metrics["gradient_norm"].isfinite()
    after = (update.network.state_dict(), update.optimizer.state_dict())
    torch.testing.assert_close(after, before, rtol=0, atol=0)


def test_a_checkpoint_goes_on_with_masks_or_without(monkeypatch):
    plain, loss = make_update(False, monkeypatch, kl_target=1e-9)
    plain.run(RECORDS, loss)
    masked, masked_loss = make_update(True, monkeypatch, kl_target=1e-9)
    masked.load_state_dict(copy.deepcopy(plain.state_dict()))
    masked.network.load_state_dict(copy.deepcopy(plain.network.state_dict()))
    assert masked.learning_rate_scale == plain.learning_rate_scale < 1.0
    for update, of_it in ((plain, loss), (masked, masked_loss)):
        torch.manual_seed(1)
        update.run(RECORDS, of_it)
    torch.testing.assert_close(masked.network.state_dict(), plain.network.state_dict(), rtol=1e-4, atol=1e-6)
    plain.load_state_dict(copy.deepcopy(masked.state_dict()))
    assert [group["fused"] for group in plain.optimizer.param_groups] == [None]


@pytest.mark.parametrize(("number", "sizes"), [(32, [16, 16]), (36, [12, 12, 12]), (17, [9, 8]), (5, [5])])
def test_no_minibatch_is_a_small_rest_and_each_record_is_seen_once_an_epoch(monkeypatch, number, sizes):
    update, _ = make_update(False, monkeypatch, epochs=1)
    seen: list[Tensor] = []
    update.run(number, lambda chosen: (seen.append(chosen) or update.network.weight.sum(), {}))
    assert [len(chosen) for chosen in seen] == sizes
    assert torch.cat(seen).sort().values.tolist() == list(range(number))


@pytest.mark.parametrize(("kl", "scale"), [(0.016, 0.8), (0.012, 1.0), (0.005, 1.0), (float("nan"), 0.8)], ids=str)
def test_the_learning_rate_follows_the_divergence(monkeypatch, kl, scale):
    """By hand: 1.25 times lower beyond 1.5 times the target of 0.01, and never above the full one."""
    update, _ = make_update(False, monkeypatch, kl_target=0.01, epochs=1, minibatch=RECORDS)

    def loss(chosen: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return update.network.weight.sum(), {"ppo/kl": torch.tensor(kl)}

    assert update.run(RECORDS, loss)["ppo/learning_rate_scale"] == 1.0, "that it was made at"
    assert update.learning_rate_scale.item() == pytest.approx(scale)
    update.learning_rate_scale.fill_(0.5)
    update.run(RECORDS, loss)
    assert update.learning_rate_scale.item() == pytest.approx({0.005: 0.625, 0.012: 0.5}.get(kl, 0.4))
    update.kl_target = None
    assert update.run(RECORDS, loss)["ppo/learning_rate_scale"] == 1.0, "without a target it is the full one"


# The guard against losses that are not finite, alone; with a learner it is in ``test_dreamer_v3.py``.


def test_a_lagging_guard_names_the_batch_that_was_bad():
    guard, names = FiniteGuard(lag=2), ("loss", "reward_error", "gradient_norm/actor")
    metrics = {name: torch.tensor(1.0) for name in names} | {"agreement": torch.tensor(math.nan)}
    for number in range(4):
        guard.check(metrics, number)
    guard.check(metrics | {"gradient_norm/actor": torch.tensor(math.inf)}, "bad")
    guard.check(metrics, 5)
    with pytest.raises(NonFiniteLossError) as error:
        guard.check(metrics, 6)
    assert error.value.batch == "bad"
