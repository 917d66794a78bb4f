"""`mujoco_warp`'s batch renderer: thousands of cameras in one launch on a CUDA device; on CPU, needs no OpenGL."""

import copy

import mujoco
import torch
from torch import Tensor

from dreamer_racing.envs.simulator.camera_view import NoseMount
from dreamer_racing.envs.simulator.looks import Looks
from dreamer_racing.envs.simulator.scene import HALL_GROUP, Camera
from dreamer_racing.envs.simulator.warp_device import load_warp, scope


class RayCaster:
    """Renders a static hall from many cameras at a time; the bounding volumes are built only once.

    Args:
        frames: maximum number of frames per launch.
        varied_looks: whether looks may differ between frames.
    """

    def __init__(
        self, model: mujoco.MjModel, camera: Camera, frames: int, device: torch.device | str, varied_looks: bool = False
    ) -> None:
        warp = load_warp()
        import mujoco_warp

        self._render, self._device, self._size = mujoco_warp.render, torch.device(device), (camera.height, camera.width)
        self._mount = NoseMount(camera, device, torch.float32)
        with scope(self._device):
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            self._model = mujoco_warp.put_model(_blue_first(model))
            self._data = mujoco_warp.put_data(model, data, nworld=frames, nconmax=0, njmax=0)
            self._context = mujoco_warp.create_render_context(
                model,
                nworld=frames,
                cam_res=(camera.width, camera.height),
                render_rgb=True,
                enabled_geom_groups=[HALL_GROUP],
                enable_specular=False,
                enable_emission=False,
                enable_per_light_ambient=False,
                use_precomputed_rays=not varied_looks,
            )
            if varied_looks:
                self._colors, self._field_of_view = self._vary(frames)
            mujoco_warp.refit_bvh(self._model, self._data, self._context)
            mujoco_warp.render(self._model, self._data, self._context)  # compile now, not in the first step
        # views of warp's arrays
        self._position = warp.to_torch(self._data.cam_xpos)[:, 0]  # (frames, 3)
        self._axes = warp.to_torch(self._data.cam_xmat)[:, 0]  # (frames, 3, 3) columns: right, up, backwards
        packed = warp.to_torch(self._context.rgb_data).view(torch.uint8)  # (frames, H * W * 4)
        self._pixels = packed.unflatten(-1, (*self._size, 4))[..., :3]

    def _vary(self, frames: int) -> tuple[Tensor, Tensor]:
        """Allocate separate materials and cameras for every frame; return views of colours and fields of view."""
        warp, model = load_warp(), self._model
        model.mat_rgba = warp.from_torch(warp.to_torch(model.mat_rgba)[:1].repeat(frames, 1, 1), dtype=warp.vec4)
        model.cam_fovy = warp.from_torch(warp.to_torch(model.cam_fovy)[:1].repeat(frames, 1))
        return warp.to_torch(model.mat_rgba)[..., :3], warp.to_torch(model.cam_fovy)[:, 0]

    def render(self, position: Tensor, attitude: Tensor, looks: Looks | None = None) -> Tensor:
        """Return images (M, height, width, 3) of drones at positions (M, 3) with attitudes (M, 4), wxyz."""
        eye, axes = self._mount(position, attitude, None if looks is None else looks.camera_tilt)
        images = torch.empty((len(position), *self._size, 3), dtype=torch.uint8, device=position.device)
        self.draw(eye, axes, images, looks)
        return images

    def draw(self, position: Tensor, axes: Tensor, out: Tensor, looks: Looks | None = None) -> None:
        """Render from camera positions (m, 3) and axes (m, 3, 3; rows right, up, backwards) into out (m, H, W, 3)."""
        capacity = len(self._position)
        for start in range(0, len(position), capacity):
            part = slice(start, start + capacity)
            frames = len(position[part])
            self._position[:frames] = position[part]
            self._axes[:frames] = axes[part].mT
            if looks is not None:
                self._colors[:frames] = looks.colors[part].flip(-1)  # blue first
                self._field_of_view[:frames] = looks.field_of_view[part]
            self._data.nworld = frames  # the renderer launches over this many worlds
            with scope(self._device):
                self._render(self._model, self._data, self._context)
            out[part] = self._pixels[:frames]

    def close(self) -> None:
        """Do nothing: warp's arrays are freed with the object."""


def _blue_first(model: mujoco.MjModel) -> mujoco.MjModel:
    """Swap red and blue of all colours: the renderer packs pixels as bytes B, G, R, A, so the result is R, G, B."""
    swapped = copy.copy(model)
    surfaces, lights = (swapped.geom_rgba, swapped.mat_rgba), (swapped.light_ambient, swapped.light_diffuse)
    for colors in (*surfaces, *lights, swapped.light_specular):
        colors[:, :3] = colors[:, 2::-1].copy()
    return swapped
