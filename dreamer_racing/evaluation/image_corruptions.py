"""Image corruptions: a policy that relies on vision must fail when its images are frozen, blank or noise."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from dreamer_racing.learners.learner import Policy

Corruption = Callable[[Tensor, Tensor], Tensor]
"""Maps images (N, H, W, 3) uint8 and ``is_init`` (N,) bool to the images that the policy sees."""


def intact(pixels: Tensor, is_init: Tensor) -> Tensor:
    """Return the images unchanged, as the baseline."""
    return pixels


def blank(pixels: Tensor, is_init: Tensor) -> Tensor:
    """Return grey images."""
    return torch.full_like(pixels, 128)


class Frozen:
    """Repeats the first image of each episode until the episode ends."""

    def __init__(self) -> None:
        self._first: Tensor | None = None  # (N, H, W, 3)

    def __call__(self, pixels: Tensor, is_init: Tensor) -> Tensor:
        """Return the first image of each episode."""
        begins = is_init.view(-1, 1, 1, 1)
        self._first = pixels.clone() if self._first is None else torch.where(begins, pixels, self._first)
        return self._first


class Noise:
    """Replaces images by uniform noise, independent for every pixel, colour channel and step."""

    def __init__(self, seed: int = 0) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, pixels: Tensor, is_init: Tensor) -> Tensor:
        """Return noise."""
        noise = torch.randint(256, pixels.shape, generator=self._generator, dtype=torch.uint8)
        return noise.to(pixels.device)


CORRUPTIONS: dict[str, Callable[[], Corruption]] = {
    "intact": lambda: intact,
    "frozen": Frozen,
    "blank": lambda: blank,
    "noise": Noise,
}
"""Factories of corruptions by name. Make a new corruption for every evaluation, because it may store images."""


class CorruptedPolicy(torch.nn.Module):
    """A policy that acts on corrupted images; the tensordict keeps the original ones."""

    def __init__(self, policy: Policy, corruption: Corruption) -> None:
        super().__init__()
        self.policy = policy
        self._corruption = corruption

    @property
    def deterministic(self) -> bool:
        """Whether the policy acts without sampling."""
        return self.policy.deterministic

    @deterministic.setter
    def deterministic(self, deterministic: bool) -> None:
        self.policy.deterministic = deterministic

    def make_primer(self) -> Transform:
        """Return the primer of the policy."""
        return self.policy.make_primer()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act on the corrupted images; raise ValueError if there are none."""
        pixels = tensordict.get("pixels", None)
        if pixels is None:
            raise ValueError("image corruptions need images: the environment has no 'pixels'.")
        seen = tensordict.copy().set("pixels", self._corruption(pixels, tensordict["is_init"].flatten()))
        return self.policy(seen).set("pixels", pixels)
