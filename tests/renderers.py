"""Which renderers the tests draw with."""

from __future__ import annotations

import pytest

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.simulator import rendering
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError, loads
from dreamer_racing.envs.simulator.rendering import RENDERERS
from dreamer_racing.envs.simulator.scene import Camera, build_scene
from dreamer_racing.envs.tracks import load_track

IN_PROCESS = tuple(name for name in RENDERERS if name != "osmesa")
"""Those that draw side by side; PyOpenGL is bound to one platform, here EGL, for the life of a process."""
NEEDS_EGL = pytest.mark.skipif(not loads("libEGL.so.1"), reason="EGL is not installed here")


def renderer_or_skip(name: str) -> str:
    """The name, if what the renderer needs is on this machine."""
    camera = Camera()
    model = build_scene(load_track("kidney"), PRESETS["easy"], camera).compile()
    try:
        rendering._worker_factory(name, model, camera, 1, False)
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    return name
