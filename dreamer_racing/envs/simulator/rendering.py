"""Nose cameras of M drones: poses, what is in view, and images: on CPU by K threads, each with a worker and a slice.

Only the camera moves: hall and gates are static, and the drone is hidden from its own camera. So a worker prepares the
scene once, and for each frame only moves the camera and renders.

Workers, in the order in which `renderer="auto"` tries them: `egl`, MuJoCo's OpenGL renderer with an EGL library (Mesa's
software renderer suffices); `osmesa`, the same with OSMesa, slower; `warp`, `mujoco_warp`'s ray caster, compiled for
the CPU, which needs nothing. `warp_cuda`, which `auto` does not try, casts the rays on a CUDA device in one launch
and copies the images back.

Shapes: M frames, of one drone each, L points. Images are uint8 RGB (M, height, width, 3), first row at the top.
"""

import atexit
import copy
import logging
import math
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache, partial
from itertools import zip_longest
from queue import SimpleQueue
from threading import Thread
from threading import enumerate as enumerate_threads
from typing import Any, Protocol, TypeVar

import mujoco
import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.simulator.looks import Looks
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, RendererUnavailableError, open_scene, require_library
from dreamer_racing.envs.simulator.scene import HALL_GROUP, Camera
from dreamer_racing.envs.simulator.warp_device import load_warp, scope

logger = logging.getLogger(__name__)
T = TypeVar("T")

RENDERERS = ("egl", "osmesa", "warp")
WARP_CUDA = "warp_cuda"
EXIT_PATIENCE = 10.0
"""Maximum time for which the exit of the process waits for a frame that is being rendered, s [choice]."""


class Worker(Protocol):
    """Renders frames in one thread."""

    def draw(self, position: Tensor, axes: Tensor, out: Tensor, looks: Looks | None = None) -> None:
        """Render from camera positions (m, 3) and axes (m, 3, 3; rows right, up, backwards) into out (m, H, W, 3).

        Material colours and field of view are taken from ``looks``, if given. Its camera tilt is already in ``axes``,
        and noise is added later.
        """
        ...

    def close(self) -> None:
        """Free the worker's resources; called in its own thread."""
        ...


class RenderThread(Thread):
    """A thread that runs submitted functions in order until it is ended.

    Unlike an executor's shutdown, `end` takes no lock that may be held already, so the garbage collector may call it.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._tasks: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.start()

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Queue a function call and return the future of its result.

        Raises:
            RuntimeError: the thread has ended, as all do when the interpreter exits.
        """
        if not self.is_alive():
            raise RuntimeError("Rendering has ended, because the interpreter exits.")
        future: Future[T] = Future()

        def work() -> None:
            try:
                future.set_result(function(*arguments))
            except BaseException as error:
                future.set_exception(error)

        self._tasks.put(work)
        return future

    def end(self, last: Callable[[], None] | None) -> None:
        """End the thread after all queued calls and an optional last one; return without waiting."""
        if last is not None:
            self._tasks.put(partial(_free, last))
        self._tasks.put(None)

    def run(self) -> None:
        """Run the queued calls until the thread is ended."""
        while (task := self._tasks.get()) is not None:
            task()
            del task  # or it would keep its arguments alive while waiting for the next task


def _free(close: Callable[[], None]) -> None:
    try:
        close()
    except BaseException as error:
        logger.warning("A renderer could not be freed.", exc_info=error)


@atexit.register
def _end_all() -> None:
    """End the threads before the interpreter shuts down.

    During shutdown, a thread that requests the GIL is killed at once; inside C++ code, as when a tensor is freed, that
    aborts the process.
    """
    threads = [thread for thread in enumerate_threads() if isinstance(thread, RenderThread)]
    for thread in threads:
        thread.end(None)
    for thread in threads:
        thread.join(EXIT_PATIENCE)


class Renderer:
    """Distributes frames over workers, each with its own thread.

    A renderer that is garbage-collected without `close` frees its workers too, without waiting.

    Args:
        name: a name from `RENDERERS`, or `WARP_CUDA`.
        make_worker: makes one worker; called once in each thread.
        num_workers: K.
    """

    def __init__(self, name: str, make_worker: Callable[[], Worker], camera: Camera, num_workers: int) -> None:
        self.name = name
        self.camera = camera
        self._threads = [RenderThread(f"render_{index}") for index in range(num_workers)]
        self._workers: list[Worker] = []
        self._end = weakref.finalize(self, _end, self._threads, self._workers)
        self._end.atexit = False  # contexts are freed at exit anyway
        try:
            # sequentially, because the first GL context of a process initialises the display
            for thread in self._threads:
                self._workers.append(thread.submit(make_worker).result())
        except BaseException:
            self.close()
            raise
        self._mount = NoseMount(camera)

    def render(self, position: Tensor, attitude: Tensor, looks: Looks | None = None) -> Tensor:
        """Return images (M, height, width, 3) of drones at positions (M, 3) with attitudes (M, 4), wxyz."""
        assert self._end.alive, "the renderer is closed"
        camera = self.camera
        frames = len(position)
        eye, axes = self._mount(position, attitude, None if looks is None else looks.camera_tilt)
        images = torch.empty((frames, camera.height, camera.width, 3), dtype=torch.uint8)
        size = max(1, -(-frames // len(self._threads)))
        slices = [slice(start, start + size) for start in range(0, frames, size)]
        jobs = [
            thread.submit(worker.draw, eye[part], axes[part], images[part], None if looks is None else looks[part])
            for thread, worker, part in zip(self._threads, self._workers, slices, strict=False)
        ]
        for job in jobs:
            job.result()
        return images

    def close(self) -> None:
        """Free every worker in its own thread, and join the threads."""
        if self._end.detach() is not None:  # only once; a finalizer does nothing if called during interpreter exit
            _end(self._threads, self._workers)
        for thread in self._threads:
            thread.join()


def _end(threads: list[RenderThread], workers: list[Worker]) -> None:
    """Free the workers, which may be fewer than the threads, and end the threads."""
    for thread, worker in zip_longest(threads, workers):
        thread.end(None if worker is None else worker.close)
    workers.clear()


class OpenGLWorker:
    """Worker with MuJoCo's OpenGL renderer; see `open_scene` for the arguments."""

    def __init__(self, backend: str, model: mujoco.MjModel, camera: Camera) -> None:
        self._scene = open_scene(backend, model, camera)

    def draw(self, position: Tensor, axes: Tensor, out: Tensor, looks: Looks | None = None) -> None:
        """Render from camera positions (m, 3) and axes (m, 3, 3; rows right, up, backwards) into out (m, H, W, 3)."""
        positions, ups, forwards = position.numpy(), axes[:, 1].numpy(), (-axes[:, 2]).numpy()
        images = out.numpy()
        for index in range(len(images)):
            if looks is not None:
                self._scene.set_looks(looks.colors[index].numpy(), looks.field_of_view[index].item())
            self._scene.draw(positions[index], ups[index], forwards[index], images[index])

    def close(self) -> None:
        """Free the OpenGL context."""
        self._scene.close()


class RayCaster:
    """Worker with `mujoco_warp`'s batch renderer: thousands of cameras in one launch on a CUDA device; without OpenGL.

    The hall is static, so the bounding volumes are built only once.

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


def make_renderer(
    name: str, model: mujoco.MjModel, camera: Camera, num_envs: int, num_workers: int, varied_looks: bool = False
) -> Renderer:
    """Make a renderer of at most `num_envs` frames per call by name, or for `auto` the first that works; log which.

    Raises:
        ValueError: unknown name.
        RendererUnavailableError: the chosen renderer does not work here.
    """
    if name not in ("auto", *RENDERERS, WARP_CUDA):
        known = ", ".join(("auto", *RENDERERS, WARP_CUDA))
        raise ValueError(f"Unknown renderer {name!r}: use {known}, or None for no images.")
    if name == WARP_CUDA:
        num_workers = 1
    reasons = []
    for candidate in RENDERERS if name == "auto" else (name,):
        try:
            make_worker = _worker_factory(candidate, model, camera, -(-num_envs // num_workers), varied_looks)
            renderer = Renderer(candidate, make_worker, camera, num_workers)
        except RendererUnavailableError as error:
            reasons.append(str(error))
            continue
        why = f"; {' '.join(reasons)}" if reasons else ""
        level = logging.WARNING if reasons else logging.INFO  # a fallback is slower
        log_once(level, f"renderer: {candidate}, {num_workers} thread(s){why}")
        return renderer
    raise RendererUnavailableError(" ".join(reasons))


@cache
def log_once(level: int, words: str) -> None:
    """Log a message once per process, not again for each further simulator."""
    logger.log(level, words)


def _worker_factory(
    name: str, model: mujoco.MjModel, camera: Camera, frames: int, varied_looks: bool
) -> Callable[[], Worker]:
    """Return the factory of a renderer's workers, after checking that they can work here."""
    if name in GL_LIBRARIES:
        require_library(name)
        return lambda: OpenGLWorker(name, model, camera)
    if name == "warp":
        return lambda: RayCaster(model, camera, frames, "cpu", varied_looks)
    if name == WARP_CUDA:
        if not torch.cuda.is_available():
            raise RendererUnavailableError(f"{name} needs a CUDA device, and torch {torch.__version__} finds none.")
        return lambda: RayCaster(model, camera, frames, "cuda", varied_looks)
    raise NotImplementedError(f"{name!r} is among the renderers, but no worker here draws it: add a branch for it.")


class NoseMount:
    """Computes the camera poses of drones."""

    def __init__(self, camera: Camera, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64) -> None:
        self._mount = torch.tensor(camera.position, device=device, dtype=dtype)
        self._tilt = torch.tensor([camera.tilt], device=device, dtype=dtype)

    def __call__(self, position: Tensor, attitude: Tensor, tilt: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the camera positions (M, 3), m, and axes (M, 3, 3) with rows right, up, backwards, in the world.

        Args:
            position: positions of the drones, (M, 3), m.
            attitude: attitudes of the drones, (M, 4) wxyz.
            tilt: tilts of the cameras, (M,), degrees upwards; the camera's own if None.
        """
        angle = torch.deg2rad(self._tilt if tilt is None else tilt)
        cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        right = torch.stack((zero, zero - 1.0, zero), -1)
        up, backwards = torch.stack((-sine, zero, cosine), -1), torch.stack((-cosine, zero, -sine), -1)
        axes = torch.stack((right, up, backwards), 1).expand(len(position), -1, -1)  # (M, 3, 3) in the body frame
        eye = position + rotate(attitude, self._mount.expand_as(position))
        return eye, rotate(attitude.unsqueeze(1).expand(-1, 3, -1), axes)


def points_in_camera(position: Tensor, attitude: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """Return points (M, L, 3) in the axes of drones' cameras, m: along the optical axis, to the left, and up.

    Args:
        position: positions of the drones, (M, 3), m.
        attitude: attitudes of the drones, (M, 4) wxyz, body → world.
        points: points in the world, (L, 3), or separate ones for each drone (M, L, 3), m.
        camera: the nose camera.
    """
    eye, axes = NoseMount(camera, position.device, position.dtype)(position, attitude)
    right, up, backwards = ((points - eye.unsqueeze(1)) @ axes.mT).unbind(-1)
    return torch.stack((-backwards, -right, up), dim=-1)


def is_in_view(points: Tensor, camera: Camera) -> Tensor:
    """Return whether points (..., 3) in the camera's axes project into the image, (...) bool."""
    up = math.tan(math.radians(camera.field_of_view) / 2)
    left = up * camera.width / camera.height
    depth = points[..., 0]
    return (depth > 0) & (points[..., 1].abs() <= left * depth) & (points[..., 2].abs() <= up * depth)
