"""Image corruptions: what the policy sees, and that nobody else sees it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.evaluation.image_corruptions import CORRUPTIONS, CorruptedPolicy, Frozen, Noise, blank, intact


def images(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.uint8).view(-1, 1, 1, 1).expand(-1, 2, 2, 3).clone()


class Watching:
    """Remembers what it saw."""

    deterministic = False

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def __call__(self, tensordict):
        self.seen.append(tensordict["pixels"].clone())
        return tensordict.set("action", torch.zeros(*tensordict.batch_size, 4))


def root(pixels: torch.Tensor, *is_init: bool) -> TensorDict:
    return TensorDict({"pixels": pixels, "is_init": torch.tensor(is_init).unsqueeze(1)}, [len(pixels)])


def test_frozen_shows_the_first_image_of_each_episode():
    frozen = Frozen()
    shown = [
        frozen(images(1, 2), torch.tensor([True, True])),
        frozen(images(3, 4), torch.tensor([False, False])),
        frozen(images(5, 6), torch.tensor([False, True])),
        frozen(images(7, 8), torch.tensor([False, False])),
    ]
    assert [image[:, 0, 0, 0].tolist() for image in shown] == [[1, 2], [1, 2], [1, 6], [1, 6]]


def test_frozen_survives_images_that_are_changed_in_place():
    frozen, pixels = Frozen(), images(1)
    frozen(pixels, torch.tensor([True]))
    pixels.fill_(9)
    assert frozen(pixels, torch.tensor([False])).unique().tolist() == [1]


def test_blank_is_grey_and_intact_is_itself():
    pixels = images(1, 2)
    assert blank(pixels, torch.ones(2)).unique().tolist() == [128]
    assert intact(pixels, torch.ones(2)) is pixels


def test_noise_is_uniform_new_at_every_step_and_seeded():
    pixels, begins = torch.zeros(4, 64, 64, 3, dtype=torch.uint8), torch.zeros(4)
    noise = Noise(seed=3)
    first, second = noise(pixels, begins), noise(pixels, begins)
    assert first.dtype == torch.uint8 and not torch.equal(first, second)
    assert torch.equal(first, Noise(seed=3)(pixels, begins))
    counts = torch.bincount(first.flatten().int(), minlength=256) / (first.numel() / 256)
    assert counts.min() > 0.6 and counts.max() < 1.4


def test_only_the_policy_sees_corrupted_images():
    watching, data = Watching(), root(images(1, 2), True, True)
    policy = CorruptedPolicy(watching, blank)
    acted = policy(data)
    assert watching.seen[0].unique().tolist() == [128]
    assert acted["pixels"][:, 0, 0, 0].tolist() == data["pixels"][:, 0, 0, 0].tolist() == [1, 2]
    assert acted["action"].shape == (2, 4)
    policy.deterministic = True
    assert watching.deterministic and policy.deterministic


def test_every_corruption_is_made_afresh():
    assert set(CORRUPTIONS) == {"intact", "frozen", "blank", "noise"}
    assert CORRUPTIONS["frozen"]() is not CORRUPTIONS["frozen"]()


def test_blind_policies_are_refused():
    data = TensorDict({"vector": torch.zeros(1, 21), "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1])
    with pytest.raises(ValueError, match="no 'pixels'"):
        CorruptedPolicy(Watching(), blank)(data)
