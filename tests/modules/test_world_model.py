"""The world model, its encoder and its decoder."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dreamer_racing.modules import SIZES, WorldModel
from dreamer_racing.modules.autoencoder import (
    ImageDecoder,
    ImageEncoder,
    _centred,
    fold_patches,
    smallest_map,
    unfold_patches,
)
from dreamer_racing.modules.layers import autocast


def make_records(batch: int = 2, time: int = 5) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (batch, time, 64, 64, 3), dtype=torch.uint8)
    return {"pixels": pixels}, torch.rand(batch, time, 4) * 2 - 1, torch.zeros(batch, time, dtype=torch.bool)


def test_open_loop_never_sees_what_lies_beyond_its_context():
    world_model = WorldModel("debug")
    seen, action, is_init = make_records()
    changed = seen["pixels"].clone()
    changed[:, 2:] = 0
    latents = []
    for version in (seen["pixels"], changed):
        torch.manual_seed(1)
        latents.append(world_model.open_loop({"pixels": version}, action, is_init, num_observed=2))
    assert all(map(torch.equal, *latents))
    images = world_model.images(*latents[0])
    assert images.shape == changed.shape
    assert images.dtype == torch.uint8


def test_the_context_is_a_part_of_the_window_or_all_of_it():
    world_model = WorldModel("debug", decode=False)
    for context in (0, 6):
        with pytest.raises(ValueError, match="num_observed must lie"):
            world_model.open_loop(*make_records(), num_observed=context)
    belief, state = world_model.open_loop(*make_records(), num_observed=5)
    assert belief.shape[:2] == state.shape[:2] == (2, 5)
    with pytest.raises(ValueError, match="no image decoder"):
        world_model.images(belief, state)


SMALL = replace(SIZES["size1m"], belief=8, latents=2, classes=3, units=4, cnn_depth=2, blocks=1)
LAYER = replace(SMALL, cnn_multipliers=(1, 2, 4, 8), cnn_kernel=4, strided=True, norm="layer")
VARIANTS = [SMALL, replace(SMALL, strided=True), LAYER, replace(LAYER, cnn_multipliers=(1, 2, 4), cnn_patch=2)]


@pytest.mark.parametrize(("image_size", "side"), [(32, 2), (64, 4), (96, 6)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_encoder_and_decoder_shapes(variant, image_size, side):
    encoder = ImageEncoder(variant, image_size)
    embedding = encoder(torch.randint(0, 256, (2, 3, image_size, image_size, 3), dtype=torch.uint8))
    channels = 2 * variant.cnn_multipliers[-1]
    assert embedding.shape == (2, 3, encoder.embedding_size) == (2, 3, side * side * channels)
    for blocks in (1, 2):
        decoder = ImageDecoder(replace(variant, blocks=blocks), image_size)
        images = decoder(torch.randn(2, 3, 8), torch.randn(2, 3, 6))
        assert images.shape == (2, 3, image_size, image_size, 3)
        assert images.min() > 0
        assert images.max() < 1


@pytest.mark.parametrize("image_size", [40, 8, 0, -16])
def test_images_that_cannot_be_halved_are_refused(image_size):
    assert smallest_map(16, patch=2, stages=3) == 1
    message = f"image_size={image_size}: .* 2 × 2 pixels .* 3 times, .* multiple of 16, for instance 32, 64 or 96"
    for kind in (ImageEncoder, ImageDecoder):
        with pytest.raises(ValueError, match=message):
            kind(VARIANTS[-1], image_size)


@pytest.mark.parametrize("variant", VARIANTS)
def test_squared_error_is_that_of_the_images(variant):
    torch.manual_seed(0)
    decoder = ImageDecoder(variant)
    belief, state = torch.randn(2, 3, 8), torch.randn(2, 3, 6)
    pixels = torch.randint(0, 256, (2, 3, 64, 64, 3), dtype=torch.uint8)
    expected = (decoder(belief, state) - pixels / 255).square().mean()
    torch.testing.assert_close(decoder.squared_error(belief, state, pixels), expected)


def test_folding_is_undone_by_unfolding():
    images = torch.arange(2 * 4 * 4 * 3).view(2, 4, 4, 3)
    folded = fold_patches(images, 2)
    assert folded.shape == (2, 2, 2, 12)
    assert folded[0, 0, 0].tolist() == [*range(6), *range(12, 18)]  # the top left block: two pixels of two rows
    assert torch.equal(unfold_patches(folded, 2), images)


@pytest.mark.parametrize("variant", VARIANTS)
def test_first_stage_sees_pixels_scaled_to_half(variant):
    encoder = ImageEncoder(variant)
    seen = []
    encoder.convolutions[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    encoder(torch.tensor([0, 255], dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 64, 64, 3))
    torch.testing.assert_close(seen[0][0], torch.full_like(seen[0][0], -0.5))
    torch.testing.assert_close(seen[0][1], torch.full_like(seen[0][1], 0.5))
    assert seen[0].is_contiguous(memory_format=torch.channels_last)


def test_embedding_depends_on_every_region_of_the_image():
    torch.manual_seed(0)
    for variant in VARIANTS:
        encoder = ImageEncoder(variant)
        black = torch.zeros(1, 64, 64, 3, dtype=torch.uint8)
        for row, column in ((0, 0), (0, 60), (60, 0), (30, 30)):
            spotted = black.clone()
            spotted[:, row : row + 4, column : column + 4] = 255
            assert not torch.allclose(encoder(spotted), encoder(black))


def test_images_are_centred_under_autocast_as_in_float32_and_rounded_once():
    images = torch.arange(256, dtype=torch.uint8).view(1, 16, 16, 1)
    exact = _centred(images)
    assert exact.dtype == torch.float32 and (exact.min(), exact.max()) == (-0.5, 0.5)
    with autocast(torch.device("cpu"), enabled=True):
        assert torch.equal(_centred(images), exact.to(torch.bfloat16))
