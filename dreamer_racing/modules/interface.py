"""Interface between agent and environment: keys and widths of observations and actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tensordict.utils import NestedKey

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

PIXELS = "pixels"
"""Key of the images that the agent sees, uint8 ``(..., height, width, 3)``."""
VECTOR = "vector"
"""Key of the vector that the agent sees, float32 ``(..., V)``."""
IMU = "imu"
"""Key of the IMU readings that the agent may see besides images: float32 ``(..., 6)``, rad/s and m/s²."""
PRIVILEGED = ("privileged", "vector")
"""Key of the simulator's state, which only losses see, float32 ``(..., P)``."""


@dataclass(frozen=True)
class Interface:
    """Observations and actions of an agent.

    Attributes:
        action_dim: A.
        pixels: Whether the agent sees images under ``"pixels"``.
        image_size: Height and width of those images, pixels.
        vector_dim: V, width of the vector that the agent sees under ``vector_key``; 0 if none.
        privileged_dim: P, width of ``("privileged", "vector")``, which losses may use; 0 if none.
        vector_key: Key of the vector that the agent sees, ``"vector"`` or ``"imu"``.

    Raises:
        ValueError: If the agent would see nothing.
    """

    action_dim: int = 4
    pixels: bool = True
    image_size: int = 64
    vector_dim: int = 0
    privileged_dim: int = 0
    vector_key: str = VECTOR

    def __post_init__(self) -> None:
        if not self.pixels and not self.vector_dim:
            raise ValueError("The agent sees nothing: the environment has neither 'pixels' nor 'vector'.")

    @classmethod
    def of(cls, env: EnvBase) -> Interface:
        """Make the interface from an environment's specs.

        Raises:
            ValueError: If the environment has neither ``"pixels"`` nor ``"vector"``, or images that are not square.
        """
        specs = env.observation_spec
        keys = set(specs.keys(include_nested=True))
        height, width = specs[PIXELS].shape[-3:-1] if PIXELS in keys else [cls.image_size] * 2
        if height != width:
            raise ValueError(f"The environment's images are {height} × {width} pixels: agents need square images.")
        numbers = IMU if IMU in keys else VECTOR
        vector, privileged = (specs[key].shape[-1] if key in keys else 0 for key in (numbers, PRIVILEGED))
        return cls(env.action_spec.shape[-1], PIXELS in keys, height, vector, privileged, numbers)

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """Height, width and channels of an image."""
        return (self.image_size, self.image_size, 3)

    @property
    def observation_keys(self) -> list[str]:
        """Keys that the encoder reads."""
        return [PIXELS] * self.pixels + [self.vector_key] * bool(self.vector_dim)

    @property
    def replay_keys(self) -> list[NestedKey]:
        """Keys of an observation that a replay buffer must store."""
        return [*self.observation_keys, *([PRIVILEGED] if self.privileged_dim else [])]
