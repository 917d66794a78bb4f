"""Networks of the model-free baselines: a CNN for images, the symlog of IMU readings, raw vectors, then one MLP.

Shape legend: N any batch, A action, O outputs.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.transforms import Compose, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from dreamer_racing.modules import Interface
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.interface import IMU, PIXELS


@dataclass
class NetworkSize:
    """Hidden layers of actor and critic.

    Attributes:
        layers: Number of hidden layers. Reference: paper, Section IV: four-layer MLPs.
        units: Width of the hidden layers. Reference: paper, Section IV: 768.
    """

    layers: int = 4
    units: int = 768


class ImageTrunk(nn.Module):
    """Three convolutions and a linear layer for images of at least 36 × 36 pixels.

    The paper only says "a CNN"; this is the CNN of Stable-Baselines3, on which its code builds.

    Example:
        >>> ImageTrunk()(torch.zeros(2, 64, 64, 3, dtype=torch.uint8)).shape
        torch.Size([2, 512])

    Reference: Mnih et al. 2015, "Human-level control through deep reinforcement learning", Methods.
    """

    features = 512
    smallest_image = 36

    def __init__(self, image_size: int = 64) -> None:
        super().__init__()
        if image_size < self.smallest_image:
            raise ValueError(
                f"image_size={image_size}: the CNN of the baselines needs images of at least {self.smallest_image} × "
                f"{self.smallest_image} pixels."
            )
        self.convolutions = nn.Sequential(
            nn.Conv2d(3, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Conv2d(64, 64, 3, 1), nn.ReLU()
        )
        with torch.no_grad():
            flat = self.convolutions(torch.zeros(1, 3, image_size, image_size)).numel()
        self.linear = nn.Linear(flat, self.features)

    def forward(self, pixels: Tensor) -> Tensor:
        """Map images uint8 ``(..., H, W, 3)`` to ``(..., 512)``."""
        batch = pixels.shape[:-3]
        maps = self.convolutions(pixels.flatten(0, -4).permute(0, 3, 1, 2).float().div_(255.0))
        return self.linear(maps.flatten(1)).relu().view(*batch, self.features)


class ObservationNetwork(nn.Module):
    """Network from the observations under ``in_keys``, and optionally an action, to O outputs.

    The initial weights of the last layer are multiplied by ``output_scale``.

    Example:
        >>> network = ObservationNetwork(Interface(pixels=False, vector_dim=21), 1, NetworkSize(2, 32))
        >>> network(torch.zeros(5, 21)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self, interface: Interface, outputs: int, size: NetworkSize, with_action: bool = False, output_scale: float = 1
    ) -> None:
        super().__init__()
        self.in_keys = [*interface.observation_keys, *(["action"] if with_action else [])]
        self.trunk = ImageTrunk(interface.image_size) if interface.pixels else None
        inputs = (ImageTrunk.features if interface.pixels else 0) + interface.vector_dim
        inputs += interface.action_dim if with_action else 0
        layers: list[nn.Module] = []
        for _ in range(size.layers):
            layers += [nn.Linear(inputs, size.units), nn.ELU()]
            inputs = size.units
        last = nn.Linear(inputs, outputs)
        last.weight.data *= output_scale
        last.bias.data.zero_()
        self.mlp = nn.Sequential(*layers, last)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map the tensors under ``in_keys`` to ``(..., O)``."""
        preprocess = {PIXELS: self.trunk, IMU: symlog}
        parts = []
        for key, value in zip(self.in_keys, inputs, strict=True):
            function = preprocess.get(key)
            parts.append(value if function is None else function(value))
        return self.mlp(parts[0] if len(parts) == 1 else torch.cat(parts, -1))


class GaussianNetwork(nn.Module):
    """An ``ObservationNetwork`` whose outputs ``parameters`` turns into ``loc`` and ``scale`` of a distribution."""

    def __init__(self, network: ObservationNetwork, parameters: nn.Module) -> None:
        super().__init__()
        self.in_keys = network.in_keys
        self.network = network
        self.parameters_of = parameters

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Map the tensors under ``in_keys`` to ``loc`` and ``scale``, ``(..., A)``."""
        return self.parameters_of(self.network(*inputs))


class NetworkModule(TensorDictModuleBase):
    """Module that applies a network to keys of a TensorDict, a faster ``TensorDictModule``.

    ``TensorDictModule`` looks for pandas on the disk at every write (tensordict 0.14.3), which takes a tenth of the
    time of SAC from vectors.
    """

    def __init__(self, network: ObservationNetwork | GaussianNetwork, out_keys: list[str]) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(network.in_keys), list(out_keys)
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the outputs."""
        outputs = self.network(*(tensordict.get(key) for key in self.in_keys))
        for key, value in zip(self.out_keys, outputs if isinstance(outputs, tuple) else (outputs,), strict=True):
            tensordict.set(key, value)
        return tensordict


def make_actor(network: ObservationNetwork, parameters: nn.Module, distribution: type) -> ProbabilisticActor:
    """Make an actor that samples from a distribution with the ``loc`` and ``scale`` that ``parameters`` returns."""
    return ProbabilisticActor(
        NetworkModule(GaussianNetwork(network, parameters), ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        return_log_prob=True,
    )


class BaselinePolicy(TensorDictModuleBase):
    """Policy of an actor without memory, which is shared, not copied.

    Args:
        actor: The actor.
        deterministic: Act by the distribution's ``deterministic_sample``; may be set at any time.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential, deterministic: bool = False) -> None:
        super().__init__()
        self.in_keys = list(actor.in_keys)
        self.out_keys = list(actor.out_keys)
        self.actor = actor
        self.deterministic = deterministic

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(..., A)`` and the actor's other outputs."""
        kind = ExplorationType.DETERMINISTIC if self.deterministic else ExplorationType.RANDOM
        with set_exploration_type(kind):
            return self.actor(tensordict)

    def make_primer(self) -> Transform:
        """Return an empty transform, because this policy has no recurrent state."""
        return Compose()


def layers_of(size: NetworkSize, interface: Interface) -> dict[str, Any]:
    """Return the description of networks that a checkpoint keeps: their hidden layers and their inputs."""
    image_size = interface.image_size if interface.pixels else None
    return {**asdict(size), "image_size": image_size, "imu": interface.vector_key == IMU}


def check_layers(saved: dict[str, Any], present: dict[str, Any]) -> None:
    """Check that ``layers_of`` saved networks are those of this learner's.

    Raises:
        ValueError: If they differ.
    """
    if (saved["image_size"] is None) is not (present["image_size"] is None):
        there, here = (str(layers["image_size"] is not None).lower() for layers in (saved, present))
        raise ValueError(
            f"The checkpoint's networks were made with env.from_pixels={there}, this learner's with {here}: set "
            f"env.from_pixels={there}, or start a new run."
        )
    if (there := saved.get("imu", False)) is not present["imu"]:  # earlier ones had no IMU
        raise ValueError(
            f"The checkpoint's networks were made {'with' if there else 'without'} env.imu, and this learner's are "
            f"made {'without' if there else 'with'} it: set it as it was, or start a new run."
        )
    for key, setting in (("layers", "network.layers"), ("units", "network.units"), ("image_size", "env.image_size")):
        if saved[key] != present[key]:
            raise ValueError(
                f"The checkpoint's networks were made with {setting}={saved[key]}, this learner's with {present[key]}: "
                f"set {setting}={saved[key]}, or start a new run."
            )
