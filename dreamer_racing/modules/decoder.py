"""Decoders: belief and state to the mean of an RGB image, or of numbers.

Shape legend: N any batch, C channels, V numbers, F features, G blocks.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dreamer_racing.modules.encoder import fold_patches, make_convolution, smallest_map, unfold_patches
from dreamer_racing.modules.heads import MLP, symexp, symlog
from dreamer_racing.modules.layers import NORMS, BlockLinear, NormedLinear, in_own_type, initialize_convolution, linear


class DenseProjection(nn.Module):
    """One linear layer from belief and state to the smallest feature map (2023)."""

    def __init__(self, belief: int, state: int, resolution: int, channels: int) -> None:
        super().__init__()
        self.shape = (resolution, resolution, channels)
        self.linear = linear(belief + state, resolution**2 * channels)

    def forward(self, belief: Tensor, state: Tensor) -> Tensor:
        """Map ``(N, belief)`` and ``(N, state)`` to ``(N, height, width, C)``."""
        return self.linear(torch.cat((belief, state), -1)).unflatten(-1, self.shape)


class BlockProjection(nn.Module):
    """Block-diagonal layer for the belief, one channel group a block, plus two layers for the state (2025)."""

    def __init__(
        self, belief: int, state: int, resolution: int, channels: int, blocks: int, units: int, norm: str
    ) -> None:
        super().__init__()
        self.shape = (resolution, resolution, channels)
        self.blocks = blocks
        self.from_belief = BlockLinear(belief, resolution**2 * channels, blocks)
        self.from_state = nn.Sequential(
            NormedLinear(state, 2 * units, norm), linear(2 * units, resolution**2 * channels)
        )

    def forward(self, belief: Tensor, state: Tensor) -> Tensor:
        """Map ``(N, belief)`` and ``(N, state)`` to ``(N, height, width, C)``."""
        height, width, channels = self.shape
        # (N, G, height, width, C/G) -> (N, height, width, C)
        grouped = self.from_belief(belief).view(-1, self.blocks, height, width, channels // self.blocks)
        maps = grouped.permute(0, 2, 3, 1, 4).reshape(-1, *self.shape)
        return maps + self.from_state(state).unflatten(-1, self.shape)


class UpsampledConvolution(nn.Module):
    """Nearest-neighbour doubling of the image, then a convolution."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__()
        self.convolution = make_convolution(in_channels, out_channels, kernel)

    def forward(self, maps: Tensor) -> Tensor:
        """Map ``(N, C, H, W)`` to ``(N, C', 2H, 2W)``."""
        with in_own_type(maps):
            doubled = F.interpolate(maps, scale_factor=2.0, mode="nearest")
        return self.convolution(doubled)


class StridedConvolution(nn.ConvTranspose2d):
    """Transposed convolution of stride 2: a quarter of the FLOPs of ``UpsampledConvolution``."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int) -> None:
        super().__init__(in_channels, out_channels, kernel, 2, (kernel - 1) // 2, output_padding=kernel % 2)
        # Each output pixel sums over a quarter of the kernel's positions.
        initialize_convolution(self, in_channels * kernel**2 // 4)


class ImageDecoder(nn.Module):
    """Mirror of ``ImageEncoder``: a projection to the smallest map, then doublings up to the image.

    Args:
        belief: Width of h.
        state: Width of z.
        units: Width of the state's hidden layer is ``2 * units``; used with more than one block.
        depth: Channels of a stage are ``depth * multiplier``.
        multipliers: One per stage, from the image inwards (the encoder's order).
        kernel: Kernel size, pixels.
        strided: Use transposed convolutions of stride 2 rather than nearest upsampling.
        blocks: Blocks of the belief's projection; 1 projects belief and state densely.
        norm: ``"rms"`` or ``"layer"``.
        patch: Side of the pixel blocks that are unfolded from channels after the last stage; 1 unfolds nothing.
        image_size: Height and width of the images, pixels.

    Raises:
        ValueError: If images of that size cannot be halved so often.

    Reference: danijar/dreamerv3, ``rssm.Decoder``.
    """

    def __init__(
        self,
        belief: int,
        state: int,
        units: int,
        depth: int,
        multipliers: Sequence[int] = (2, 3, 4, 4),
        kernel: int = 5,
        strided: bool = False,
        blocks: int = 8,
        norm: str = "rms",
        patch: int = 1,
        image_size: int = 64,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.image_size = image_size
        channels = [depth * multiplier for multiplier in reversed(multipliers)]
        resolution = smallest_map(image_size, patch, len(channels))
        self.projection: nn.Module = (
            BlockProjection(belief, state, resolution, channels[0], blocks, units, norm)
            if blocks > 1
            else DenseProjection(belief, state, resolution, channels[0])
        )
        convolution = StridedConvolution if strided else UpsampledConvolution
        self.norms = nn.ModuleList(NORMS[norm](count) for count in channels)
        self.convolutions = nn.ModuleList(
            convolution(before, after, kernel)
            for before, after in zip(channels, [*channels[1:], 3 * patch**2], strict=True)
        )

    def forward(self, belief: Tensor, state: Tensor) -> Tensor:
        """Predict images.

        Args:
            belief: ``(..., belief)``.
            state: ``(..., state)``.

        Returns:
            Mean of the image in [0, 1], ``(..., height, width, 3)``.
        """
        images = unfold_patches(self._folded(belief, state), self.patch)
        return images.reshape(*belief.shape[:-1], self.image_size, self.image_size, 3)

    def squared_error(self, belief: Tensor, state: Tensor, pixels: Tensor) -> Tensor:
        """Compare predicted images with true ones, in whatever order of pixels is cheapest.

        Args:
            belief: ``(..., belief)``.
            state: ``(..., state)``.
            pixels: uint8 ``(..., height, width, 3)``.

        Returns:
            Mean over batch, pixels and channels of the squared error of values in [0, 1], a scalar.
        """
        target = fold_patches(pixels.flatten(0, -4), self.patch).float().div_(255.0)
        return F.mse_loss(self._folded(belief, state).float(), target)

    def _folded(self, belief: Tensor, state: Tensor) -> Tensor:
        """Predict images ``(N, height / patch, width / patch, patch² · 3)``."""
        maps = self.projection(belief.flatten(0, -2), state.flatten(0, -2))
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            maps = convolution(F.silu(norm(maps)).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return torch.sigmoid(maps)


class VectorDecoder(nn.Module):
    """Hidden layers to the symlog of numbers.

    Args:
        features: F.
        outputs: V.
        layers: Number of hidden layers.
        units: Their width.
        norm: ``"rms"`` or ``"layer"``.

    Reference: danijar/dreamerv3, ``rssm.Decoder``: symlog squared error.
    """

    def __init__(self, features: int, outputs: int, layers: int = 3, units: int = 256, norm: str = "rms") -> None:
        super().__init__()
        self.mlp = MLP(features, outputs, layers, units, norm)

    def forward(self, features: Tensor) -> Tensor:
        """Map features ``(..., F)`` to the numbers expected ``(..., V)``."""
        return symexp(self.mlp(features).float())

    def squared_error(self, features: Tensor, vector: Tensor) -> Tensor:
        """Compare with true numbers ``(..., V)``: squared error of symlogs, summed over V, mean over the rest."""
        return (self.mlp(features).float() - symlog(vector)).square().sum(-1).mean()
