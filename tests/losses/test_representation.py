"""Each world-model loss alone: what it writes, values by hand, and what it says when something is missing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.objectives import LossModule

from dreamer_racing.losses import (
    WORLD_MODEL_LOSSES,
    DecoderFreeLoss,
    InformedLoss,
    LossConfig,
    PrivilegedLoss,
    ReconstructionLoss,
    WorldModelLoss,
    redundancy_reduction,
)
from dreamer_racing.modules import SIZES, Interface, WorldModel, join_features, symlog
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.layers import autocast
from tests.dreamers import learner_of

PRIVILEGED_DIM = 5
VECTOR_DIM = 6
ALWAYS = {"loss_reward", "loss_continue", "loss_dynamics", "loss_representation", "reward_error", "kl"}
ADDED = {
    "reconstruction": {"loss_image", "image_error"},
    "informed": {"loss_image", "image_error", "loss_privileged", "privileged_error"},
    "privileged": {"loss_privileged", "privileged_error"},
    "decoder_free": {"loss_barlow", "agreement"},
    "reward_only": set(),
}
SIGHTS = {
    "pixels": Interface(privileged_dim=PRIVILEGED_DIM),
    "vector": Interface(pixels=False, vector_dim=VECTOR_DIM, privileged_dim=PRIVILEGED_DIM),
    "both": Interface(vector_dim=VECTOR_DIM, privileged_dim=PRIVILEGED_DIM),
}


def make_batch(batch: int = 2, time: int = 4) -> TensorDict:
    torch.manual_seed(1)
    is_init, terminated = torch.zeros(2, batch, time, 1, dtype=torch.bool).unbind(0)
    terminated[0, 1] = is_init[0, 2] = True
    return TensorDict(
        {
            "pixels": torch.randint(0, 64, (batch, time, 64, 64, 3), dtype=torch.uint8),
            "vector": torch.randn(batch, time, VECTOR_DIM) * 10,
            "privileged": {"vector": torch.randn(batch, time, PRIVILEGED_DIM) * 10},
            "previous_action": torch.rand(batch, time, 4) * 2 - 1,
            "reward": torch.randn(batch, time, 1),
            "is_init": is_init,
            "terminated": terminated,
        },
        [batch, time],
    )


def make_loss(name: str, sight: str = "pixels", **options) -> WorldModelLoss:
    torch.manual_seed(0)
    loss_class = WORLD_MODEL_LOSSES[name]
    agent = Agent(SIZES["debug"], SIGHTS[sight], loss_class.decodes)
    return loss_class.from_config(agent, LossConfig(**options))


def observed(loss: WorldModelLoss, batch: TensorDict, seed: int = 2):
    """The latents that ``loss`` sees after the same seed."""
    torch.manual_seed(seed)
    world_model = loss.world_model
    return world_model.observe(batch, batch["previous_action"], batch["is_init"].squeeze(-1))


def test_every_registered_loss_is_tested_here():
    assert ADDED.keys() == WORLD_MODEL_LOSSES.keys()


@pytest.mark.parametrize("name", ADDED)
def test_documented_keys_exist_and_are_finite(name):
    loss = make_loss(name)
    losses = loss(make_batch())
    assert set(losses.keys()) == set(loss.out_keys) == ALWAYS | ADDED[name] | {"replay_context"}
    context = losses.pop("replay_context")
    assert context.batch_size == (2, 4)
    assert set(context.keys()) == {"belief", "state"}
    for key, value in losses.items():
        assert value.shape == () and value.isfinite(), key
        assert value.requires_grad == key.startswith("loss_"), key


def test_a_promised_key_that_is_not_written_is_named():
    loss = make_loss("reconstruction")
    loss.represent_keys = (*loss.represent_keys, "loss_mine")
    with pytest.raises(ValueError, match="ReconstructionLoss.represent left out loss_mine"):
        loss(make_batch())


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("name", ADDED)
def test_losses_read_what_the_agent_sees(name, sight):
    """A batch of nothing but ``in_keys`` is enough, and each of them is asked for by name."""
    loss, batch = make_loss(name, sight), make_batch()
    seen = {"pixels": ["pixels"], "vector": ["vector"], "both": ["pixels", "vector"]}[sight]
    privileged = [("privileged", "vector")] if loss.reads_privileged else []
    records = ["previous_action", "reward", "is_init", "terminated"]
    assert sorted(map(str, loss.in_keys)) == sorted(map(str, [*seen, *records, *privileged]))
    batch = batch.select(*loss.in_keys)
    losses = loss(batch)
    decoded = {"loss_image": "pixels", "loss_vector": "vector"} if loss.decodes else {}
    for key, source in decoded.items():
        assert (key in losses.keys()) == (source in seen)  # noqa: SIM118
    for key in loss.in_keys:
        lacking = batch.exclude(key)
        with pytest.raises(KeyError) as error:
            loss(lacking)
        assert type(loss).__name__ in str(error.value)
        assert repr(key) in str(error.value)


@pytest.mark.parametrize("name", ADDED)
def test_flops_can_be_counted_on_the_meta_device(name):
    loss, batch = make_loss(name).to("meta"), make_batch().to("meta")
    with autocast(torch.device("meta"), enabled=True):
        losses = loss(batch)
    assert all(value.is_meta for key, value in losses.items() if key.startswith("loss_"))


@pytest.mark.parametrize("name", ADDED)
def test_alone_as_a_loss_module_in_a_training_loop(name):
    """Without learner, actor or critic, with any optimiser, and inside a ``TensorDictSequential``."""
    loss, batch = make_loss(name), make_batch()
    assert isinstance(loss, LossModule)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    totals = []
    for _ in range(30):
        optimizer.zero_grad()
        losses = loss(batch)
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert np.mean(totals[-3:]) < 0.9 * totals[0]
    out = TensorDictSequential(loss)(batch)
    assert out["loss_reward"].isfinite()


def test_image_loss_is_the_squared_error_summed_over_an_image():
    loss, batch = make_loss("reconstruction"), make_batch()
    posterior = observed(loss, batch)
    images = loss.world_model.decoder(posterior.belief, posterior.state).detach().double().numpy()
    error = (images - batch["pixels"].numpy() / 255.0) ** 2  # (B, T, 64, 64, 3)
    torch.manual_seed(2)
    losses = loss(batch)
    assert losses["loss_image"].item() == pytest.approx(error.sum((2, 3, 4)).mean(), rel=1e-5)
    assert losses["image_error"].item() == pytest.approx(error.mean(), rel=1e-5)


@pytest.mark.parametrize("name", ["reconstruction", "informed"])
def test_image_scale_multiplies_the_image_loss_alone(name):
    batch, found = make_batch(), []
    for scale in (1.0, 0.25):
        loss = make_loss(name, image_scale=scale)
        torch.manual_seed(2)
        found.append(loss(batch).exclude("replay_context"))
    whole, scaled = found
    whole["loss_image"] *= 0.25
    torch.testing.assert_close(whole.to_dict(), scaled.to_dict())


@pytest.mark.parametrize(("share", "records"), [(0.01, 1), (0.25, 1), (0.5, 2), (0.8, 3)])
def test_image_share_decodes_some_records_of_a_window_and_others_next_time(share, records, monkeypatch):
    loss, batch = make_loss("reconstruction", image_share=share), make_batch()
    decoder, compared, seen = loss.world_model.decoder, [], set()
    compare = decoder.squared_error
    monkeypatch.setattr(decoder, "squared_error", lambda *given: compared.append(given) or compare(*given))
    for seed in range(20):
        posterior = observed(loss, batch, seed)
        torch.manual_seed(seed)
        losses = loss(batch)
        belief, state, pixels = compared.pop()
        places = [t for image in pixels[0] for t in range(4) if (image == batch["pixels"][0, t]).all()]
        assert len(places) == len(set(places)) == records
        torch.testing.assert_close(belief, posterior.belief[:, places])
        torch.testing.assert_close(state, posterior.state[:, places])
        assert (pixels == batch["pixels"][:, places]).all()
        error = compare(posterior.belief[:, places], posterior.state[:, places], batch["pixels"][:, places])
        torch.testing.assert_close(losses["image_error"], error.detach())
        torch.testing.assert_close(losses["loss_image"], error * 64 * 64 * 3)
        seen |= set(places)
    assert seen == {0, 1, 2, 3}


def test_where_nothing_is_learned_all_images_are_measured():
    batch, found = make_batch(), []
    for share in (1.0, 0.25):
        loss = make_loss("reconstruction", image_share=share)
        torch.manual_seed(2)
        with torch.no_grad():
            found.append(loss(batch)["image_error"])
    assert found[0] == found[1]


def test_all_images_decoded_draw_nothing():
    """Runs of before ``image_share`` go on bit for bit."""
    batch, states = make_batch(), []
    reconstruction = make_loss("reconstruction")
    for loss in (reconstruction, WorldModelLoss(reconstruction.world_model)):
        torch.manual_seed(2)
        loss(batch)
        states.append(torch.get_rng_state())
    assert (states[0] == states[1]).all()


def test_vector_loss_is_the_squared_error_of_symlogs_summed_over_the_vector():
    loss, batch = make_loss("reconstruction", "both"), make_batch()
    posterior = observed(loss, batch)
    output = loss.world_model.vector_decoder.mlp(join_features(posterior.belief, posterior.state)).detach()
    error = (output.double() - symlog(batch["vector"].double())).square().sum(-1).mean()
    torch.manual_seed(2)
    assert loss(batch)["loss_vector"].item() == pytest.approx(error.item(), rel=1e-5)


@pytest.mark.parametrize("scale", [1.0, 0.25])
@pytest.mark.parametrize("name", ["privileged", "informed"])
def test_privileged_loss_by_hand(name, scale):
    loss, batch = make_loss(name, privileged_scale=scale), make_batch()
    posterior = observed(loss, batch)
    output = loss.privileged_decoder.mlp(join_features(posterior.belief, posterior.state)).detach()
    error = (output.double() - symlog(batch["privileged", "vector"].double())).square().sum(-1).mean().item()
    torch.manual_seed(2)
    losses = loss(batch)
    assert losses["loss_privileged"].item() == pytest.approx(scale * error, rel=1e-5)
    assert losses["privileged_error"].item() == pytest.approx(error / PRIVILEGED_DIM, rel=1e-5)


def test_informed_is_the_sum_of_reconstruction_and_privileged():
    """On the same weights and noise, every loss of either is a loss of both."""
    batch = make_batch()
    informed = make_loss("informed")
    reconstruction = ReconstructionLoss(informed.world_model)
    privileged = PrivilegedLoss(informed.world_model, PRIVILEGED_DIM)
    privileged.privileged_decoder = informed.privileged_decoder
    found = {}
    for loss in (reconstruction, privileged):
        torch.manual_seed(2)
        found |= loss(batch).exclude("replay_context").to_dict()
    torch.manual_seed(2)
    for key, value in informed(batch).exclude("replay_context").items():
        torch.testing.assert_close(value, found.pop(key))
    assert not found


def test_heads_and_kl_do_not_depend_on_what_else_shapes_the_latents():
    batch, expected = make_batch(), None
    world_model = make_loss("informed").world_model
    for loss in (
        WorldModelLoss(world_model),
        ReconstructionLoss(world_model),
        PrivilegedLoss(world_model, PRIVILEGED_DIM),
        InformedLoss(world_model, PRIVILEGED_DIM),
        DecoderFreeLoss(world_model),
    ):
        torch.manual_seed(2)
        losses = loss(batch).select(*ALWAYS)
        expected = losses if expected is None else expected
        assert (losses == expected).all()


def test_redundancy_reduction_agrees_with_numpy():
    generator = np.random.default_rng(0)
    first, second = generator.normal(3.0, 2.0, (2, 40, 6))
    second = 0.7 * first + second
    correlation = np.corrcoef(first, second, rowvar=False)[:6, 6:]
    on_diagonal = ((1 - np.diag(correlation)) ** 2).sum()
    off_diagonal = (correlation**2).sum() - (np.diag(correlation) ** 2).sum()
    loss, agreement = redundancy_reduction(torch.tensor(first), torch.tensor(second), 0.3)
    assert loss.item() == pytest.approx(on_diagonal + 0.3 * off_diagonal, rel=1e-4)
    assert agreement.item() == pytest.approx(np.diag(correlation).mean(), rel=1e-4)


def test_redundancy_reduction_of_two_dimensions_by_hand():
    """Dimensions that are copies of one another: correlation ±1 everywhere, so only the off-diagonal part is left."""
    first = torch.tensor([[1.0, 1.0], [-1.0, -1.0], [1.0, 1.0], [-1.0, -1.0]])
    loss, agreement = redundancy_reduction(first, first, 0.1)
    assert loss.item() == pytest.approx(0.2, abs=1e-4)
    assert agreement.item() == pytest.approx(1.0, abs=1e-4)
    # The second dimension turned round: (1 − (−1))² on the diagonal.
    loss, agreement = redundancy_reduction(first, first * torch.tensor([1.0, -1.0]), 0.1)
    assert loss.item() == pytest.approx(4.0 + 0.2, abs=1e-3)
    assert agreement.item() == pytest.approx(0.0, abs=1e-4)


def test_identical_inputs_cost_nothing_on_the_diagonal():
    torch.manual_seed(0)
    values = torch.randn(200, 8) * 5 + 1
    loss, agreement = redundancy_reduction(values, values, 0.0)
    assert loss.item() == pytest.approx(0.0, abs=1e-6)
    assert agreement.item() == pytest.approx(1.0, abs=1e-4)
    assert redundancy_reduction(values, -values, 0.0)[0].item() == pytest.approx(4 * 8, rel=1e-4)


def test_a_dimension_that_never_changes_stays_finite():
    values = torch.randn(10, 3)
    values[:, 1] = 2.0
    values.requires_grad_()
    loss, _ = redundancy_reduction(values, values.detach(), 1.0)
    loss.backward()
    assert loss.isfinite() and values.grad.isfinite().all()


def test_decoder_free_loss_correlates_the_projected_latents_with_the_embedding():
    loss, batch = make_loss("decoder_free", barlow_scale=0.5), make_batch()
    posterior = observed(loss, batch)
    projected = loss.projector(join_features(posterior.belief, posterior.state)).flatten(0, 1)
    embedding = loss.world_model.encoder(batch).flatten(0, 1)
    expected, agreement = redundancy_reduction(projected, embedding, loss.off_diagonal_scale)
    torch.manual_seed(2)
    losses = loss(batch)
    torch.testing.assert_close(losses["loss_barlow"], 0.5 * expected)
    torch.testing.assert_close(losses["agreement"], agreement)


def test_scales_multiply_their_losses():
    batch, found = make_batch(), []
    for scale in (1.0, 3.0):
        loss = make_loss("reward_only", dynamics_scale=scale, representation_scale=0.1 * scale, free_nats=0.0)
        torch.manual_seed(2)
        found.append(loss(batch))
    for key in ("loss_dynamics", "loss_representation"):
        torch.testing.assert_close(3 * found[0][key], found[1][key])
    torch.testing.assert_close(found[0]["loss_dynamics"], 10 * found[0]["loss_representation"])
    torch.testing.assert_close(found[0]["loss_reward"].item(), math.log(255))


@pytest.mark.parametrize("name", ["privileged", "informed"])
def test_no_privileged_numbers_is_an_error_that_says_what_to_do(name):
    with pytest.raises(ValueError, match=r"(Privileged|Informed)Loss needs privileged numbers.*privileged=True"):
        learner_of("debug", Interface(), world_model=name)


def test_reconstruction_without_decoders_is_an_error_that_says_what_to_do():
    with pytest.raises(ValueError, match=r"ReconstructionLoss needs a world model with decoders.*decode=True"):
        ReconstructionLoss(WorldModel("debug", decode=False))


def test_unknown_kl_mode_is_an_error_that_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'balanced'.*separate, per_latent"):
        WorldModelLoss(WorldModel("debug"), kl_mode="balanced")


@pytest.mark.parametrize("name", ADDED)
def test_only_losses_that_decode_have_decoders(name):
    world_model = learner_of("debug", SIGHTS["both"], world_model=name).agent.world_model
    decodes = name in ("reconstruction", "informed")
    assert (world_model.decoder is not None) == (world_model.vector_decoder is not None) == decodes
