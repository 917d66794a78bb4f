"""Visual randomisation, drawn for each drone and episode: light, colours, camera tilt, field of view, and image noise.

Randomised looks help a policy to transfer to another hall or camera. Widths are this project's choice.

Shapes: N worlds, K materials of the scene, M frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import mujoco
import torch
from torch import Tensor

from dreamer_racing.envs.simulator.scene import Camera, gate_materials
from dreamer_racing.settings import NOT_NEGATIVE, check_settings, quoted, setting


@dataclass(frozen=True)
class LooksRandomisation:
    """Half-widths of the uniform, per-episode randomisation of looks; zero disables one."""

    brightness: float = setting(0.3, NOT_NEGATIVE)  # of the light, relative
    color: float = setting(0.15, NOT_NEGATIVE)  # of red, green and blue of all surfaces but gates and decoys, relative
    gate_color: float = setting(0.15, NOT_NEGATIVE)  # of red, green and blue of gates and decoys, additive
    camera_tilt: float = setting(3.0, NOT_NEGATIVE)  # degrees
    field_of_view: float = setting(3.0, NOT_NEGATIVE)  # degrees
    # standard deviation of the pixel noise of each image, relative to full scale
    noise: float = setting(0.02, NOT_NEGATIVE)

    def __post_init__(self) -> None:
        check_settings(self, "LooksRandomisation: ")
        if self.brightness >= 1.0 or self.color >= 1.0:
            raise ValueError("LooksRandomisation: brightness and color are relative half-widths and must be below 1.")


@dataclass(frozen=True)
class Looks:
    """Looks of M frames."""

    colors: Tensor  # (M, K, 3) red, green, blue of each material, times the light
    camera_tilt: Tensor  # (M,) degrees upwards
    field_of_view: Tensor  # (M,) vertical, degrees

    def __getitem__(self, rows: Tensor | slice) -> Looks:
        """Return the looks of some frames."""
        return Looks(self.colors[rows], self.camera_tilt[rows], self.field_of_view[rows])


class LooksSampler:
    """Samples and holds the looks of N worlds, in tensors that are updated in place.

    Args:
        randomisation: the widths of the randomisation.
        generator: source of randomness, on the device.

    Attributes:
        looks: the looks of the current episodes, (N, ...); nominal until `reset`.

    Raises:
        ValueError: the field of view could leave the range from 0 to 180 degrees.
    """

    def __init__(
        self,
        randomisation: LooksRandomisation,
        scene: mujoco.MjModel,
        camera: Camera,
        num_envs: int,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
        generator: torch.Generator | None = None,
    ) -> None:
        widest = min(camera.field_of_view, 180.0 - camera.field_of_view)
        if not randomisation.field_of_view < widest:
            raise ValueError(
                f"LooksRandomisation: field_of_view={randomisation.field_of_view}: must be below {widest:g}, so that "
                f"{camera.field_of_view:g} degrees of the camera ± this value stay between 0 and 180."
            )
        self._randomisation = randomisation
        self._generator = generator
        self._nominal = torch.from_numpy(scene.mat_rgba[:, :3].copy()).to(device, dtype)  # (K, 3)
        is_gate = torch.zeros(scene.nmat, 1, dtype=torch.bool)
        is_gate[gate_materials(scene)] = True
        self._relative = torch.where(is_gate, 0.0, randomisation.color).to(device, dtype)  # (K, 1)
        self._added = torch.where(is_gate, randomisation.gate_color, 0.0).to(device, dtype)  # (K, 1)
        self._tilt, self._field_of_view = camera.tilt, camera.field_of_view
        self.looks = Looks(
            self._nominal.repeat(num_envs, 1, 1),
            torch.full((num_envs,), camera.tilt, device=device, dtype=dtype),
            torch.full((num_envs,), camera.field_of_view, device=device, dtype=dtype),
        )

    def reset(self, mask: Tensor) -> None:
        """Draw new looks for the masked worlds (N,) bool."""
        widths, looks = self._randomisation, self.looks
        noise = self._uniform(*looks.colors.shape)
        surfaces = (self._nominal * (1.0 + self._relative * noise) + self._added * noise).clamp(0.0, 1.0)
        light = 1.0 + widths.brightness * self._uniform(len(mask), 1, 1)
        tilt = self._tilt + widths.camera_tilt * self._uniform(len(mask))
        field_of_view = self._field_of_view + widths.field_of_view * self._uniform(len(mask))
        looks.colors.copy_(torch.where(mask.view(-1, 1, 1), light * surfaces, looks.colors))
        looks.camera_tilt.copy_(torch.where(mask, tilt, looks.camera_tilt))
        looks.field_of_view.copy_(torch.where(mask, field_of_view, looks.field_of_view))

    def add_noise(self, images: Tensor) -> Tensor:
        """Return images uint8 (M, height, width, 3) with new noise."""
        if self._randomisation.noise == 0.0:
            return images
        noise = torch.empty(images.shape, device=images.device).normal_(generator=self._generator)
        noise.mul_(255.0 * self._randomisation.noise).add_(images)
        return noise.round_().clamp_(0.0, 255.0).to(torch.uint8)

    def _uniform(self, *shape: int) -> Tensor:
        """Draw from [−1, 1)."""
        like = self._nominal
        return 2.0 * torch.rand(shape, generator=self._generator, device=like.device, dtype=like.dtype) - 1.0

    def state_dict(self) -> dict[str, Tensor]:
        """Return the looks of the current episodes."""
        return {field.name: getattr(self.looks, field.name).clone() for field in fields(Looks)}

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for field in fields(Looks):
            getattr(self.looks, field.name).copy_(state_dict[field.name])


def load_looks(looks: str | LooksRandomisation | None, from_pixels: bool = True) -> LooksRandomisation | None:
    """Return the randomisation of a name: None for `nominal`, the default one for `randomised`.

    Raises:
        ValueError: unknown name, or a randomisation in an environment without images.
    """
    if looks is None or looks == "nominal":
        return None
    if looks != "randomised" and not isinstance(looks, LooksRandomisation):
        raise ValueError(f"looks={looks!r}: use nominal, randomised, or a LooksRandomisation.")
    if not from_pixels:
        raise ValueError(f"looks={quoted(looks)}: needs images, but from_pixels=False: leave it out.")
    return looks if isinstance(looks, LooksRandomisation) else LooksRandomisation()
