"""Encoders from observations to one flat embedding, and decoders from belief and state to predicted observations.

Shape legend: N any batch, C channels, V vector, E embedding, F features, G blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    initialize,
    linear,
)
from dreamer_racing.modules.sizes import ModelSize


def smallest_map(image_size: int, patch: int, stages: int) -> int:
    """Return the side of the last feature map of an image whose pixel blocks are folded and which is then halved.

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


def initialize_convolution(layer: nn.Conv2d | nn.ConvTranspose2d, fan_in: int) -> None:
    """Fill a convolution with the reference's initial weights and a zero bias, in channels-last layout."""
    initialize(layer.weight, fan_in)
    layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)


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
        size: Sizes of the networks.
        image_size: Height and width of the images, pixels.

    Raises:
        ValueError: If images of that size cannot be halved so often.

    Example:
        >>> import torch
        >>> from dreamer_racing.modules import get_size
        >>> encoder = ImageEncoder(get_size("debug"))
        >>> encoder(torch.zeros(2, 64, 64, 3, dtype=torch.uint8)).shape
        torch.Size([2, 128])

    Reference: danijar/dreamerv3, ``rssm.Encoder``.
    """

    def __init__(self, size: ModelSize, image_size: int = 64) -> None:
        super().__init__()
        self.patch = size.cnn_patch
        channels = [size.cnn_depth * multiplier for multiplier in size.cnn_multipliers]
        stride = 2 if size.strided else 1
        self.convolutions = nn.ModuleList(
            make_convolution(before, after, size.cnn_kernel, stride)
            for before, after in pairwise([3 * self.patch**2, *channels])
        )
        self.norms = nn.ModuleList(NORMS[size.norm](count) for count in channels)
        self.pool = nn.Identity() if size.strided else nn.MaxPool2d(2)
        self.embedding_size = smallest_map(image_size, self.patch, len(channels)) ** 2 * channels[-1]

    def forward(self, pixels: Tensor) -> Tensor:
        """Map images uint8 ``(..., height, width, 3)`` to embeddings float32 ``(..., E)``."""
        batch = pixels.shape[:-3]
        # Channels-last throughout: (N, H, W, C) in memory, (N, C, H, W) to the convolutions.
        images = _centred(fold_patches(pixels.flatten(0, -4), self.patch))
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            maps = self.pool(convolution(images.permute(0, 3, 1, 2)))
            images = F.silu(norm(maps.permute(0, 2, 3, 1)))
        return images.reshape(*batch, self.embedding_size)


class VectorEncoder(nn.Module):
    """Encoder of vectors: hidden layers, of width E, on their symlog.

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

    Attributes:
        keys: Keys that ``forward`` reads, images first.
        embedding_size: E.
    """

    def __init__(self, size: ModelSize, interface: Interface) -> None:
        super().__init__()
        self.keys = interface.observation_keys
        encoders: dict[str, ImageEncoder | VectorEncoder] = {}
        if interface.pixels:
            encoders[PIXELS] = ImageEncoder(size, interface.image_size)
        if interface.vector_dim:
            encoders[interface.vector_key] = VectorEncoder(
                interface.vector_dim, size.vector_layers, size.units, size.norm
            )
        self.embedding_size = sum(encoder.embedding_size for encoder in encoders.values())
        self.encoders = nn.ModuleDict(encoders)

    def forward(self, observation: Mapping[str, Tensor]) -> Tensor:
        """Map the tensors under ``keys``, ``(..., *)``, to one embedding float32 ``(..., E)``."""
        embeddings = [encoder(observation[key]) for key, encoder in self.encoders.items()]
        return embeddings[0] if len(embeddings) == 1 else torch.cat(embeddings, -1)


class DenseProjection(nn.Module):
    """One linear layer from belief and state to the smallest feature map (2023)."""

    def __init__(self, size: ModelSize, resolution: int, channels: int) -> None:
        super().__init__()
        self.shape = (resolution, resolution, channels)
        self.linear = linear(size.features, resolution**2 * channels)

    def forward(self, belief: Tensor, state: Tensor) -> Tensor:
        """Map ``(N, belief)`` and ``(N, state)`` to ``(N, height, width, C)``."""
        return self.linear(torch.cat((belief, state), -1)).unflatten(-1, self.shape)


class BlockProjection(nn.Module):
    """Block-diagonal layer for the belief, one channel group per block, plus two layers for the state (2025)."""

    def __init__(self, size: ModelSize, resolution: int, channels: int) -> None:
        super().__init__()
        self.shape = (resolution, resolution, channels)
        self.blocks = size.blocks
        self.from_belief = BlockLinear(size.belief, resolution**2 * channels, size.blocks)
        self.from_state = nn.Sequential(
            NormedLinear(size.state, 2 * size.units, size.norm), linear(2 * size.units, resolution**2 * channels)
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
        size: Sizes of the networks; ``blocks`` of 1 projects belief and state densely.
        image_size: Height and width of the images, pixels.

    Raises:
        ValueError: If images of that size cannot be halved so often.

    Reference: danijar/dreamerv3, ``rssm.Decoder``.
    """

    def __init__(self, size: ModelSize, image_size: int = 64) -> None:
        super().__init__()
        self.patch = size.cnn_patch
        self.image_size = image_size
        channels = [size.cnn_depth * multiplier for multiplier in reversed(size.cnn_multipliers)]
        resolution = smallest_map(image_size, self.patch, len(channels))
        projection = BlockProjection if size.blocks > 1 else DenseProjection
        self.projection = projection(size, resolution, channels[0])
        convolution = StridedConvolution if size.strided else UpsampledConvolution
        self.norms = nn.ModuleList(NORMS[size.norm](count) for count in channels)
        self.convolutions = nn.ModuleList(
            convolution(before, after, size.cnn_kernel) for before, after in pairwise([*channels, 3 * self.patch**2])
        )

    def forward(self, belief: Tensor, state: Tensor) -> Tensor:
        """Map ``(..., belief)`` and ``(..., state)`` to the mean image in [0, 1], ``(..., height, width, 3)``."""
        images = unfold_patches(self._folded(belief, state), self.patch)
        return images.reshape(*belief.shape[:-1], self.image_size, self.image_size, 3)

    def squared_error(self, belief: Tensor, state: Tensor, pixels: Tensor) -> Tensor:
        """Compare predicted images with true ones, uint8 ``(..., height, width, 3)``; pixel blocks stay folded.

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
    """Decoder of vectors: hidden layers on the features that predict the vectors' symlog.

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
