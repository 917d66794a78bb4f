"""Whole losses against TorchRL's own DreamerV3 losses, with the same weights, batch and noise.

Our networks stand behind adapters with the keys that TorchRL reads; every number after the networks' outputs is then
computed twice, by independent code. Where TorchRL deviates from the reference the test's docstring says so.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.data import Composite, Unbounded
from torchrl.envs.model_based import DreamerEnv
from torchrl.modules import WorldModelWrapper
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ModelLoss, DreamerV3ValueLoss, SoftUpdate
from torchrl.objectives.utils import ValueEstimators

from dreamer_racing.losses import LossConfig, WorldModelLoss, critic_loss, replay_critic_loss
from dreamer_racing.modules import SIZES, Critic, Interface, WorldModel, join_features
from dreamer_racing.modules.agent import Agent
from tests.dreamers import imagine_from, learner_of, make_windows

SIZE = SIZES["debug"]
HORIZON = 333
DISCOUNT = 1 - 1 / HORIZON
TOLERANCE = {"rtol": 1e-5, "atol": 1e-5}


def stir(agent: Agent) -> Agent:
    """Make every head predict something moderate of its own; fresh two-hot heads all say zero."""
    for head in (agent.world_model.reward_head, agent.critic.head, agent.critic.slow_head):
        bins = len(head.two_hot.values)
        with torch.no_grad():
            head.mlp.output.weight.normal_(std=0.5)
            head.mlp.output.bias.copy_(-0.5 * (torch.arange(bins) - bins // 2 - torch.randn(())).abs())
    with torch.no_grad():
        agent.actor.mlp.output.weight.mul_(100.0)
        agent.world_model.continue_head.mlp.output.bias.fill_(3.0)
    return agent


def make_agent() -> Agent:
    torch.manual_seed(0)
    return stir(Agent(SIZE, Interface()))


def make_batch(crashes: bool = False) -> TensorDict:
    """Records with a reset in the middle, a cut that only the next reset shows, and maybe crashes."""
    places = {"is_init": [(0, 0), (1, 3), (2, 5)], "truncated": [(1, 2)]}
    return make_windows(3, 7, **places, terminated=[(2, 4), (0, 6)] if crashes else [])


def stock_batch(batch: TensorDict) -> TensorDict:
    """The same records under TorchRL's keys: a record is what lies under ``next``, its first action at the root."""
    followed_by_init = torch.cat((batch["is_init"][:, 1:], torch.zeros_like(batch["is_init"][:, :1])), 1)
    record = batch.select("pixels", "reward", "terminated")
    record["done"] = batch["terminated"] | batch["truncated"] | followed_by_init
    return TensorDict(
        {"action": batch["previous_action"], "is_init": batch["is_init"], "next": record}, batch.batch_size
    )


class StockWorldModel(nn.Module):
    """Our world model with the keys of ``DreamerV3ModelLoss``."""

    def __init__(self, world_model: WorldModel) -> None:
        super().__init__()
        self.world_model = world_model

    def forward(self, tensordict: TensorDict) -> TensorDict:
        seen = tensordict["next"]
        posterior = self.world_model.observe(seen, tensordict["action"], tensordict["is_init"].squeeze(-1))
        features = join_features(posterior.belief, posterior.state)
        predicted = {
            **posterior._asdict(),
            "reco_pixels": self.world_model.decoder(posterior.belief, posterior.state),
            "reward_logits": self.world_model.reward_head(features),
            "continue_pred": self.world_model.continue_head(features),
        }
        for key, value in predicted.items():
            tensordict["next", key] = value
        return tensordict


class OnFeatures(nn.Module):
    """A function of a head and the features; TorchRL copies it, and swaps the head's parameters."""

    def __init__(self, head: nn.Module, function: Callable[[Any, Tensor], Any]) -> None:
        super().__init__()
        self.head = head
        self.function = function

    def forward(self, belief: Tensor, state: Tensor) -> Any:
        return self.function(self.head, join_features(belief, state))


def on_features(head: nn.Module, function: Callable[[Any, Tensor], Any], *out_keys: str) -> TensorDictModule:
    return TensorDictModule(OnFeatures(head, function), in_keys=["belief", "state"], out_keys=[*out_keys])


class StockContinuation(TensorDictModule):
    """Continuation as we define it: true at the starts, predicted after them; TorchRL predicts that of the starts too.

    ``DreamerV3ActorLoss`` first asks for the starts, then for all that follow.
    """

    def __init__(self, world_model: WorldModel, terminated: Tensor | None = None) -> None:
        super().__init__(world_model.continue_head, in_keys=["belief", "state"], out_keys=["continuation"])
        self.terminated = terminated
        self.asked = 0

    def forward(self, tensordict: TensorDict) -> TensorDict:
        features = join_features(tensordict["belief"], tensordict["state"])
        probability = self.module.probability(features)
        if self.asked == 0:
            probability = torch.ones_like(probability)
            if self.terminated is not None:
                probability = 1.0 - self.terminated.float().view_as(probability)
        self.asked += 1
        return tensordict.set("continuation", probability)


def stock_environment(world_model: WorldModel) -> DreamerEnv:
    """Our dynamics and reward head as TorchRL's imagination environment."""

    class Transition(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            # Before the RSSM's own parameter, which is fixed: TorchRL holds out a network only if its first one is not.
            self.cell = world_model.rssm.cell
            self.rssm = world_model.rssm

        def forward(self, belief: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            return self.rssm.imagine_step(belief, state, action)

    environment = DreamerEnv(
        WorldModelWrapper(
            TensorDictModule(Transition(), in_keys=["belief", "state", "action"], out_keys=["belief", "state"]),
            on_features(world_model.reward_head, lambda head, features: head.mean(features), "reward"),
        ),
        prior_shape=(SIZE.state,),
        belief_shape=(SIZE.belief,),
    )
    environment.observation_spec = Composite(state=Unbounded(SIZE.state), belief=Unbounded(SIZE.belief))
    environment.state_spec = environment.observation_spec.clone()
    environment.action_spec = Unbounded((4,))
    environment.reward_spec = Unbounded((1,))
    return environment


def stock_model_loss(world_model: WorldModel, **options) -> DreamerV3ModelLoss:
    return DreamerV3ModelLoss(
        StockWorldModel(world_model), **{"kl_mode": "separate", "unimix": 0.01} | options,
        lambda_continue=1.0, reco_symlog=False, detach_output=False,
    )  # fmt: skip


def stock_value(critic: Critic) -> TensorDictModule:
    return on_features(
        critic.head, lambda head, features: (head(features), head.mean(features)), "state_value_logits", "state_value"
    )


def stock_actor_loss(agent: Agent, terminated: Tensor | None = None, **options) -> DreamerV3ActorLoss:
    actor = ProbabilisticTensorDictSequential(
        on_features(agent.actor, lambda actor, features: tuple(actor(features)), "loc", "scale"),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=lambda loc, scale: Independent(Normal(loc, scale), 1),
        ),
    )
    loss = DreamerV3ActorLoss(
        actor,
        stock_value(agent.critic),
        stock_environment(agent.world_model),
        continuation_model=StockContinuation(agent.world_model, terminated),
        **{"imagination_horizon": 5, "use_reinforce": True} | options,
    )
    loss.make_value_estimator(ValueEstimators.TDLambda, gamma=DISCOUNT, lmbda=0.95)
    return loss


def stock_value_loss(critic: Critic, slow_scale: float = 1.0) -> DreamerV3ValueLoss:
    loss = DreamerV3ValueLoss(stock_value(critic), "two_hot", slow_critic_regularization=slow_scale)
    SoftUpdate(loss, tau=0.02)
    for key, parameter in critic.slow_head.named_parameters():
        loss.target_value_model_params["module", "head", *key.split(".")].data.copy_(parameter)
    return loss


def gradients(module: nn.Module) -> dict[str, Tensor]:
    return {name: parameter.grad for name, parameter in module.named_parameters() if parameter.grad is not None}


def assert_same_gradients(ours: nn.Module, stock: nn.Module, rtol: float = 1e-4) -> None:
    """Compare all gradients, within a share of each tensor's largest entry."""
    expected, found = gradients(stock), gradients(ours)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name], rtol=rtol, atol=rtol * expected[name].abs().max().item())


PAIRS = {
    "loss_image": "loss_model_reco",
    "loss_reward": "loss_model_reward",
    "loss_continue": "loss_model_continue",
    "loss_dynamics": "loss_model_dynamic",
    "loss_representation": "loss_model_representation",
}
"""Our losses of the world model, and TorchRL's."""


def assert_same_losses(ours: Mapping[str, Tensor], stock: TensorDict, pairs: Mapping[str, str]) -> None:
    """Compare losses, and make the gradients of their sums."""
    for key, stock_key in pairs.items():
        torch.testing.assert_close(ours[key], stock[stock_key].squeeze(), **TOLERANCE)
    sum(ours[key] for key in pairs).backward()
    sum(stock[key] for key in pairs.values()).backward()


def assert_same_critic_gradients(critic: Critic, oracle: DreamerV3ValueLoss) -> None:
    found = gradients(oracle.value_model_params)
    for name, gradient in gradients(critic.head).items():
        torch.testing.assert_close(gradient, found[f"module.head.{name}"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("free_nats", [0.0, 1.0])
def test_world_model_loss(free_nats):
    agent, batch = make_agent(), make_batch(crashes=True)
    ours, stock = agent.world_model, copy.deepcopy(agent.world_model)
    torch.manual_seed(2)
    losses, latents = WorldModelLoss(agent, LossConfig(free_nats=free_nats))(batch)
    torch.manual_seed(2)
    expected, posterior = stock_model_loss(stock, free_bits=free_nats)(stock_batch(batch))
    assert_same_losses(losses, expected, PAIRS)
    torch.testing.assert_close(latents.belief, posterior["next", "belief"])
    assert losses["kl"] > 0.1
    assert_same_gradients(ours, stock)


def make_starts(count: int = 12) -> TensorDict:
    torch.manual_seed(3)
    state = torch.nn.functional.one_hot(torch.randint(4, (count, SIZE.latents)), SIZE.classes).float().flatten(1)
    terminated = torch.zeros(count, 1, dtype=torch.bool)
    terminated[4] = True
    return TensorDict({"belief": torch.randn(count, SIZE.belief), "state": state, "terminated": terminated}, [count])


@pytest.mark.parametrize("entropy_scale", [3e-4, 0.3])
@pytest.mark.parametrize("actor", ["reinforce", "dynamics"])
def test_actor_loss(actor, entropy_scale):
    """Imagination, λ-returns, weights, return range, estimator and entropy at once.

    Two updates: the second meets a moved return range.
    """
    learner, starts = (
        learner_of(seed=0, horizon=5, discount=DISCOUNT, entropy_scale=entropy_scale, actor=actor),
        make_starts(),
    )
    stock = copy.deepcopy(stir(learner.agent))
    use_reinforce = actor == "reinforce"
    oracle = stock_actor_loss(stock, starts["terminated"], use_reinforce=use_reinforce, entropy_bonus=entropy_scale)
    for module in (learner.return_range, oracle.retnorm):
        module.high.fill_(2.5)  # above the floor, which would hide a wrong range
    for _ in range(2):
        torch.manual_seed(4)
        losses, trajectory = imagine_from(learner, *starts.values())
        torch.manual_seed(4)
        oracle.__dict__["continuation_model"].asked = 0
        expected, imagined = oracle(starts)
        torch.testing.assert_close(losses["loss_actor"], expected["loss_actor"], **TOLERANCE)
        torch.testing.assert_close(losses["return_scale"], expected["return_scale"], **TOLERANCE)
        torch.testing.assert_close(losses["continuation"], expected["continuation_mean"], **TOLERANCE)
        for value, key in ((trajectory.lambda_return, "lambda_target"), (trajectory.weight, "discount_weight")):
            torch.testing.assert_close(value.transpose(0, 1), imagined[key], **TOLERANCE)
        assert losses["return_scale"] > 1.5
    losses["loss_actor"].backward()
    expected["loss_actor"].backward()
    assert_same_gradients(learner.agent.actor, stock.actor)


def test_return_range_is_the_moving_percentiles_with_a_floor_of_one():
    """By hand, as TorchRL's normaliser is the one in use: no debiasing, from zero, 5th to 95th percentile."""
    learner = learner_of(seed=0, horizon=5, return_decay=0.5)
    stir(learner.agent)
    low = high = 0.0
    scales = []
    for seed in range(4):
        torch.manual_seed(seed)
        losses, trajectory = imagine_from(learner, *make_starts().values())
        returns = trajectory.lambda_return.numpy()
        low = 0.5 * low + 0.5 * np.quantile(returns, 0.05)
        high = 0.5 * high + 0.5 * np.quantile(returns, 0.95)
        scales.append(max(1.0, high - low))
        assert losses["return_scale"].item() == pytest.approx(scales[-1], rel=1e-5)
    assert scales[-1] > 1.0


def make_critic_input(batch: TensorDict) -> TensorDict:
    torch.manual_seed(5)
    shape = batch.batch_size
    imagination = TensorDict(
        {
            "features": torch.randn(5, 12, SIZE.features),
            "lambda_return": torch.randn(5, 12, 1) * 4,
            "weight": torch.rand(5, 12, 1),
        },
        [5, 12],
    )
    replay = batch.select("reward", "is_init", "terminated", "truncated")
    latents = {"belief": torch.randn(*shape, SIZE.belief), "state": torch.rand(*shape, SIZE.state)}
    return TensorDict({**replay, **latents, "bootstrap": torch.randn(*shape, 1) * 4, "imagination": imagination}, [])


def stock_replay(inputs: TensorDict, batch: TensorDict) -> TensorDict:
    replay = TensorDict(
        {**inputs.select("belief", "state"), "bootstrap": inputs["bootstrap"].squeeze(-1)}, batch.batch_size
    )
    replay["next"] = stock_batch(batch)["next"].select("reward", "done", "terminated")
    return replay


@pytest.mark.parametrize("slow_scale", [1.0, 0.3])
def test_critic_loss(slow_scale):
    """Imagined part: two-hot regression on returns and on the slow copy, weighted; with gradients."""
    agent = make_agent()
    stock = copy.deepcopy(agent.critic)
    inputs = make_critic_input(make_batch())
    imagination = inputs["imagination"]
    regression, _ = critic_loss(agent.critic, imagination["features"], imagination["lambda_return"], slow_scale)
    loss = (imagination["weight"] * regression).mean()
    belief, state = imagination["features"].split([SIZE.belief, SIZE.state], -1)
    stock_imagination = {"lambda_target": imagination["lambda_return"], "discount_weight": imagination["weight"]}
    oracle = stock_value_loss(stock, slow_scale)
    expected, _ = oracle(TensorDict({"belief": belief, "state": state, **stock_imagination}, [5, 12]))
    torch.testing.assert_close(loss, expected["loss_value"], **TOLERANCE)
    loss.backward()
    expected["loss_value"].backward()
    assert_same_critic_gradients(agent.critic, oracle)


def replay_losses(batch: TensorDict) -> tuple[Agent, TensorDict, DreamerV3ValueLoss, Tensor, Tensor]:
    """Agent, latents, TorchRL's loss module, and our and its loss of replayed returns."""
    agent = make_agent()
    inputs = make_critic_input(batch)
    features = join_features(inputs["belief"], inputs["state"])
    ours = replay_critic_loss(agent.critic, features, batch, torch.tensor(DISCOUNT), 0.95, 1.0, inputs["bootstrap"])
    oracle = stock_value_loss(copy.deepcopy(agent.critic))
    expected = oracle.replay_value_loss(stock_replay(inputs, batch), horizon=HORIZON, lmbda=0.95)["loss_replay_value"]
    return agent, inputs, oracle, ours, expected


def test_replay_critic_loss_without_crashes():
    """TorchRL and the reference average over the T − 1 records that have a next one, we over all T."""
    *_, ours, expected = replay_losses(make_batch())
    torch.testing.assert_close(7 * ours, 6 * expected, **TOLERANCE)


def test_replay_critic_loss_with_crashes():
    """TorchRL leaves out records that end an episode; we teach the critic that a crash is worth zero from there on."""
    batch = make_batch(crashes=True)
    agent, inputs, oracle, ours, expected = replay_losses(batch)
    features = join_features(inputs["belief"], inputs["state"])[batch["terminated"].squeeze(-1)]
    log_probabilities = agent.critic(features).log_softmax(-1)
    slow_value = agent.critic.slow_value(features)
    targets = (oracle._step_value_loss(log_probabilities, target) for target in (torch.zeros(2), slow_value[..., 0]))
    torch.testing.assert_close(3 * 7 * ours, 3 * 6 * expected + sum(targets).sum(), **TOLERANCE)


@pytest.mark.parametrize("actor_loss", ["reinforce", "dynamics"])
def test_whole_objective(actor_loss):
    """One update's losses and the gradient of every parameter against ``DreamerV3Loss``, end to end."""
    config = {"horizon": 5, "discount": DISCOUNT, "actor": actor_loss}
    learner, batch = learner_of(seed=0, **config), make_batch()
    torch.manual_seed(0)
    stir(learner.agent)
    stock = copy.deepcopy(learner.agent)
    actor = stock_actor_loss(stock, use_reinforce=actor_loss == "reinforce")
    oracle = DreamerV3Loss(
        stock_model_loss(stock.world_model),
        actor,
        stock_value_loss(stock.critic),
        replay_value_loss_weight=LossConfig.replay_value_scale * 6 / 7,  # as in test_replay_critic_loss_without_crashes
        continuation_horizon=HORIZON,
    )
    torch.manual_seed(6)
    losses = learner.compute_losses(batch)
    torch.manual_seed(6)
    expected = oracle(stock_batch(batch))
    pairs = PAIRS | {
        "loss_actor": "loss_actor",
        "loss_critic": "loss_value",
        "loss_replay_critic": "loss_replay_value",
    }
    assert {key for key in losses if key.startswith("loss_")} == pairs.keys()
    assert {key for key in expected.keys() if key.startswith("loss_")} == set(pairs.values())  # noqa: SIM118
    assert_same_losses(losses, expected, pairs)
    for name in ("world_model", "actor"):
        assert_same_gradients(getattr(learner.agent, name), getattr(stock, name))
    assert_same_critic_gradients(learner.agent.critic, oracle.value_loss)
