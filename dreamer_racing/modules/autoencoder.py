"""Encoders from observations to one flat embedding, and decoders from belief and state to predicted observations.

Shape legend: N any batch, C channels, V vector, E embedding, F features, G blocks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dreamer_racing.modules.heads import MLP, symexp, symlog
from dreamer_racing.modules.interface import PIXELS, Interface
from dreamer_racing.modules.layers import (
    NORMS,
    BlockLinear,
    NormedLinear,
    autocast_type,
    in_own_type,
    initialize_convolution,
    linear,
)
from dreamer_racing.modules.sizes import ModelSize


def smallest_map(image_size: int, patch: int, stages: int) -> int:
    """Return the side of the last feature map of an image whose pixel blocks are folded and which is then halved.

    Args:
        image_size: Height and width of the image, pixels.
        patch: Side of the blocks.
        stages: Number of halvings.

    Raises:
        ValueError: If the image's size is not divisible by that.
    """
    step = patch * 2**stages
    if image_size < 1 or image_size % step:
        raise ValueError(
            f"image_size={image_size}: the networks fold blocks of {patch} × {patch} pixels and halve the image "
            f"{stages} times, so it must be a multiple of {step}, for instance {2 * step}, {4 * step} or {6 * step}."
        )
    return image_size // step


def make_convolution(in_channels: int, out_channels: int, kernel: int, stride: int = 1) -> nn.Conv2d:
    """Make a convolution that keeps (stride 1) or halves (stride 2) an even image, in channels-last layout."""
    padding: str | int = "same" if stride == 1 else (kernel - 1) // 2
    layer = nn.Conv2d(in_channels, out_channels, kernel, stride, padding)
    initialize_convolution(layer, in_channels * kernel**2)
    return layer


def fold_patches(images: Tensor, patch: int) -> Tensor:
    """Fold pixel blocks into channels: ``(N, H, W, C)`` to ``(N, H / patch, W / patch, patch² · C)``."""
    if patch == 1:
        return images
    count, height, width, channels = images.shape
    blocks = images.view(count, height // patch, patch, width // patch, patch * channels)
    return torch.cat(blocks.unbind(2), -1)  # a transposed copy is slower on a CPU


def unfold_patches(maps: Tensor, patch: int) -> Tensor:
    """Undo ``fold_patches``."""
    if patch == 1:
        return maps
    count, rows, columns, channels = maps.shape
    blocks = maps.reshape(count, rows, columns, patch, channels // patch)
    return blocks.transpose(2, 3).reshape(count, rows * patch, columns * patch, channels // patch**2)


def _centred(images: Tensor) -> Tensor:
    """Map uint8 to [−0.5, 0.5], in float32, or in bfloat16 under autocast."""
    if autocast_type(images.device.type) is torch.bfloat16:
        # x − 127.5 is exact in bfloat16's 8 bits, so this rounds only once, like a cast from float32.
        return images.to(torch.bfloat16).sub_(127.5).mul_(1.0 / 255.0)
    return images.float().div_(255.0).sub_(0.5)


class ImageEncoder(nn.Module):
    """Convolutions that halve the image, each followed by normalisation over channels and SiLU.

    Args:
        depth: Channels of a stage are ``depth * multiplier``.
        multipliers: One for each stage, which halves the image.
        kernel: Kernel size, pixels.
        strided: Halve by stride 2 rather than by a 2×2 max-pool; four times fewer FLOPs.
        norm: ``"rms"`` or ``"layer"``.
        patch: Side of the pixel blocks that are folded into channels before the first stage; 1 folds nothing.
        image_size: Height and width of the images, pixels.

    Raises:
        ValueError: If images of that size cannot be halved so often.

    Example:
        >>> import torch
        >>> encoder = ImageEncoder(depth=4)
        >>> encoder(torch.zeros(2, 64, 64, 3, dtype=torch.uint8)).shape
        torch.Size([2, 256])

    Reference: danijar/dreamerv3, ``rssm.Encoder``.
    """

    def __init__(
        self,
        depth: int,
        multipliers: Sequence[int] = (2, 3, 4, 4),
        kernel: int = 5,
        strided: bool = False,
        norm: str = "rms",
        patch: int = 1,
        image_size: int = 64,
    ) -> None:
        super().__init__()
        self.patch = patch
        channels = [depth * multiplier for multiplier in multipliers]
        stride = 2 if strided else 1
        self.convolutions = nn.ModuleList(
            make_convolution(before, after, kernel, stride)
            for before, after in zip([3 * patch**2, *channels[:-1]], channels, strict=True)
        )
        self.norms = nn.ModuleList(NORMS[norm](count) for count in channels)
        self.pool = nn.Identity() if strided else nn.MaxPool2d(2)
        self.embedding_size = smallest_map(image_size, patch, len(channels)) ** 2 * channels[-1]

    def forward(self, pixels: Tensor) -> Tensor:
        """Embed images.

        Args:
            pixels: uint8 ``(..., height, width, 3)``.

        Returns:
            float32 ``(..., E)``.
        """
        batch = pixels.shape[:-3]
        # Channels-last throughout: (N, H, W, C) in memory, (N, C, H, W) to the convolutions.
        images = _centred(fold_patches(pixels.flatten(0, -4), self.patch))
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            maps = self.pool(convolution(images.permute(0, 3, 1, 2)))
            images = F.silu(norm(maps.permute(0, 2, 3, 1)))
        return images.reshape(*batch, self.embedding_size)


class VectorEncoder(nn.Module):
    """Encoder of vectors: hidden layers on their symlog.

    Args:
        inputs: V.
        layers: Number of hidden layers.
        units: Their width, E.
        norm: ``"rms"`` or ``"layer"``.

    Reference: danijar/dreamerv3, ``rssm.Encoder``: symlog inputs, 3 layers.
    """

    def __init__(self, inputs: int, layers: int = 3, units: int = 256, norm: str = "rms") -> None:
        super().__init__()
        self.embedding_size = units
        widths = [inputs] + [units] * layers
        self.hidden = nn.Sequential(*(NormedLinear(before, after, norm) for before, after in pairwise(widths)))

    def forward(self, vector: Tensor) -> Tensor:
        """Map float32 ``(..., V)`` to ``(..., E)``."""
        return self.hidden(symlog(vector))


class ObservationEncoder(nn.Module):
    """Encoder of all observations: the embeddings of the image and vector encoders side by side.

    Args:
        size: Sizes of the networks.
        interface: Observations of the agent.

    Attributes:
        keys: Keys that ``forward`` reads, images first.
        embedding_size: E.
    """

    def __init__(self, size: ModelSize, interface: Interface) -> None:
        super().__init__()
        self.keys = interface.observation_keys
        encoders: dict[str, ImageEncoder | VectorEncoder] = {}
        if interface.pixels:
            encoders[PIXELS] = ImageEncoder(
                size.cnn_depth,
                size.cnn_multipliers,
                size.cnn_kernel,
                size.strided,
                size.norm,
                size.cnn_patch,
                interface.image_size,
            )
        if interface.vector_dim:
            encoders[interface.vector_key] = VectorEncoder(
                interface.vector_dim, size.vector_layers, size.units, size.norm
            )
        self.embedding_size = sum(encoder.embedding_size for encoder in encoders.values())
        self.encoders = nn.ModuleDict(encoders)

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Embed observations.

        Args:
            observation: The tensors under ``keys``, ``(..., *)``.

        Returns:
            float32 ``(..., E)``.
        """
        embeddings = [encoder(observation[key]) for key, encoder in self.encoders.items()]
        return embeddings[0] if len(embeddings) == 1 else torch.cat(embeddings, -1)


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
    """Block-diagonal layer for the belief, one channel group per block, plus two layers for the state (2025)."""

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
    """Image decoder, mirror of ``ImageEncoder``: a projection to the smallest map, then doublings up to the image.

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
        """Compare predicted images with true ones, without unfolding the pixel blocks.

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
    """Decoder of vectors: hidden layers that predict their symlog.

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
        """Map features ``(..., F)`` to the predicted vector ``(..., V)``."""
        return symexp(self.mlp(features).float())

    def squared_error(self, features: Tensor, vector: Tensor) -> Tensor:
        """Compare with a true vector ``(..., V)``: squared error of symlogs, summed over V, mean over the rest."""
        return (self.mlp(features).float() - symlog(vector)).square().sum(-1).mean()
