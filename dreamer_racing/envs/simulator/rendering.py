"""Nose-camera images of M drones on CPU: K threads, each with a worker and a slice of the frames.

Only the camera moves: hall and gates stand still and the drone is hidden from its own camera. So a worker prepares the
scene once, and per frame only places the camera and draws.

Workers, in the order in which `renderer="auto"` tries them:

| name | needs | how |
|---|---|---|
| `egl` | an EGL library (Mesa in software will do) | MuJoCo's OpenGL renderer |
| `osmesa` | OSMesa | the same, slower |
| `warp` | nothing | `mujoco_warp`'s ray caster, compiled for the CPU |

`warp_cuda`, which `auto` does not try, casts the rays on a CUDA device in one launch: poses go there, images come back.

Shapes: M frames. Images are uint8 RGB (M, height, width, 3), first row at the top.
"""

import atexit
import logging
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from itertools import zip_longest
from queue import SimpleQueue
from threading import Thread
from threading import enumerate as enumerate_threads
from typing import Any, NamedTuple, Protocol, TypeVar

import mujoco
import torch
from torch import Tensor

from dreamer_racing.envs.drone.rotation import rotate
from dreamer_racing.envs.simulator.looks import Looks
from dreamer_racing.envs.simulator.opengl import (
    GL_LIBRARIES,
    RendererUnavailableError,
    open_scene,
    require_library,
)
from dreamer_racing.envs.simulator.ray_caster import RayCaster
from dreamer_racing.envs.simulator.scene import Camera

logger = logging.getLogger(__name__)
T = TypeVar("T")

RENDERERS = ("egl", "osmesa", "warp")
HYBRID = "warp_cuda"
EXIT_PATIENCE = 10.0
"""How long the end of the process waits for a frame that is being drawn, s [choice]."""


class NoseMount:
    """Where the cameras of drones are.

    Args:
        camera: the nose camera.
        device: where poses will be.
        dtype: floating-point type of the poses.
    """

    def __init__(self, camera: Camera, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float64) -> None:
        self._mount = torch.tensor(camera.position, device=device, dtype=dtype)
        self._tilt = torch.tensor([camera.tilt], device=device, dtype=dtype)

    def __call__(self, position: Tensor, attitude: Tensor, tilt: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Place the cameras.

        Args:
            position: of the drones, (M, 3), m.
            attitude: of the drones, (M, 4) wxyz.
            tilt: of the cameras, (M,), degrees upwards; the camera's own if None.

        Returns:
            Eyes (M, 3), and axes (M, 3, 3) with rows right, up, backwards, in the world.
        """
        angle = torch.deg2rad(self._tilt if tilt is None else tilt)
        cosine, sine, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        right = torch.stack((zero, zero - 1.0, zero), -1)
        up, backwards = torch.stack((-sine, zero, cosine), -1), torch.stack((-cosine, zero, -sine), -1)
        axes = torch.stack((right, up, backwards), 1).expand(len(position), -1, -1)  # (M, 3, 3) in the body frame
        eye = position + rotate(attitude, self._mount.expand_as(position))
        return eye, rotate(attitude.unsqueeze(1).expand(-1, 3, -1), axes)


class Worker(Protocol):
    """Draws frames in one thread."""

    def draw(self, position: Tensor, axes: Tensor, out: Tensor, looks: Looks | None = None) -> None:
        """Draw from camera positions (m, 3) and axes (m, 3, 3; rows right, up, backwards) into out (m, H, W, 3).

        Frames that have looks take the colours of their materials and the field of view from them; the axes are tilted
        as they say already, and the noise comes later.
        """
        ...

    def close(self) -> None:
        """Free what the worker holds; called in its own thread."""
        ...


class RenderThread(Thread):
    """A thread that does what it is given, in order, until it is ended.

    Unlike an executor's, `end` takes no lock that could be held already: the garbage collector may call it anywhere.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._tasks: SimpleQueue[Task | None] = SimpleQueue()
        self.start()

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Have a function called, and return what will have its result.

        Raises:
            RuntimeError: the thread has ended, as all do when the interpreter exits.
        """
        if not self.is_alive():
            raise RuntimeError("Nothing can be drawn any more: the interpreter exits.")
        future: Future[T] = Future()
        self._tasks.put(Task(future, function, arguments))
        return future

    def end(self, last: Callable[[], None] | None) -> None:
        """End the thread once all is done, with a last function if there is one; does not wait for that."""
        if last is not None:
            self._tasks.put(Task(None, last, ()))
        self._tasks.put(None)

    def run(self) -> None:
        """Do what comes."""
        while (task := self._tasks.get()) is not None:
            _do(task)
            del task  # or the next wait would keep what it refers to


class Task(NamedTuple):
    """Something to do in a thread."""

    future: Future[Any] | None  # takes what it returns or raises; None: nobody waits
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def _do(task: Task) -> None:
    try:
        result = task.function(*task.arguments)
    except BaseException as error:
        if task.future is None:
            logger.warning("A renderer could not be freed.", exc_info=error)
        else:
            task.future.set_exception(error)
    else:
        if task.future is not None:
            task.future.set_result(result)


@atexit.register
def _end_all() -> None:
    """End the threads while the interpreter still works.

    It ends a thread that asks for its lock later on the spot, and where that is amid C++, as when a tensor is let go,
    the process aborts.
    """
    threads = [thread for thread in enumerate_threads() if isinstance(thread, RenderThread)]
    for thread in threads:
        thread.end(None)
    for thread in threads:
        thread.join(EXIT_PATIENCE)


class Renderer:
    """Spreads frames over workers, each of which lives in a thread of its own.

    One that is let go without `close` frees its workers too, without waiting for it.

    Args:
        name: out of `RENDERERS`, or `HYBRID`.
        make_worker: makes one worker; called once in each thread.
        camera: the nose camera.
        num_workers: K.
    """

    def __init__(self, name: str, make_worker: Callable[[], Worker], camera: Camera, num_workers: int) -> None:
        self.name = name
        self.camera = camera
        self._threads = [RenderThread(f"render_{index}") for index in range(num_workers)]
        self._workers: list[Worker] = []
        self._end = weakref.finalize(self, _end, self._threads, self._workers)
        self._end.atexit = False  # contexts are freed at exit as it is
        try:
            # one after the other: the first GL context of a process initialises the display
            for thread in self._threads:
                self._workers.append(thread.submit(make_worker).result())
        except BaseException:
            self.close()
            raise
        self._mount = NoseMount(camera)

    def render(self, position: Tensor, attitude: Tensor, looks: Looks | None = None) -> Tensor:
        """Images (M, height, width, 3) of drones at positions (M, 3) with attitudes (M, 4), wxyz."""
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
        """Free every worker in its own thread, and wait for the threads' end."""
        if self._end.detach() is not None:  # once; called, it does nothing while the interpreter exits
            _end(self._threads, self._workers)
        for thread in self._threads:
            thread.join()


def _end(threads: list[RenderThread], workers: list[Worker]) -> None:
    """Free workers, of which there may be fewer, and end the threads."""
    for thread, worker in zip_longest(threads, workers):
        thread.end(None if worker is None else worker.close)
    workers.clear()


class OpenGLWorker:
    """MuJoCo's OpenGL renderer.

    Args:
        backend: `egl` or `osmesa`.
        model: the compiled scene.
        camera: the nose camera.

    Raises:
        RendererUnavailableError: OpenGL did not start.
    """

    def __init__(self, backend: str, model: mujoco.MjModel, camera: Camera) -> None:
        self._scene = open_scene(backend, model, camera)

    def draw(self, position: Tensor, axes: Tensor, out: Tensor, looks: Looks | None = None) -> None:
        """Draw from camera positions (m, 3) and axes (m, 3, 3; rows right, up, backwards) into out (m, H, W, 3)."""
        positions, ups, forwards = position.numpy(), axes[:, 1].numpy(), (-axes[:, 2]).numpy()
        images = out.numpy()
        for index in range(len(images)):
            if looks is not None:
                self._scene.dress(looks.colors[index].numpy(), looks.field_of_view[index].item())
            self._scene.draw(positions[index], ups[index], forwards[index], images[index])

    def close(self) -> None:
        """Free the OpenGL context."""
        self._scene.close()


def make_renderer(
    name: str, model: mujoco.MjModel, camera: Camera, num_envs: int, num_workers: int, varied_looks: bool = False
) -> Renderer:
    """Make the renderer of that name, or the first that works for `auto`; log which and why.

    Args:
        name: `auto`, or a name out of `RENDERERS`, or `HYBRID`.
        model: the compiled scene.
        camera: the nose camera.
        num_envs: the most frames drawn at once.
        num_workers: threads.
        varied_looks: whether frames may have looks of their own.

    Raises:
        ValueError: unknown name.
        RendererUnavailableError: the renderer asked for does not work here.
    """
    if name not in ("auto", *RENDERERS, HYBRID):
        known = ", ".join(("auto", *RENDERERS, HYBRID))
        raise ValueError(f"Unknown renderer {name!r}: use {known}, or None for no images.")
    if name == HYBRID:
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
        level = logging.WARNING if reasons else logging.INFO  # it is slower than what is missing
        say_once(level, f"renderer: {candidate}, {num_workers} thread(s){why}")
        return renderer
    raise RendererUnavailableError(" ".join(reasons))


@cache
def say_once(level: int, words: str) -> None:
    """Log what a process need not hear again of its next worlds: those of evaluations, say."""
    logger.log(level, words)


def _worker_factory(
    name: str, model: mujoco.MjModel, camera: Camera, frames: int, varied_looks: bool
) -> Callable[[], Worker]:
    """Return what makes the workers of a renderer, once it is sure that they can work here."""
    if name in GL_LIBRARIES:
        require_library(name)
        return lambda: OpenGLWorker(name, model, camera)
    if name == "warp":
        return lambda: RayCaster(model, camera, frames, "cpu", varied_looks)
    if name == HYBRID:
        if not torch.cuda.is_available():
            raise RendererUnavailableError(f"{name} needs a CUDA device, and torch {torch.__version__} finds none.")
        return lambda: RayCaster(model, camera, frames, "cuda", varied_looks)
    raise NotImplementedError(f"{name!r} is among the renderers, but no worker here draws it: add a branch for it.")
