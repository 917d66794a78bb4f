"""The world-model loss with each row of targets: what it writes, values by hand, what is said if something lacks."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.losses import TARGETS, Barlow, LossConfig, Target, WorldModelLoss, find_targets
from dreamer_racing.losses.world_model import Image, State, Vector, redundancy_reduction
from dreamer_racing.modules import SIZES, Interface, join_features, symlog
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.layers import autocast
from tests.dreamers import differing, learner_of, make_windows

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


def make_batch() -> TensorDict:
    """Dark images, and numbers of several sizes."""
    places = {"is_init": [(0, 2)], "terminated": [(0, 1)]}
    batch = make_windows(2, 4, **places, vector=VECTOR_DIM, privileged=PRIVILEGED_DIM).exclude("truncated")
    for key, scale in (("pixels", 0.25), ("vector", 10.0), (("privileged", "vector"), 10.0)):
        batch[key] = (batch[key] * scale).to(batch[key].dtype)
    return batch


def decodes(name: str) -> bool:
    return any(target.decodes for target in TARGETS[name])


def make_loss(name: str, sight: str = "pixels", **options) -> WorldModelLoss:
    torch.manual_seed(0)
    return WorldModelLoss(Agent(SIZES["debug"], SIGHTS[sight], decodes(name)), LossConfig(world_model=name, **options))


def observed(loss: WorldModelLoss, batch: TensorDict, seed: int = 2):
    """The latents that ``loss`` sees after the same seed."""
    torch.manual_seed(seed)
    world_model = loss.world_model
    return world_model.observe(batch, batch["previous_action"], batch["is_init"].squeeze(-1))


def test_every_registered_loss_is_tested_here():
    assert ADDED.keys() == TARGETS.keys()


@pytest.mark.parametrize("name", ADDED)
def test_documented_keys_exist_and_are_finite(name):
    losses, latents = make_loss(name)(make_batch())
    assert set(losses) == ALWAYS | ADDED[name]
    assert latents.belief.shape == (2, 4, 32) and latents.features.shape == (2, 4, 48)
    for key, value in losses.items():
        assert value.shape == () and value.isfinite(), key
        assert value.requires_grad == key.startswith("loss_"), key


@pytest.mark.parametrize("sight", SIGHTS)
@pytest.mark.parametrize("name", ADDED)
def test_losses_read_what_the_agent_sees(name, sight):
    """A batch of nothing but ``in_keys`` is enough, and each of them is asked for by name."""
    loss, batch = make_loss(name, sight), make_batch()
    seen = {"pixels": ["pixels"], "vector": ["vector"], "both": ["pixels", "vector"]}[sight]
    privileged = [("privileged", "vector")] if State in TARGETS[name] else []
    records = ["previous_action", "reward", "is_init", "terminated"]
    assert sorted(map(str, loss.in_keys)) == sorted(map(str, [*seen, *records, *privileged]))
    batch = batch.select(*loss.in_keys)
    losses, _ = loss(batch)
    decoded = {"loss_image": "pixels", "loss_vector": "vector"} if decodes(name) else {}
    for key, source in decoded.items():
        assert (key in losses) == (source in seen)
    for key in loss.in_keys:
        lacking = batch.exclude(key)
        with pytest.raises(KeyError) as error:
            loss(lacking)
        assert repr(key) in str(error.value)


@pytest.mark.parametrize("name", ADDED)
def test_flops_can_be_counted_on_the_meta_device(name):
    loss, batch = make_loss(name).to("meta"), make_batch().to("meta")
    with autocast(torch.device("meta"), enabled=True):
        losses, _ = loss(batch)
    assert all(value.is_meta for key, value in losses.items() if key.startswith("loss_"))


@pytest.mark.parametrize("name", ADDED)
def test_alone_in_a_training_loop(name):
    """Without learner, actor or critic, with any optimiser."""
    loss, batch = make_loss(name), make_batch()
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    totals = []
    for _ in range(30):
        optimizer.zero_grad()
        losses, _ = loss(batch)
        total = sum(value for key, value in losses.items() if key.startswith("loss_"))
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert np.mean(totals[-3:]) < 0.9 * totals[0]


def losses_of(loss: WorldModelLoss, batch: TensorDict, seed: int = 2) -> dict[str, torch.Tensor]:
    torch.manual_seed(seed)
    return loss(batch)[0]


def test_image_loss_is_the_squared_error_summed_over_an_image():
    loss, batch = make_loss("reconstruction"), make_batch()
    posterior = observed(loss, batch)
    images = loss.world_model.decoder(posterior.belief, posterior.state).detach().double().numpy()
    error = (images - batch["pixels"].numpy() / 255.0) ** 2  # (B, T, 64, 64, 3)
    losses = losses_of(loss, batch)
    assert losses["loss_image"].item() == pytest.approx(error.sum((2, 3, 4)).mean(), rel=1e-5)
    assert losses["image_error"].item() == pytest.approx(error.mean(), rel=1e-5)


@pytest.mark.parametrize(
    ("name", "key", "scale"),
    [
        ("reconstruction", "image", 0.25), ("informed", "image", 0.25), ("informed", "privileged", 0.25),
        ("privileged", "privileged", 0.25), ("decoder_free", "barlow", 3.0), ("reward_only", "dynamics", 3.0),
        ("reward_only", "representation", 3.0),
    ],
)  # fmt: skip
def test_a_scale_multiplies_its_loss_alone(name, key, scale):
    losses = [make_loss(name, free_nats=0.0, **{f"{key}_scale": number}) for number in (1.0, scale)]
    whole, scaled = (losses_of(loss, make_batch()) for loss in losses)
    whole[f"loss_{key}"] = whole[f"loss_{key}"] * scale
    torch.testing.assert_close(whole, scaled)


@pytest.mark.parametrize(("share", "records"), [(0.01, 1), (0.25, 1), (0.5, 2), (0.8, 3)])
def test_image_share_decodes_some_records_of_a_window_and_others_next_time(share, records, monkeypatch):
    loss, batch = make_loss("reconstruction", image_share=share), make_batch()
    decoder, compared, seen = loss.world_model.decoder, [], set()
    compare = decoder.squared_error
    monkeypatch.setattr(decoder, "squared_error", lambda *given: compared.append(given) or compare(*given))
    for seed in range(20):
        posterior = observed(loss, batch, seed)
        torch.manual_seed(seed)
        losses, _ = loss(batch)
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
    with torch.no_grad():
        found = [losses_of(make_loss("reconstruction", image_share=share), make_batch()) for share in (1.0, 0.25)]
    assert found[0]["image_error"] == found[1]["image_error"]


def test_all_images_decoded_draw_nothing():
    states = []
    for name in ("reconstruction", "reward_only"):
        losses_of(make_loss(name), make_batch())
        states.append(torch.get_rng_state())
    assert torch.equal(*states)


@pytest.mark.parametrize(
    ("name", "sight", "key"),
    [("reconstruction", "both", "vector"), ("privileged", "pixels", "privileged"), ("informed", "both", "privileged")],
)
def test_numbers_are_decoded_by_the_squared_error_of_symlogs_summed_over_them(name, sight, key):
    loss, batch = make_loss(name, sight, privileged_scale=1.0), make_batch()
    posterior = observed(loss, batch)
    decoder = loss.world_model.vector_decoder if key == "vector" else loss.targets["State"].decoder
    output = decoder.mlp(join_features(posterior.belief, posterior.state)).detach()
    truth = batch["vector"] if key == "vector" else batch["privileged", "vector"]
    error = (output.double() - symlog(truth.double())).square().sum(-1).mean().item()
    losses = losses_of(loss, batch)
    assert losses[f"loss_{key}"].item() == pytest.approx(error, rel=1e-5)
    if key == "privileged":
        assert losses["privileged_error"].item() == pytest.approx(error / PRIVILEGED_DIM, rel=1e-5)


def test_informed_is_the_sum_of_reconstruction_and_privileged():
    """On the same weights and noise, every loss of either is a loss of both; heads and KL are those of any."""
    batch, found = make_batch(), {}
    informed = make_loss("informed")
    for name in ("reward_only", "reconstruction", "privileged", "decoder_free"):
        loss = make_loss(name)
        loss.world_model = informed.world_model
        for key, target in loss.targets.items():
            target.world_model = informed.world_model
            if key in informed.targets:
                loss.targets[key] = informed.targets[key]
        losses = losses_of(loss, batch)
        for key in losses.keys() & found.keys():
            assert torch.equal(losses[key], found[key]), key
        found |= losses
    both = losses_of(informed, batch)
    assert not differing(both, {key: found[key] for key in both})


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
    target = loss.targets["Barlow"]
    projected = target.projector(join_features(posterior.belief, posterior.state)).flatten(0, 1)
    embedding = loss.world_model.encoder(batch).flatten(0, 1)
    expected, agreement = redundancy_reduction(projected, embedding, target.off_diagonal_scale)
    losses = losses_of(loss, batch)
    torch.testing.assert_close(losses["loss_barlow"], 0.5 * expected)
    torch.testing.assert_close(losses["agreement"], agreement)


def test_the_representation_learns_at_a_tenth_of_the_rate_of_the_dynamics():
    losses = losses_of(make_loss("reward_only", free_nats=0.0), make_batch())
    torch.testing.assert_close(losses["loss_dynamics"], 10 * losses["loss_representation"])
    torch.testing.assert_close(losses["loss_reward"].item(), math.log(255))


def test_what_a_target_lacks_is_an_error_that_says_what_to_do():
    for name in ("privileged", "informed"):
        with pytest.raises(ValueError, match=r"target State needs privileged numbers.*privileged=True"):
            learner_of(world_model=name)
    agent = Agent(SIZES["debug"], Interface(), decode=False)
    with pytest.raises(ValueError, match=r"'reconstruction' needs a world model with decoders: Agent\(\.\.\., decode"):
        WorldModelLoss(agent, LossConfig())


class Image2(Image):
    """Has the names of `Image`."""


Named = type("Image", (Image,), {})
"""Is called as `Image` is."""


class Reward(Target):
    """Has the name of a metric of the world model."""

    def forward(self, posterior, features, embedding, batch):
        return {"reward_error": features.mean()}


@pytest.mark.parametrize(("own", "names"), [(Image2, "loss_image and image_error"), (Reward, "reward_error")])
def test_a_target_whose_losses_have_taken_names_is_refused(own, names, monkeypatch):
    monkeypatch.setitem(TARGETS, "own", (Image, own))
    with pytest.raises(ValueError, match=f"Two losses or metrics are called {names}: rename yours"):
        make_loss("own")(make_batch())


def test_two_targets_of_one_class_name_are_refused(monkeypatch):
    monkeypatch.setitem(TARGETS, "own", (Image, Named))
    with pytest.raises(ValueError, match="loss.world_model=own: two targets have one class name"):
        make_loss("own")


@pytest.mark.parametrize("name", ADDED)
def test_only_losses_that_decode_have_decoders(name):
    world_model = learner_of("debug", SIGHTS["both"], world_model=name).agent.world_model
    assert (world_model.decoder is not None) == (world_model.vector_decoder is not None) == decodes(name)


def test_targets_are_rows_of_a_table_or_of_ones_own_and_may_be_joined(tmp_path, monkeypatch):
    assert find_targets("informed") == (Image, Vector, State) and find_targets("reward_only") == ()
    assert find_targets("privileged+informed+decoder_free") == (State, Image, Vector, Barlow), "each once"
    with pytest.raises(ValueError, match=r"Unknown loss 'informd' \(did you mean informed\?\)"):
        find_targets("informd")
    (tmp_path / "my_targets.py").write_text("from dreamer_racing.losses import State as Mine\nother = 3\n")
    monkeypatch.chdir(tmp_path)
    assert find_targets("reconstruction+my_targets:Mine") == (Image, Vector, State)
    with pytest.raises(ValueError, match="'my_targets:other' is not a subclass of dreamer_racing.losses.Target"):
        find_targets("my_targets:other")
    with pytest.raises(ValueError, match=r"no absent\.py in .*set PYTHONPATH"):
        find_targets("absent:Mine")
    with pytest.raises(NotImplementedError, match="Target must implement forward"):
        Target(Agent(SIZES["debug"], Interface()), LossConfig())(None, None, None, None)
