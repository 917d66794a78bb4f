import pytest
import torch

from dreamer_racing.modules.world_model import WorldModel


def make_records(batch: int = 2, time: int = 5) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (batch, time, 64, 64, 3), dtype=torch.uint8)
    return {"pixels": pixels}, torch.rand(batch, time, 4) * 2 - 1, torch.zeros(batch, time, dtype=torch.bool)


def test_open_loop_never_sees_what_lies_beyond_its_context():
    world_model = WorldModel("debug")
    seen, action, is_init = make_records()
    pixels = seen["pixels"]
    changed = pixels.clone()
    changed[:, 2:] = 0
    latents = []
    for version in (pixels, changed):
        torch.manual_seed(1)
        latents.append(world_model.open_loop({"pixels": version}, action, is_init, context=2))
    for one, other in zip(*latents, strict=True):
        assert torch.equal(one, other)
    images = world_model.images(*latents[0])
    assert images.shape == pixels.shape
    assert images.dtype == torch.uint8


def test_a_world_model_without_image_decoder_has_no_images():
    world_model = WorldModel("debug", decode=False)
    with pytest.raises(ValueError, match="no image decoder"):
        world_model.images(*world_model.open_loop(*make_records(), context=2))


@pytest.mark.parametrize("context", [0, 6])
def test_open_loop_refuses_a_context_outside_the_window(context):
    with pytest.raises(ValueError, match="context"):
        WorldModel("debug").open_loop(*make_records(), context=context)


def test_whole_window_may_be_context():
    belief, state = WorldModel("debug").open_loop(*make_records(), context=5)
    assert belief.shape[:2] == state.shape[:2] == (2, 5)
