import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.gradient_step import NonFiniteLossError, gradient_norms
from dreamer_racing.learners.learner import seeded
from dreamer_racing.losses import TARGETS, DreamerV3Losses, Target
from dreamer_racing.losses.world_model import Image
from dreamer_racing.modules import SIZES, Agent, Interface
from dreamer_racing.modules.interface import PRIVILEGED
from tests.dreamers import differing, imagine_from, latent_ppo_of, learner_of, make_windows

CONFIG = {"horizon": 4, "learning_rate": 1e-3, "warmup_updates": 0}


def make_batch(batch: int = 3, time: int = 6) -> TensorDict:
    """Windows of a bar that moves, with a crash, a truncation and the resets that follow them."""
    places = {"is_init": [(0, 3), (1, 4), (2, 0)], "terminated": [(0, 2)], "truncated": [(1, 3)]}
    windows, generator = make_windows(batch, time, **places), torch.Generator().manual_seed(0)
    action = torch.rand(batch, time, 4, generator=generator) * 2 - 1
    reward = torch.randn(batch, time, 1, generator=generator)
    for key, value in (("previous_action", action), ("reward", reward)):
        windows[key] = value.masked_fill(windows["is_init"], 0.0)
    windows["pixels"].zero_()
    for step in range(time):
        windows["pixels"][:, step, 8 * step : 8 * step + 16, 10:30] = 200
    return windows


def test_update_returns_scalar_tensors_and_moves_every_network():
    learner = learner_of(seed=0, **CONFIG)
    before = copy.deepcopy(learner.agent.state_dict())
    batch = make_batch()
    metrics = learner.update(batch)
    metrics = learner.update(batch)
    for key, value in metrics.items():
        assert value.shape == (), key
        assert not value.requires_grad, key
        assert value.isfinite(), key
    expected = {"loss", "loss_image", "kl", "entropy", "return_scale", "return_mean", "reward_error", "image_error"}
    assert expected < metrics.keys()
    assert {f"gradient_norm/{name}" for name in ("world_model", "actor", "critic")} < metrics.keys()
    still = {name for name in before if name.endswith(("initial_belief", "min_std", "max_std"))}
    assert differing(learner.agent.state_dict(), before) == before.keys() - still


def test_losses_fall_on_a_fixed_batch():
    torch.manual_seed(0)
    learner = learner_of(seed=0, **CONFIG | {"learning_rate": 3e-3})
    batch = make_batch()
    first = learner.update(batch)
    for _ in range(100):
        last = learner.update(batch)
    assert last["image_error"] < 0.4 * first["image_error"]
    assert last["loss_reward"] < 0.5 * first["loss_reward"]
    assert last["loss_continue"] < 0.5 * first["loss_continue"]
    assert last["loss_critic"] < math.log(255) - 0.5, "better than knowing nothing of where returns lie"


def test_resume_equals_never_having_stopped():
    batch = make_batch()
    learner = learner_of(seed=0, **CONFIG)
    learner.update(batch)
    learner.return_range.high.fill_(7.0)  # it weighs what the next updates learn
    saved = copy.deepcopy(learner.state_dict())
    resumed = learner_of(seed=1, **CONFIG)
    resumed.load_state_dict(saved)
    assert resumed.updates == 1
    results = []
    for each in (learner, resumed):
        torch.manual_seed(5)
        results.append([each.update(batch) for _ in range(2)][-1])
    assert not differing(*results)
    assert not differing(learner.agent.state_dict(), resumed.agent.state_dict())


@pytest.mark.parametrize("actor", ["reinforce", "dynamics"])
def test_the_actor_begins_after_so_many_updates(actor):
    learner = learner_of(actor=actor, actor_begin=2, seed=0, **CONFIG)
    first = [parameter.clone() for parameter in learner.agent.actor.parameters()]
    for begun in (False, False, True):
        learner.update(make_batch())
        moved = [not torch.equal(a, b) for a, b in zip(first, learner.agent.actor.parameters(), strict=True)]
        assert any(moved) == begun


@pytest.mark.parametrize(
    ("actor", "changed"),
    [("reinforce", {"actor_begin": 30}), ("dynamics", {"actor_begin": 30}), ("dynamics", {"imagination_every": 3})],
)
def test_the_actor_begins_with_steps_no_larger_than_those_of_one_that_learns_in_every_update(actor, changed):
    first_steps = []
    for waits in ({}, changed):
        learner = learner_of(actor=actor, seed=0, **CONFIG | waits)
        world_model, _, critic = learner.optimizer.param_groups
        world_model["lr"] = critic["lr"] = 0.0  # they stay, so that gradients do
        batch = make_batch()
        every = waits.get("imagination_every", 1)
        for _ in range(30 * every):
            learner.update(batch)
        before = [parameter.clone() for parameter in learner.agent.actor.parameters()]
        for _ in range(3 * every):
            learner.update(batch)
        after = learner.agent.actor.parameters()
        first_steps.append(sum((a - b).square().sum() for a, b in zip(after, before, strict=True)).sqrt())
    assert first_steps[1] < 1.1 * first_steps[0]


def test_a_checkpoint_whose_optimiser_had_one_group_for_actor_and_critic_goes_on():
    batch, learner = make_batch(), learner_of(seed=0, **CONFIG)
    learner.update(batch)
    saved = copy.deepcopy(learner.state_dict())
    world_model, actor, critic = saved["optimizer"]["param_groups"]
    joint = {**actor, "params": actor["params"] + critic["params"]}
    saved["optimizer"]["param_groups"] = [world_model, joint]
    resumed = learner_of(seed=1, **CONFIG)
    resumed.load_state_dict(saved)
    for each in (learner, resumed):
        torch.manual_seed(5)
        each.update(batch)
    assert not differing(learner.agent.state_dict(), resumed.agent.state_dict())
    assert [group["step"] for group in resumed.optimizer.param_groups] == [2, 2, 2]


def test_what_is_turned_off_is_not_computed():
    learner = learner_of(seed=0, replay_value_scale=0.0, **CONFIG)
    assert "loss_replay_critic" not in learner.update(make_batch())


def test_a_metric_of_an_own_objective_is_not_taken_for_a_loss():
    learner = learner_of(seed=0, **CONFIG)
    objective = learner.objective
    learner.objective = lambda *values, **numbers: (objective(*values, **numbers)[0], {"loss_of_mine": torch.ones(())})
    with pytest.raises(ValueError, match="the metric 'loss_of_mine' would be added to the losses: rename it"):
        learner.update(make_batch())


def made_with(seed, loss="reconstruction", **interface):
    if any(PRIVILEGED in target.reads for target in TARGETS[loss]):
        interface["privileged_dim"] = 21
    return learner_of("debug", Interface(**interface), seed=seed, **CONFIG | {"world_model": loss})


def assert_refused(saved, learner, words):
    before = copy.deepcopy(learner.state_dict())
    with pytest.raises(ValueError, match=words) as error:
        learner.load_state_dict(saved.state_dict())
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
    after = learner.state_dict()
    assert not differing(before["agent"], after["agent"])
    for name, own in before["own_networks"].items():
        assert not differing(own, after["own_networks"][name]), name
    assert after["updates"] == 0


def test_state_of_another_size_is_refused_with_what_to_do():
    other = learner_of(replace(SIZES["debug"], name="wider", units=32), **CONFIG)
    assert_refused(learner_of(**CONFIG), other, r"'debug'.*'wider'.*units 16 there, 32 here.*model=debug")


OTHER_LOSS, OTHER_IMAGES = (
    "in addition, and lacks .* trained with another loss",
    "images of 32 × 32 pixels, not 96 × 96",
)
NUMBERS = {"pixels": False, "vector_dim": 21}


@pytest.mark.parametrize(
    ("there", "here", "words"),
    [
        ({"loss": "privileged"}, {}, OTHER_LOSS),
        ({}, {"loss": "privileged"}, OTHER_LOSS),
        ({"loss": "decoder_free"}, {"loss": "reward_only"}, OTHER_LOSS),
        ({"loss": "reward_only"}, {"loss": "decoder_free"}, OTHER_LOSS),
        ({"loss": "informed"}, {"loss": "privileged"}, OTHER_LOSS),
        ({"loss": "privileged"}, {"loss": "informed"}, OTHER_LOSS),
        ({"action_dim": 6}, {}, "observations"),
        (NUMBERS, {}, "observations"),
        (NUMBERS, NUMBERS | {"vector_dim": 9}, "observations"),
        ({"image_size": 32}, {"image_size": 96}, OTHER_IMAGES),
        ({"loss": "decoder_free", "image_size": 32}, {"loss": "decoder_free", "image_size": 96}, OTHER_IMAGES),
    ],
    ids=str,
)
def test_state_of_another_loss_or_environment_is_refused(there, here, words):
    saved = made_with(1, **there)
    saved.updates = 7
    assert_refused(saved, made_with(2, **here), words)


def test_names_and_shapes_of_networks_stay_those_that_agents_ship_with():
    """Of all that depends on the images' size."""
    shapes = {key: list(value.shape) for key, value in learner_of(**CONFIG).agent.named_parameters() if value.ndim > 1}
    expected = {
        "encoder.encoders.pixels.convolutions.0.weight": [2, 12, 4, 4],
        "encoder.encoders.pixels.convolutions.1.weight": [4, 2, 4, 4],
        "encoder.encoders.pixels.convolutions.2.weight": [8, 4, 4, 4],
        "rssm.posterior_hidden.second.weight": [16, 128],
        "decoder.projection.linear.weight": [128, 48],
        "decoder.convolutions.0.weight": [8, 4, 4, 4],
        "decoder.convolutions.1.weight": [4, 2, 4, 4],
        "decoder.convolutions.2.weight": [2, 12, 4, 4],
    }
    assert {key: shapes[f"world_model.{key}"] for key in expected} == expected
    assert not [key for key in shapes if ".encoder." in key or ".decoder." in key if key[12:] not in expected]


def watch(learner):
    """The trajectories that the learner's objective sees from here on."""
    seen, objective = [], learner.objective
    learner.objective = lambda trajectory, **numbers: seen.append(trajectory) or objective(trajectory, **numbers)
    return seen


def test_imagination_may_start_from_a_subset():
    learner = learner_of(seed=0, **CONFIG | {"imagination_starts": 5})
    seen = watch(learner)
    metrics = learner.update(make_batch())
    assert seen[0].weight.shape == (4, 5, 1)
    assert metrics["loss_replay_critic"].isfinite()


def test_between_imaginations_the_world_model_and_the_critic_learn_but_not_the_actor():
    learner = learner_of(seed=0, **CONFIG | {"imagination_every": 2})
    learner.update(make_batch())  # imagines
    seen, before = watch(learner), copy.deepcopy(learner.agent)
    metrics = learner.update(make_batch())
    assert not seen
    assert not {"loss_actor", "loss_critic", "gradient_norm/actor"} & metrics.keys()
    same = {
        name: all(map(torch.equal, network.parameters(), getattr(before, name).parameters()))
        for name, network in learner.agent.named_children()
    }
    assert same == {"world_model": False, "actor": True, "critic": False}
    assert "loss_actor" in learner.update(make_batch())
    assert len(seen) == 1


def test_a_cuda_graph_cannot_leave_imagination_out_of_some_updates():
    with pytest.raises(ValueError, match=r"imagination_every=2 with cuda_graph=True.*imagination_every=1, or"):
        learner_of(seed=0, **CONFIG | {"imagination_every": 2, "cuda_graph": True})


def test_every_record_is_a_start_that_knows_its_action_and_has_no_weight_if_terminal():
    """The action before the first step led to the record; before the others it is the policy's, as it was clipped."""
    learner, batch = learner_of(seed=0, **CONFIG), make_batch()
    seen = watch(learner)
    learner.update(batch)
    (trajectory,) = seen
    weight = trajectory.weight.view(4, 3, 6)
    assert torch.equal(weight[0], 1.0 - batch["terminated"].squeeze(-1).float())
    assert torch.equal(weight[:, 0, 2], torch.zeros(4)), "however sure the model is that the episode goes on"
    assert torch.equal(trajectory.previous_action[0], batch["previous_action"].flatten(0, 1))
    assert torch.equal(trajectory.previous_action[1:], trajectory.action[:-1].clamp(-1.0, 1.0))


def spoil_reward(value):
    return lambda batch, learner: batch["reward"][0, 1].fill_(value)


def spoil_gradient(batch, learner):
    weight = next(learner.agent.critic.head.parameters())
    weight.register_hook(lambda gradient: gradient * math.inf)


@pytest.mark.parametrize(
    "spoil",
    [spoil_reward(math.nan), spoil_reward(math.inf), spoil_reward(-math.inf), spoil_gradient],
    ids=["nan", "inf", "-inf", "gradient"],
)
def test_what_would_spoil_the_networks_is_refused(spoil):
    learner = learner_of(seed=0, **CONFIG)
    before, batch = copy.deepcopy(learner.agent.state_dict()), make_batch()
    spoil(batch, learner)
    with pytest.raises(NonFiniteLossError, match="not finite") as error:
        learner.update(batch)
    assert error.value.batch["reward"].shape == (3, 6, 1)
    assert learner.updates == 0
    assert not differing(learner.agent.state_dict(), before)
    if spoil is not spoil_gradient:  # which stays spoilt
        learner.update(make_batch())
        assert learner.updates == 1 and differing(learner.agent.state_dict(), before)


@pytest.mark.parametrize(
    ("recurrence", "norm"), [("block", "rms"), ("block", "layer"), ("dense", "rms"), ("dense", "layer")]
)
def test_mixed_precision_is_close_to_full(recurrence, norm):
    size = replace(SIZES["debug"], name="variant", recurrence=recurrence, blocks=2, norm=norm)
    results = []
    for mixed_precision in (False, True):
        learner = learner_of(size, seed=0, **CONFIG | {"mixed_precision": mixed_precision})
        torch.manual_seed(0)
        results.append(learner.update(make_batch()))
        assert all(parameter.dtype == torch.float32 for parameter in learner.agent.parameters())
        assert all(value.dtype == torch.float32 and value.isfinite() for value in results[-1].values())
    assert not torch.equal(results[0]["loss"], results[1]["loss"]), "nothing was computed in bfloat16"
    torch.testing.assert_close(results[0]["loss"], results[1]["loss"], rtol=1e-2, atol=0)


def test_rates_are_the_settings_of_the_learner_that_goes_on():
    learner = learner_of(seed=0, **CONFIG)
    learner.update(make_batch())
    other = learner_of(seed=1, **CONFIG | {"learning_rate": 1e-5, "behavior_learning_rate": 1e-6, "warmup_updates": 7})
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    assert [group["lr"] for group in other.optimizer.param_groups] == [1e-5, 1e-6, 1e-6]
    assert {group["warmup_steps"] for group in other.optimizer.param_groups} == {7}
    assert other.updates == 1


def test_what_is_scheduled_reaches_optimiser_and_losses_and_stays():
    learner = learner_of(seed=0, **CONFIG | {"learning_rate": 1e-3, "behavior_learning_rate": 4e-4})

    def settings() -> list[float]:
        rates = learner.learning_rates
        assert rates["actor"] == rates["critic"]
        return [rates["world_model"], rates["actor"], float(learner.discount), float(learner.entropy_scale)]

    learner.adjust(rates=0.5, discount=0.9, entropy_scale=0.1)
    assert settings() == pytest.approx([5e-4, 2e-4, 0.9, 0.1])
    learner.update(make_batch())
    learner.adjust()
    assert settings() == pytest.approx([5e-4, 2e-4, 0.9, 0.1])
    learner.adjust(rates=0.5, world_model_rate=0.1)
    assert settings()[:2] == pytest.approx([5e-5, 2e-4])
    learner.adjust(rates=1.0)
    assert settings() == pytest.approx([1e-3, 4e-4, 0.9, 0.1])
    with pytest.raises(TypeError, match=r"adjust\(discont=...\): a learner of dreamer_v3 has no such hyperparameter"):
        learner.adjust(discont=0.5)
    with pytest.raises(ValueError, match=r"world_model_rate=0\.1\) is a factor on rates"):
        learner.adjust(world_model_rate=0.1)


def test_rewards_ahead_are_part_of_the_loss_where_they_are_asked_for():
    metrics = learner_of(seed=0, **CONFIG, open_loop_steps=3).update(make_batch())
    parts = sum(value for key, value in metrics.items() if key.startswith("loss_"))
    torch.testing.assert_close(metrics["loss"], parts)
    assert metrics["loss_open_loop"] > 0
    assert "loss_open_loop" not in learner_of(seed=0, **CONFIG).update(make_batch())


def test_the_horizon_is_moved_from_the_next_update_on():
    learner = learner_of(seed=0, **CONFIG)
    seen, begin = watch(learner), learner.horizon
    for moved in ({}, {"imagination_horizon": 2.4}, {"imagination_horizon": 1.6}, {}):
        learner.adjust(**moved)
        learner.update(make_batch())
    assert [len(trajectory.action) for trajectory in seen] == [begin, 2, 2, 2] and begin > 2


def make_starts(count=6):
    flags = torch.zeros(count, 1, dtype=torch.bool)
    return torch.randn(count, 32, requires_grad=True), torch.zeros(count, 16, requires_grad=True), flags


def test_a_discount_of_zero_leaves_only_the_next_reward():
    learner = learner_of(seed=0, **CONFIG)
    torch.nn.init.normal_(learner.agent.world_model.reward_head.mlp.output.weight)
    learner.adjust(discount=0.0)
    metrics, trajectory = imagine_from(learner, *make_starts())
    assert trajectory.lambda_return.mean().item() == pytest.approx(metrics["imagined_reward"].item(), abs=1e-5)


def test_norms_are_of_all_gradients_of_a_network_and_of_none_without():
    stepped, still = torch.nn.Parameter(torch.zeros(2)), torch.nn.Parameter(torch.zeros(1))
    stepped.grad = torch.tensor([3.0, 4.0])
    other = torch.nn.Parameter(torch.zeros(1))
    other.grad = torch.tensor([12.0])
    norms = gradient_norms({"world_model": [stepped, still, other], "actor": [still]})
    assert {name: norm.item() for name, norm in norms.items()} == {"gradient_norm/world_model": 13.0}


def test_another_learner_s_weights_are_those_that_flew_and_nothing_that_it_kept():
    saved = learner_of(seed=0, **CONFIG | {"average_rate": 0.25})
    for _ in range(3):
        saved.update(make_batch())
    saved.adjust(max_std=0.3)
    learner = learner_of(seed=1, **CONFIG | {"average_rate": 0.25})
    kept = {name: value.clone() for name, value in learner.return_range.named_buffers()}
    learner.adopt(copy.deepcopy(saved.state_dict()))
    flew = dict(saved.averaged.named_parameters())
    for agent in (learner.agent, learner.averaged):
        assert all(torch.equal(value, flew[name]) for name, value in agent.named_parameters())
    assert all(torch.equal(value, kept[name]) for name, value in learner.return_range.named_buffers())
    assert learner.updates == 0 and not learner.optimizer.state


KINDS = {
    "imagined": (learner_of, {}),
    "latent": (latent_ppo_of, {"critic": "latent"}),
    "state": (latent_ppo_of, {"critic": "state"}),
}


def made(kind, seed):
    make, numbers = KINDS[kind]
    return make("debug", Interface(privileged_dim=7), seed=seed, **numbers)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("imagined", "latent", "trained with dreamer_v3, .* start a new run with its weights \\(init_from="),
        ("latent", "imagined", "trained with latent_ppo, .* start a new run with its weights \\(init_from="),
        ("latent", "state", "trained with another loss"),
    ],
)
def test_state_of_another_algorithm_or_critic_is_refused_before_anything_changes(first, second, words):
    assert_refused(made(first, 0), made(second, 1), words)


def test_state_of_before_this_format_is_refused():
    with pytest.raises(ValueError, match="format that this version does not read"):
        made("latent", 0).load_state_dict({"size": {}, "agent": {}, "losses": {}})


@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_weights_are_taken_over_whatever_the_algorithm(first, second):
    saved, learner = made(first, 0), made(second, 1)
    begins, is_left = ([] if kind == "imagined" else [f"{kind}_critic"] for kind in (second, first))
    unmatched = learner.adopt(copy.deepcopy(saved.state_dict()))
    assert unmatched.initial == ([] if first == second else begins)
    assert unmatched.unused == ([] if first == second else is_left)
    flew = dict(saved.agent.named_parameters())
    assert all(torch.equal(value, flew[name]) for name, value in learner.agent.named_parameters())


class CriticOfItsOwn(Image):
    """A target with a network under a name that the agent's networks have, too."""

    def __init__(self, agent, config):
        super().__init__(agent, config)
        self.critic = torch.nn.Linear(self.world_model.size.features, 1)
        self.scale = torch.nn.Parameter(torch.rand(()))

    def forward(self, posterior, features, embedding, batch):
        losses = super().forward(posterior, features, embedding, batch)
        return losses | {"loss_own": self.scale * self.critic(features).square().mean()}


def test_a_target_s_own_network_is_saved_under_whatever_name(monkeypatch):
    monkeypatch.setitem(TARGETS, "own", (CriticOfItsOwn,))
    saved, learner = (learner_of(seed=seed, **CONFIG | {"world_model": "own"}) for seed in (0, 1))
    saved.update(make_batch())
    learner.load_state_dict(copy.deepcopy(saved.state_dict()))
    here, there = (of.world_model_loss.targets["CriticOfItsOwn"] for of in (learner, saved))
    assert torch.equal(here.critic.weight, there.critic.weight)
    begun = learner_of(seed=2, **CONFIG | {"world_model": "own"})
    assert begun.adopt(copy.deepcopy(saved.state_dict())) == ([], [])
    assert torch.equal(begun.world_model_loss.targets["CriticOfItsOwn"].scale, there.scale)
    plain = learner_of(seed=2, **CONFIG)
    assert plain.adopt(copy.deepcopy(saved.state_dict())) == ([], ["CriticOfItsOwn"])


class NoScalar(Target):
    """Forgets to take the mean, and that metrics are tensors."""

    def forward(self, posterior, features, embedding, batch):
        return {"loss_mine": torch.zeros(2, 3), "my_weight": 0.3}


def test_losses_and_metrics_that_are_no_scalar_tensors_are_refused_by_name(monkeypatch):
    monkeypatch.setitem(TARGETS, "own", (NoScalar,))
    learner = learner_of(seed=0, **CONFIG | {"world_model": "own"})
    with pytest.raises(ValueError, match=r"scalar tensors: loss_mine is of shape \(2, 3\), my_weight is .*float"):
        learner.update(make_batch())


class Entropy(Target):
    """Has the name of a metric of the actor."""

    def forward(self, posterior, features, embedding, batch):
        return {"entropy": features.mean()}


def test_a_metric_of_a_target_is_not_replaced_by_the_actor_s(monkeypatch):
    monkeypatch.setitem(TARGETS, "own", (Entropy,))
    with pytest.raises(ValueError, match="Two losses or metrics are called entropy"):
        learner_of(seed=0, **CONFIG | {"world_model": "own"}).update(make_batch())


def test_averaged_weights_move_by_their_rate_and_fly_evaluations():
    learner = learner_of(seed=0, **CONFIG | {"average_rate": 0.25})
    assert learner.evaluation_policy().actor is learner.averaged.actor
    assert learner.policy().actor is learner.agent.actor
    before = {name: value.clone() for name, value in learner.averaged.named_parameters()}
    learner.update(make_batch())
    trained = dict(learner.agent.named_parameters())
    for name, value in learner.averaged.named_parameters():  # the first update: the mean of all there are
        torch.testing.assert_close(value, trained[name].detach())
    for _ in range(4):  # 1/2, 1/3, then the rate itself
        before = {name: value.clone() for name, value in learner.averaged.named_parameters()}
        learner.update(make_batch())
    for name, value in learner.averaged.named_parameters():
        torch.testing.assert_close(value, torch.lerp(before[name], trained[name].detach(), 0.25))
        assert value.is_leaf and not value.requires_grad, name  # else every update would stay in a graph for ever
    resumed = learner_of(seed=1, **CONFIG | {"average_rate": 0.25})
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    assert not differing(resumed.averaged.state_dict(), learner.averaged.state_dict())


def test_evaluations_ask_the_critic_that_belongs_to_what_flies():
    """Of latents that have seen the image, by the averaged weights."""
    learner = learner_of(seed=0, **CONFIG | {"average_rate": 0.25})
    torch.nn.init.normal_(learner.averaged.critic.head.mlp.output.weight)
    belief, state = torch.randn(3, learner.size.belief), torch.randn(3, learner.size.state)
    acted = TensorDict({"belief": 0 * belief, "next": {"belief": belief, "state": state}}, [3])
    expected = learner.averaged.critic.value(torch.cat((belief, state), -1))
    value = learner.value_function()(acted)
    assert value.shape == (3, 1) and not value.requires_grad and torch.equal(value, expected)


def test_without_averages_the_trained_weights_fly():
    learner = learner_of(seed=0, **CONFIG)
    assert learner.averaged is None and learner.evaluation_policy().actor is learner.agent.actor
    policy = learner.policy(deterministic=True)
    assert policy.deterministic and policy.rssm is learner.agent.world_model.rssm


def test_the_smallest_deviation_is_scheduled_saved_and_flown():
    learner = learner_of(seed=0, **CONFIG | {"min_std": 0.4, "average_rate": 0.1})
    features = torch.zeros(1, 48)
    assert learner.agent.actor(features).std.min() >= 0.4
    learner.adjust(min_std=0.2)
    with torch.no_grad():
        learner.agent.actor.mlp.output.bias.fill_(-50.0)
    assert learner.agent.actor(features).std.max().item() == pytest.approx(0.2)
    restored = learner_of(seed=1, **CONFIG | {"min_std": 0.4, "average_rate": 0.1})
    restored.load_state_dict(copy.deepcopy(learner.state_dict()))
    for agent in (restored.agent, restored.averaged):
        assert agent.actor.min_std.item() == pytest.approx(0.2)


def test_composing_by_hand_draws_the_weights_that_make_does():
    """In the order networks, world-model loss: seeds mean the same in recipes and in the library."""
    losses, interface = DreamerV3Losses(world_model="informed"), Interface(privileged_dim=7)
    made = DreamerV3.make("debug", interface, losses, seed=3)
    with seeded(3):
        by_hand = DreamerV3(Agent(SIZES["debug"], interface, decode=True), losses)
    assert not differing(made.agent.state_dict(), by_hand.agent.state_dict())
    assert not differing(made.world_model_loss.state_dict(), by_hand.world_model_loss.state_dict())


def test_a_seed_is_of_the_cpu_s_generator_alone(monkeypatch):
    """Weights are drawn there; a CUDA device's generator, which the policy's noise comes from, keeps its own seed."""
    monkeypatch.setattr(torch.cuda, "manual_seed_all", lambda seed: pytest.fail("CUDA was seeded"))
    before = torch.get_rng_state()
    with seeded(3):
        first = torch.rand(1)
    with seeded(3):
        assert torch.equal(torch.rand(1), first)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.skipif(torch.__version__ < "2.13", reason="trunc_normal_ of torch before 2.13 draws other numbers")
def test_a_seed_means_the_weights_that_it_has_always_meant():
    """Sums of all weights' magnitudes, so that runs begun with one seed at different versions compare."""
    learner = learner_of("debug", Interface(privileged_dim=7), world_model="informed", seed=3)
    decoder = learner.world_model_loss.targets["State"].decoder
    drawn = {**dict(learner.agent.named_children()), "decoder": decoder}
    sums = {
        name: sum(p.detach().double().abs().sum().item() for p in home.parameters()) for name, home in drawn.items()
    }
    expected = {"world_model": 2380.58803, "actor": 103.634042, "critic": 223.145986, "decoder": 126.838377}
    assert sums == pytest.approx(expected, rel=1e-6)


def first_update(adjusted=None, stirred=False, **numbers):
    """Metrics of a learner's first update; ``stirred`` networks predict some reward, value and end of an episode."""
    learner = learner_of(seed=0, **CONFIG, **numbers)
    learner.adjust(**adjusted or {})
    torch.manual_seed(0)
    if stirred:
        with torch.no_grad():
            for parameter in learner.agent.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
    return learner.update(make_batch())


def test_changes_of_the_policy_are_measured_and_cost_what_is_set():
    free, dear = first_update(action_change_scale=0.0), first_update(action_change_scale=100.0)
    assert free["action_change"] == dear["action_change"] > 0
    torch.testing.assert_close(dear["loss_actor"], free["loss_actor"] + 100.0 * free["action_change"])
    assert first_update({"action_change_scale": 100.0})["loss_actor"] == dear["loss_actor"]


def test_the_divergence_from_the_averaged_policy_costs_what_is_set():
    kept = {"average_rate": 0.1}
    free = first_update(stirred=True, **kept)
    near, far = (first_update(stirred=moved, averaged_kl_scale=3.0, **kept) for moved in (False, True))
    assert "averaged_kl" not in free and near["averaged_kl"] == 0 < far["averaged_kl"]
    torch.testing.assert_close(far["loss_actor"], free["loss_actor"] + 3.0 * far["averaged_kl"])
    assert first_update({"averaged_kl_scale": 3.0}, stirred=True, **kept)["loss_actor"] == far["loss_actor"]
    with pytest.raises(ValueError, match="needs averaged weights: set model.average_rate"):
        first_update({"averaged_kl_scale": 3.0})


def test_an_actor_returns_to_the_averaged_policy_if_that_is_all_that_counts():
    learner = learner_of(seed=0, **CONFIG, average_rate=1e-6, averaged_kl_scale=1e4)
    learner.update(make_batch())
    with torch.no_grad():
        for parameter in learner.agent.actor.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    away = [float(learner.update(make_batch())["averaged_kl"]) for _ in range(40)]
    assert away[-1] < 0.2 * away[0]


def test_a_crash_weighs_what_is_set():
    once, twice = (first_update(stirred=True, crash_weight=weight) for weight in (1.0, 2.0))
    assert once["continuation"] == twice["continuation"] < 1
    losses = ("loss_actor", "loss_critic", "return_mean")
    assert all(once[name] != twice[name] for name in losses)
    never = first_update({"crash_weight": 0.0}, stirred=True)
    ignored = first_update(stirred=True, continuation=False)
    assert all(never[name] == ignored[name] for name in losses)
    assert never["continuation"] < ignored["continuation"] == 1
    halved = learner_of(seed=0, **CONFIG, discount=0.9, crash_weight=2.0)
    for parameter in halved.agent.world_model.continue_head.mlp.output.parameters():
        torch.nn.init.zeros_(parameter)  # the episode continues with probability 1/2
    weight = imagine_from(halved, *make_starts())[1].weight
    expected = [1.0, 0.9 * 0.5**2, (0.9 * 0.5**2) ** 2, (0.9 * 0.5**2) ** 3]
    torch.testing.assert_close(weight, torch.tensor(expected).view(-1, 1, 1).expand_as(weight))
