"""Which loss trains which network, and nothing else."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import TARGETS
from dreamer_racing.losses.policy import frozen
from dreamer_racing.modules import Interface
from tests.dreamers import imagine_from, learner_by, make_windows

PRIVILEGED_DIM = 5
CONFIG = {"learning_rate": 1e-3, "warmup_updates": 0, "free_nats": 0.0}


def make_batch() -> TensorDict:
    places = {"is_init": [(0, 2), (1, 3), (2, 0)], "terminated": [(0, 1)], "truncated": [(1, 2)]}
    return make_windows(3, 5, **places, privileged=PRIVILEGED_DIM)


def make_learner(actor: str = "reinforce", **options) -> WorldModelLearner:
    learner = learner_by(actor, "debug", Interface(privileged_dim=PRIVILEGED_DIM), **CONFIG | options)
    torch.manual_seed(0)
    # Two-hot heads are zero at first, which would hide what lies below them.
    for head in (learner.agent.world_model.reward_head, learner.agent.critic.head):
        with torch.no_grad():
            head.mlp.output.weight.normal_(std=0.1)
    return learner


def reached(module: nn.Module) -> set[str]:
    """Names of the parameters that a gradient other than zero has reached."""
    return {
        name
        for name, parameter in module.named_parameters()
        if parameter.grad is not None and parameter.grad.abs().sum() > 0
    }


def trainable(module: nn.Module) -> set[str]:
    return {name for name, parameter in module.named_parameters() if parameter.requires_grad}


def untouched(module: nn.Module) -> bool:
    return all(parameter.grad is None for parameter in module.parameters())


@pytest.mark.parametrize("name", TARGETS)
def test_world_model_loss_trains_all_of_the_world_model_and_nothing_else(name):
    learner = make_learner(world_model=name)
    losses, _ = learner.world_model_loss(make_batch())
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert reached(learner.agent.world_model) == trainable(learner.agent.world_model)
    assert reached(learner.world_model_loss) == trainable(learner.world_model_loss)
    assert untouched(learner.agent.actor)
    assert untouched(learner.agent.critic)


def make_starts() -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    return torch.randn(6, 32, requires_grad=True), torch.rand(6, 16, requires_grad=True)


@pytest.mark.parametrize("name", ["reinforce", "dynamics"])
def test_actor_loss_trains_all_of_the_actor_and_nothing_else(name):
    learner, (belief, state) = make_learner(name), make_starts()
    agent = learner.agent
    losses, trajectory = imagine_from(learner, belief, state)
    losses["loss_actor"].backward()
    assert reached(agent.actor) == trainable(agent.actor)
    assert untouched(agent.world_model)
    assert untouched(agent.critic)
    assert belief.grad is None and state.grad is None
    assert not any(value.requires_grad for value in (trajectory.features, trajectory.weight, trajectory.advantage))
    assert not any(value.requires_grad for key, value in losses.items() if not key.startswith("loss_"))


def test_dynamics_gradient_comes_through_the_model_and_reinforce_does_without():
    """Without entropy, only the gradient through the dynamics needs a reward that depends on the action."""
    for name, expected in (("dynamics", False), ("reinforce", True)):
        learner = make_learner(actor=name, entropy_scale=0.0, continuation=False)
        cell = learner.agent.world_model.rssm.cell
        cell.project_action = lambda action, project=cell.project_action: project(action.detach())
        imagine_from(learner, *make_starts())[0]["loss_actor"].backward()
        assert bool(reached(learner.agent.actor)) == expected


def behaviour_losses(learner: WorldModelLearner) -> dict[str, Tensor]:
    """The losses of actor and critic on latents that carry the world model's graph."""
    losses = learner.compute_losses(make_batch())
    return {key: losses[key] for key in losses.keys() & {"loss_actor", "loss_critic", "loss_replay_critic"}}


@pytest.mark.parametrize("actor", ["reinforce", "dynamics", "latent_ppo"])
def test_replayed_returns_train_the_world_model_only_if_asked_to(actor):
    learner = make_learner(actor, replay_value_gradient=False)
    sum(behaviour_losses(learner).values()).backward()
    assert untouched(learner.agent.world_model)

    learner = make_learner(actor, replay_value_gradient=True)
    behaviour_losses(learner)["loss_replay_critic"].backward()
    found = reached(learner.agent.world_model)
    # What makes the latents, not what is predicted from them.
    assert {name.split(".")[0] for name in found} == {"encoder", "rssm"}
    assert not any(name.startswith("rssm.prior") for name in found)


@pytest.mark.parametrize("shared", [True, False])
def test_slow_critic_never_gets_a_gradient(shared):
    learner = make_learner(replay_value_gradient=shared)
    losses = learner.compute_losses(make_batch())
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    critic = learner.agent.critic
    assert untouched(critic.slow_head)
    assert reached(critic.head) == trainable(critic.head)
    optimized = {id(parameter) for group in learner.optimizer.param_groups for parameter in group["params"]}
    assert optimized.isdisjoint(map(id, critic.slow_head.parameters()))


def test_targets_of_the_critic_carry_no_gradient():
    """Returns and values that the critic is taught are numbers: nothing flows through them."""
    learner = make_learner(actor="dynamics")
    losses = behaviour_losses(learner)
    losses["loss_critic"].backward()
    assert untouched(learner.agent.actor)
    assert untouched(learner.agent.world_model)


def test_embedding_is_a_fixed_target_of_the_decoder_free_loss():
    """The loss reaches the encoder through the latents alone."""
    torch.manual_seed(0)
    learner, batch = make_learner(world_model="decoder_free"), make_batch()
    world_model, loss = learner.agent.world_model, learner.world_model_loss.targets["Barlow"]
    embedding = world_model.encoder(batch).detach().requires_grad_()
    features = torch.randn(3, 5, world_model.size.features, requires_grad=True)
    loss(None, features, embedding, batch)["loss_barlow"].backward()
    assert embedding.grad is None
    assert features.grad.abs().sum() > 0
    assert loss.projector.weight.grad.abs().sum() > 0
    assert untouched(world_model)

    learner.world_model_loss(batch)[0]["loss_barlow"].backward()
    assert reached(world_model.encoder) == trainable(world_model.encoder)
    assert untouched(world_model.reward_head)


@pytest.mark.parametrize(("name", "own"), [("privileged", "State"), ("informed", "State"), ("decoder_free", "Barlow")])
def test_parameters_of_a_loss_are_trained_and_saved(name, own):
    learner = make_learner(world_model=name)
    shared = set(map(id, learner.agent.parameters()))
    module = learner.world_model_loss.targets[own]
    before = {name: p.detach().clone() for name, p in module.named_parameters() if id(p) not in shared}
    for _ in range(2):
        learner.update(make_batch())
    parameters = dict(module.named_parameters())
    assert before and not any(torch.equal(old, parameters[name]) for name, old in before.items())

    restored = make_learner(world_model=name)
    restored.load_state_dict(learner.state_dict())
    loaded = dict(restored.world_model_loss.targets[own].named_parameters())
    assert all(torch.equal(parameters[name], loaded[name]) for name in before)


def test_frozen_lets_gradient_through_and_restores_every_flag():
    module = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 1))
    module[0].bias.requires_grad_(False)
    flags = [parameter.requires_grad for parameter in module.parameters()]
    inputs = torch.ones(1, 2, requires_grad=True)
    with frozen(module, nn.Linear(1, 1)):
        assert not any(parameter.requires_grad for parameter in module.parameters())
        output = module(inputs)
    assert [parameter.requires_grad for parameter in module.parameters()] == flags
    output.sum().backward()
    assert inputs.grad.abs().sum() > 0
    assert untouched(module)
    with pytest.raises(RuntimeError, match="out of memory"), frozen(module):
        raise RuntimeError("out of memory")
    assert [parameter.requires_grad for parameter in module.parameters()] == flags
