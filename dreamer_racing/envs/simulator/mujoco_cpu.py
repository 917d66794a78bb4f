"""N worlds on CPU: MuJoCo's C engine with native batching for the rigid bodies, and a renderer for their cameras."""

import ctypes
import os
import weakref

import mujoco
import torch
from mujoco.batch import Batch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.base import Simulator, no_images
from dreamer_racing.envs.simulator.looks import LooksRandomisation, LooksSampler
from dreamer_racing.envs.simulator.rendering import Renderer, make_renderer
from dreamer_racing.envs.simulator.scene import Camera, build_drone, build_scene
from dreamer_racing.envs.tracks import Track
from dreamer_racing.machine import usable_threads

_batches: weakref.WeakSet[Batch] = weakref.WeakSet()


def _keep_batches() -> None:
    """In a forked process, keep the parent's batches from being freed, which would wait for threads that do not exist.

    A list of references would itself be freed at exit, so the reference counts are incremented.
    """
    for batch in _batches:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep_batches)


class MujocoSimulator(Simulator):
    """Simulator with MuJoCo's C engine, in float64.

    Args:
        track: the track.
        parameters: the drone.
        num_envs: N worlds.
        camera: the nose camera.
        renderer: a name that `make_renderer` takes, or None for no images.
        num_threads: physics and rendering threads; `usable_threads` if None.
        generator: source of the randomisation of physics and looks.
        looks: randomisation of looks; None for the same in every episode.

    Example:
        >>> from dreamer_racing.envs.tracks import load_track
        >>> simulator = MujocoSimulator(load_track("kidney"), QuadrotorParameters(), num_envs=4, renderer=None)
        >>> simulator.step(torch.zeros(4, 4)).shape
        torch.Size([11, 4, 3])
    """

    def __init__(
        self,
        track: Track,
        parameters: QuadrotorParameters,
        num_envs: int,
        camera: Camera | None = None,
        renderer: str | None = "auto",
        num_threads: int | None = None,
        generator: torch.Generator | None = None,
        looks: LooksRandomisation | None = None,
    ) -> None:
        if num_threads is not None and num_threads < 1:
            raise ValueError(f"num_threads={num_threads}: must be at least 1.")
        num_threads = min(num_threads or usable_threads(), num_envs)
        model = build_drone(parameters).compile()
        # the race must detect a non-finite state and end the episode; an automatic reset would hide it
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        batch = Batch(model, num_envs, num_threads)
        _batches.add(batch)
        qpos, qvel, force = (torch.from_numpy(batch.bind(name)) for name in ("qpos", "qvel", "qfrc_applied"))
        super().__init__(parameters, qpos, qvel, force, batch.step, generator)
        self.renderer: Renderer | None = None
        self._closed = False
        if renderer is not None:
            camera = camera or Camera()
            scene = build_scene(track, parameters, camera).compile()
            self.renderer = make_renderer(renderer, scene, camera, num_envs, num_threads, looks is not None)
            if looks is not None:
                self.looks = LooksSampler(looks, scene, camera, num_envs, self.device, self.dtype, generator)

    def render(self, rows: Tensor | None = None) -> Tensor:
        """Return images uint8 (M, height, width, 3) of all worlds, or of M rows: a mask (N,) bool, or indices (M,)."""
        if self.renderer is None:
            raise no_images(self._closed)
        return self.renderer.render(*self._frames(rows))

    def close(self) -> None:
        """Free the renderer's contexts and threads."""
        if self.renderer is not None:
            self.renderer.close()
            self.renderer = None
            self._closed = True
