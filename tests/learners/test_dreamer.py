import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.learners.dreamer import make_dreamer
from dreamer_racing.learners.finite_guard import NonFiniteLossError
from dreamer_racing.learners.learner import seeded
from dreamer_racing.losses import (
    ACTOR_LOSSES,
    WORLD_MODEL_LOSSES,
    LossConfig,
    ReconstructionLoss,
    ReinforceLoss,
    make_losses,
)
from dreamer_racing.modules import SIZES, Agent, Interface, get_size
from tests.dreamers import learner_of

CONFIG = {"horizon": 4, "learning_rate": 1e-3, "warmup_updates": 0}


def make_batch(batch: int = 3, time: int = 6) -> TensorDict:
    """Windows with a crash, a truncation and the resets that follow them."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.zeros(batch, time, 64, 64, 3, dtype=torch.uint8)
    for step in range(time):
        pixels[:, step, 8 * step : 8 * step + 16, 10:30] = 200  # a bar that moves
    flag = torch.zeros(batch, time, 1, dtype=torch.bool)
    is_init, terminated, truncated = flag.clone(), flag.clone(), flag.clone()
    terminated[0, 2] = truncated[1, 3] = True
    is_init[0, 3] = is_init[1, 4] = is_init[2, 0] = True
    return TensorDict(
        {
            "pixels": pixels,
            "previous_action": (torch.rand(batch, time, 4, generator=generator) * 2 - 1).masked_fill(is_init, 0.0),
            "reward": torch.randn(batch, time, 1, generator=generator).masked_fill(is_init, 0.0),
            "is_init": is_init,
            "terminated": terminated,
            "truncated": truncated,
        },
        [batch, time],
    )


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
    for name, value in learner.agent.state_dict().items():
        still = name.endswith(("initial_belief", "min_std", "max_std"))
        assert torch.equal(value, before[name]) == still, name


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


@pytest.mark.parametrize("shared", [True, False])
def test_gradients_do_not_leak_between_networks(shared):
    """The actor's and the imagined critic's losses stay theirs; the replayed one enters the model only if asked to."""
    learner = learner_of(seed=0, **CONFIG | {"replay_value_gradient": shared})
    with torch.no_grad():
        learner.agent.critic.head.mlp.output.weight.normal_()
    losses = learner.compute_losses(make_batch())
    reached = {}
    for key in [key for key in losses if key.startswith("loss_")]:
        learner.agent.zero_grad(set_to_none=True)
        losses[key].backward(retain_graph=True)
        reached[key] = {
            name
            for name, network in learner.agent.named_children()
            if any(parameter.grad is not None for parameter in network.parameters())
        }
    world_model = {key for key in reached if reached[key] == {"world_model"}}
    assert world_model == {"loss_image", "loss_reward", "loss_continue", "loss_dynamics", "loss_representation"}
    assert reached["loss_actor"] == {"actor"}
    assert reached["loss_critic"] == {"critic"}
    assert reached["loss_replay_critic"] == ({"critic", "world_model"} if shared else {"critic"})


def test_resume_equals_never_having_stopped():
    batch = make_batch()
    learner = learner_of(seed=0, **CONFIG)
    learner.update(batch)
    saved = copy.deepcopy(learner.state_dict())
    resumed = learner_of(seed=1, **CONFIG)
    resumed.load_state_dict(saved)
    assert resumed.updates == 1
    results = []
    for each in (learner, resumed):
        torch.manual_seed(5)
        results.append([each.update(batch) for _ in range(2)][-1])
    assert results[0].keys() == results[1].keys()
    for key, value in results[0].items():
        assert torch.equal(value, results[1][key]), key
    for name, value in learner.agent.state_dict().items():
        assert torch.equal(value, resumed.agent.state_dict()[name]), name


def test_return_normaliser_is_saved():
    learner = learner_of(seed=0, **CONFIG)
    learner.losses["actor"].return_normalizer.high.fill_(7.0)
    resumed = learner_of(seed=0, **CONFIG)
    resumed.load_state_dict(learner.state_dict())
    assert resumed.losses["actor"].return_normalizer.scale().item() == 7.0


def test_state_survives_a_file(tmp_path):
    learner = learner_of(seed=0, **CONFIG)
    learner.update(make_batch())
    torch.save(learner.state_dict(), tmp_path / "learner.pt")
    learner_of(**CONFIG).load_state_dict(torch.load(tmp_path / "learner.pt", weights_only=True))


def test_state_of_another_size_is_refused_with_what_to_do():
    learner = learner_of(**CONFIG)
    other = learner_of(replace(SIZES["debug"], name="wider", units=32), **CONFIG)
    with pytest.raises(ValueError, match=r"'debug'.*'wider'.*units 16 there, 32 here.*model=debug") as error:
        other.load_state_dict(learner.state_dict())
    assert "\n" not in str(error.value)


def made_with(world_model_loss, seed, **interface):
    if WORLD_MODEL_LOSSES[world_model_loss].reads_privileged:
        interface["privileged_dim"] = 21
    return learner_of("debug", Interface(**interface), seed=seed, **CONFIG | {"world_model": world_model_loss})


def assert_refused(saved, learner, words):
    before = copy.deepcopy(learner.state_dict())
    with pytest.raises(ValueError, match=words) as error:
        learner.load_state_dict(saved.state_dict())
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
    after = learner.state_dict()
    for name, value in before["agent"].items():
        assert torch.equal(value, after["agent"][name]), name
    for name, loss in before["losses"].items():
        assert all(torch.equal(value, after["losses"][name][key]) for key, value in loss.items()), name
    assert after["updates"] == 0


@pytest.mark.parametrize(
    ("first", "second"), [("privileged", "reconstruction"), ("decoder_free", "reward_only"), ("informed", "privileged")]
)
def test_state_of_another_loss_is_refused(first, second):
    for there, here in ((first, second), (second, first)):
        saved = made_with(there, 1)
        saved.updates = 7
        assert_refused(saved, made_with(here, 2), r"beyond this learner's, and lacks .* trained with another loss")


@pytest.mark.parametrize(
    ("there", "here"),
    [
        ({"action_dim": 6}, {}),
        ({"pixels": False, "vector_dim": 21}, {}),
        ({"pixels": False, "vector_dim": 21}, {"pixels": False, "vector_dim": 9}),
    ],
    ids=["actions", "pixels", "numbers"],
)
def test_state_of_another_environment_is_refused(there, here):
    assert_refused(made_with("reconstruction", 1, **there), made_with("reconstruction", 2, **here), "environment")


def test_networks_of_the_default_image_size_are_those_of_older_checkpoints():
    """Names and shapes of all that depends on the images' size, as checkpoints have them since the first."""
    learner = learner_of(seed=1, **CONFIG)
    saved = learner.state_dict()
    shapes = {key: list(value.shape) for key, value in saved["agent"].items() if value.ndim > 1}
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
    for key, shape in expected.items():
        assert shapes[f"world_model.{key}"] == shape, key
    assert not [key for key in shapes if ".encoder." in key or ".decoder." in key if key[12:] not in expected]
    del saved["image_size"]  # which older checkpoints do not have
    resumed = learner_of(seed=2, **CONFIG)
    resumed.load_state_dict(saved)
    for key, value in resumed.agent.state_dict().items():
        assert torch.equal(value, saved["agent"][key]), key


@pytest.mark.parametrize("loss", ["reconstruction", "decoder_free"])
def test_state_of_another_image_size_is_refused(loss):
    small, large = made_with(loss, 1, image_size=32), made_with(loss, 2, image_size=96)
    assert_refused(small, large, "images of 32 × 32 pixels, not 96 × 96: choose env.image_size=32")
    older = small.state_dict() | {"agent": made_with(loss, 3).agent.state_dict()}
    del older["image_size"]
    with pytest.raises(ValueError, match="64 × 64 pixels, not 96 × 96"):
        large.load_state_dict(older)


@pytest.mark.parametrize("image_size", [32, 96])
def test_every_image_size_updates(image_size):
    learner = made_with("reconstruction", 0, image_size=image_size)
    batch = make_batch()
    batch["pixels"] = batch["pixels"].repeat(1, 1, 2, 2, 1)[:, :, :image_size, :image_size]
    metrics = learner.update(batch)
    assert metrics["loss"].isfinite()
    torch.testing.assert_close(metrics["loss_image"], metrics["image_error"] * image_size**2 * 3)
    images = learner.agent.world_model.images(*learner.open_loop(batch, context=2))
    assert images.shape == (3, 6, image_size, image_size, 3)


def test_seed_fixes_the_weights_and_leaves_the_global_generator_alone():
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    first = learner_of(seed=0, **CONFIG)
    assert torch.equal(torch.rand(1), expected)
    second = learner_of(seed=0, **CONFIG)
    for name, value in first.agent.state_dict().items():
        assert torch.equal(value, second.agent.state_dict()[name]), name


def test_imagination_may_start_from_a_subset():
    learner = learner_of(seed=0, **CONFIG | {"imagination_starts": 5})
    seen = []
    learner.losses["actor"].register_forward_hook(lambda _, inputs, output: seen.append(output["imagination"]))
    metrics = learner.update(make_batch())
    assert seen[0].batch_size == (4, 5)
    assert metrics["loss_replay_critic"].isfinite()


def test_every_terminal_record_is_a_start_of_no_weight():
    learner = learner_of(seed=0, **CONFIG)
    seen = []
    learner.losses["actor"].register_forward_hook(lambda _, inputs, output: seen.append(output["imagination"]))
    learner.update(make_batch())
    weight = seen[0]["weight"].view(4, 3, 6)
    assert torch.equal(weight[0], 1.0 - make_batch()["terminated"].squeeze(-1).float())
    assert torch.equal(weight[:, 0, 2], torch.zeros(4))


def test_open_loop_video():
    learner = learner_of(seed=0, **CONFIG)
    belief, state = learner.open_loop(make_batch(), context=2)
    images = learner.agent.world_model.images(belief, state)
    assert images.shape == (3, 6, 64, 64, 3)
    assert images.dtype == torch.uint8


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
    for name, value in learner.agent.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_policy_shares_the_parameters():
    learner = learner_of(seed=0, **CONFIG)
    policy = learner.policy(deterministic=True)
    assert policy.deterministic
    assert policy.actor is learner.agent.actor
    assert policy.rssm is learner.agent.world_model.rssm


def test_losses_are_chosen_by_name(monkeypatch):
    class BoldActorLoss(ReinforceLoss):
        """Has ten times the entropy."""

        def forward(self, tensordict):
            self.entropy_scale.fill_(3e-3)
            return super().forward(tensordict)

    monkeypatch.setitem(ACTOR_LOSSES, "bold", BoldActorLoss)
    learner = learner_of(seed=0, **CONFIG | {"actor": "bold"})
    assert isinstance(learner.losses["actor"], BoldActorLoss)
    learner.update(make_batch())
    with pytest.raises(ValueError, match="'timid'.*reinforce"):
        learner_of(**CONFIG | {"actor": "timid"})


@pytest.mark.parametrize("recurrence", ["block", "dense", "ssm"])
@pytest.mark.parametrize("norm", ["rms", "layer"])
def test_every_variant_updates(recurrence, norm):
    size = replace(
        SIZES["debug"],
        name="variant",
        recurrence=recurrence,
        blocks=2 if recurrence == "block" else 1,
        norm=norm,
        learned_initial=norm == "layer",
        strided=norm == "layer",
        cnn_kernel=4 if norm == "layer" else 5,
    )
    learner = learner_of(size, seed=0, **CONFIG)
    assert learner.update(make_batch())["loss"].isfinite()


@pytest.mark.parametrize("recurrence", ["block", "dense", "ssm"])
def test_mixed_precision_is_close_to_full(recurrence):
    size = replace(SIZES["debug"], name="variant", recurrence=recurrence, blocks=2, norm="rms")
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
    assert [group["lr"] for group in other.optimizer.param_groups] == [1e-5, 1e-6]
    assert {group["warmup_steps"] for group in other.optimizer.param_groups} == {7}
    assert other.updates == 1


def test_what_is_scheduled_reaches_optimiser_and_losses_and_stays():
    learner = learner_of(seed=0, **CONFIG | {"learning_rate": 1e-3, "behavior_learning_rate": 4e-4})

    def settings() -> list[float]:
        actor, critic = learner.losses["actor"], learner.losses["critic"]
        rates = [group["lr"] for group in learner.optimizer.param_groups]
        return [*rates, learner.discount, float(actor.discount), float(critic.discount), float(actor.entropy_scale)]

    learner.adjust(rates=0.5, discount=0.9, entropy_scale=0.1)
    assert settings() == pytest.approx([5e-4, 2e-4, 0.9, 0.9, 0.9, 0.1])
    learner.update(make_batch())
    learner.adjust()
    assert settings() == pytest.approx([5e-4, 2e-4, 0.9, 0.9, 0.9, 0.1])
    learner.adjust(rates=0.5, world_model_rate=0.1)
    assert settings()[:2] == pytest.approx([5e-5, 2e-4])
    learner.adjust(rates=1.0)
    assert settings() == pytest.approx([1e-3, 4e-4, 0.9, 0.9, 0.9, 0.1])
    with pytest.raises(TypeError, match=r"adjust\(discont=...\): LossConfig has no such number"):
        learner.adjust(discont=0.5)


def test_every_number_that_a_loss_has_moves_under_the_name_in_the_configuration():
    learner = learner_of(seed=0, **CONFIG)
    homes = {
        "world_model": ("dynamics_scale", "representation_scale", "free_nats"),
        "actor": ("discount", "lambda_", "entropy_scale"),
        "critic": ("discount", "lambda_", "slow_critic_scale", "replay_value_scale", "replay_value_gradient"),
    }
    moved = {name: 0.25 for names in homes.values() for name in names}
    learner.adjust(**moved)
    for home, names in homes.items():
        found = {name: float(getattr(learner.losses[home], name)) for name in names}
        assert found == dict.fromkeys(names, 0.25), home


@pytest.mark.parametrize("name", ["return_decay", "barlow_scale", "kl_target", "world_model", "ppo"])
def test_a_number_that_no_loss_has_is_refused(name):
    """What only a constructor reads, what another loss would have, and what is no number."""
    learner = learner_of(seed=0, **CONFIG)
    with pytest.raises(
        ValueError, match=rf"adjust\({name}=...\): none of ReconstructionLoss, ReinforceLoss, CriticLoss"
    ):
        learner.adjust(**{name: 0.5})


def test_a_discount_of_zero_leaves_only_the_next_reward():
    learner = learner_of(seed=0, **CONFIG)
    torch.nn.init.normal_(learner.agent.world_model.reward_head.mlp.output.weight)
    learner.adjust(discount=0.0)
    context = learner.losses["world_model"](make_batch()).pop("replay_context")
    imagined = learner.losses["actor"](learner.starts(context, make_batch()))
    returns = imagined["imagination"]["lambda_return"]
    assert returns.mean().item() == pytest.approx(imagined["imagined_reward"].item(), abs=1e-5)


def test_another_learner_s_weights_are_those_that_flew_and_nothing_that_it_kept():
    saved = learner_of(seed=0, **CONFIG | {"average_rate": 0.25})
    for _ in range(3):
        saved.update(make_batch())
    saved.adjust(max_std=0.3)
    learner = learner_of(seed=1, **CONFIG | {"average_rate": 0.25})
    kept = {name: value.clone() for name, value in learner.losses.named_buffers()}
    learner.adopt(copy.deepcopy(saved.state_dict()))
    flew = dict(saved.averaged.named_parameters())
    for agent in (learner.agent, learner.averaged):
        assert all(torch.equal(value, flew[name]) for name, value in agent.named_parameters())
    assert all(torch.equal(value, kept[name]) for name, value in learner.losses.named_buffers())
    assert learner.updates == 0 and not learner.optimizer.state


@pytest.mark.parametrize(("first", "second"), [("reinforce", "ppo"), ("ppo", "reinforce")])
def test_state_of_an_actor_that_learned_otherwise_is_refused_before_anything_changes(first, second):
    saved, learner = (learner_of(seed=seed, **CONFIG | {"actor": kind}) for seed, kind in ((0, first), (1, second)))
    saved.update(make_batch())
    assert_refused(saved, learner, r"loss.actor that it was trained with, or begin a run with its weights \(init_from=")


OWN_CRITICS = {"latent_ppo": "latent_critic", "asymmetric_ppo": "state_critic"}


@pytest.mark.parametrize("first", ["reinforce", "ppo", "flown_ppo", *OWN_CRITICS])
@pytest.mark.parametrize("second", ["reinforce", "ppo", "flown_ppo", *OWN_CRITICS])
def test_weights_are_taken_over_whatever_the_actor_learned_by(first, second):
    interface = Interface(privileged_dim=7)
    saved, learner = (
        make_dreamer("debug", interface, LossConfig(actor=kind), seed=seed) for seed, kind in ((0, first), (1, second))
    )
    begins, is_left = ([OWN_CRITICS[kind]] if kind in OWN_CRITICS else [] for kind in (second, first))
    unmatched = learner.adopt(copy.deepcopy(saved.state_dict()))
    assert unmatched.anew == ([] if first == second else begins)
    assert unmatched.left == ([] if first == second else is_left)
    flew = dict(saved.agent.named_parameters())
    assert all(torch.equal(value, flew[name]) for name, value in learner.agent.named_parameters())


class CriticOfItsOwn(ReconstructionLoss):
    """With a network under a name that the agent's networks have, too."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.critic = torch.nn.Linear(self.world_model.size.features, 1)
        self.scale = torch.nn.Parameter(torch.rand(()))

    def represent(self, posterior, features, embedding, tensordict):
        losses = super().represent(posterior, features, embedding, tensordict)
        return losses | {"loss_own": self.scale * self.critic(features).square().mean()}


def test_a_loss_s_own_network_is_saved_under_whatever_name(monkeypatch):
    monkeypatch.setitem(WORLD_MODEL_LOSSES, "own", CriticOfItsOwn)
    saved, learner = (learner_of(seed=seed, **CONFIG | {"world_model": "own"}) for seed in (0, 1))
    saved.update(make_batch())
    learner.load_state_dict(copy.deepcopy(saved.state_dict()))
    here, there = (of.losses["world_model"].critic.weight for of in (learner, saved))
    assert torch.equal(here, there)
    begun = learner_of(seed=2, **CONFIG | {"world_model": "own"})
    assert begun.adopt(copy.deepcopy(saved.state_dict())) == ([], [])
    assert torch.equal(begun.losses["world_model"].scale, saved.losses["world_model"].scale)


def test_a_loss_that_is_no_scalar_is_refused_by_name():
    learner = learner_of(seed=0, **CONFIG)
    compute = learner.losses["critic"].forward
    learner.losses["critic"].forward = lambda *args: compute(*args).set("loss_mine", torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"losses must be scalars, .*'loss_mine': \(2, 3\)"):
        learner.update(make_batch())


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
    for name, value in resumed.averaged.named_parameters():
        assert torch.equal(value, dict(learner.averaged.named_parameters())[name]), name


def test_evaluations_ask_the_critic_that_belongs_to_what_flies():
    """Of latents that have seen the image, by the averaged weights."""
    learner = learner_of(seed=0, **CONFIG | {"average_rate": 0.25})
    torch.nn.init.normal_(learner.averaged.critic.head.mlp.output.weight)
    size = learner.size
    belief, state = (
        torch.randn(3, size.features - size.latents * size.classes),
        torch.randn(3, size.latents * size.classes),
    )
    acted = TensorDict({"belief": 0 * belief, "next": {"belief": belief, "state": state}}, [3])
    expected = learner.averaged.critic.value(torch.cat((belief, state), -1))
    value = learner.value_function()(acted)
    assert value.shape == (3, 1) and not value.requires_grad and torch.equal(value, expected)


def test_without_averages_the_trained_weights_fly():
    learner = learner_of(seed=0, **CONFIG)
    assert learner.averaged is None and learner.evaluation_policy().actor is learner.agent.actor


def test_imagination_begins_in_the_newest_windows_where_it_is_told_to():
    config = dict(CONFIG, imagination_starts=8, imagine_recent=True)
    learner, batch = learner_of(seed=0, **config), make_batch(batch=4, time=6)
    batch["recent"] = torch.tensor([False, False, True, True]).unsqueeze(-1).expand(4, 6)
    latents = TensorDict({"belief": torch.zeros(4, 6, 32), "state": torch.zeros(4, 6, 16)}, [4, 6])
    latents["belief"][2:] = 1.0
    for _ in range(10):
        assert learner.starts(latents, batch)["belief"].min() == 1.0
    learner.config = replace(learner.config, imagination_starts=20)  # more than the 12 there are: the others fill up
    assert learner.starts(latents, batch)["belief"][:, 0].sum() == 12


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
    older = learner.state_dict()
    del older["agent"]["actor.min_std"]
    other = learner_of(seed=1, **CONFIG | {"min_std": 0.4})
    other.load_state_dict(older)
    assert other.agent.actor.min_std.item() == pytest.approx(0.4)


@pytest.mark.parametrize("actor", ["reinforce", "ppo"])
def test_composing_by_names_draws_the_weights_that_composing_by_hand_does(actor):
    """In the order networks, world-model loss, actor's, critic's: seeds mean the same in recipes and in the library."""
    config = LossConfig(world_model="informed", actor=actor)
    interface = Interface(privileged_dim=7)
    named = make_dreamer("debug", interface, config, seed=3)
    with seeded(3):
        agent = Agent(get_size("debug"), interface, decode=True)
        losses = make_losses(agent, config)
    for name, value in named.agent.state_dict().items():
        assert torch.equal(value, agent.state_dict()[name]), name
    drawn = losses["world_model"].privileged_decoder.state_dict()
    for name, value in named.losses["world_model"].privileged_decoder.state_dict().items():
        assert torch.equal(value, drawn[name]), name


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
    learner = make_dreamer("debug", Interface(privileged_dim=7), LossConfig(world_model="informed"), seed=3)
    drawn = {**dict(learner.agent.named_children()), "decoder": learner.losses["world_model"].privileged_decoder}
    sums = {
        name: sum(p.detach().double().abs().sum().item() for p in home.parameters()) for name, home in drawn.items()
    }
    expected = {"world_model": 2380.58803, "actor": 103.634042, "critic": 223.145986, "decoder": 126.838377}
    assert sums == pytest.approx(expected, rel=1e-6)
