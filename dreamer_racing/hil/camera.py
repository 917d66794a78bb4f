"""Renders the nose camera's image from a measured pose, in the scene of training."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.opengl import GL_LIBRARIES, RendererUnavailableError, open_scene
from dreamer_racing.envs.simulator.scene import Camera, build_scene
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.attitude import rotation_matrix
from dreamer_racing.hil.vehicle import Pose
from dreamer_racing.settings import check_choice

logger = logging.getLogger(__name__)


class NoseCamera:
    """Renders images of a track, in the thread that created it only.

    With ``auto`` the first back end that works is used; a warning says so if that is not EGL.

    Raises:
        ValueError: There is no such back end.
        RendererUnavailableError: No back end works here; the message says why and what would help.
    """

    def __init__(self, track: Track, camera: Camera, backend: str = "auto") -> None:
        check_choice("renderer", backend, ("auto", *GL_LIBRARIES))
        model = build_scene(track, QuadrotorParameters(), camera).compile()
        reasons = []
        for name in GL_LIBRARIES if backend == "auto" else (backend,):
            try:
                self._scene = open_scene(name, model, camera)
                break
            except RendererUnavailableError as error:
                reasons.append(str(error))
        else:
            raise RendererUnavailableError(" ".join(reasons))
        if reasons:  # the first choice is faster, and replays of this flight need the same one
            logger.warning("renderer: %s, because: %s", name, " ".join(reasons))
        tilt = math.radians(camera.tilt)
        self._mount = np.array(camera.position)
        self._up = np.array((-math.sin(tilt), 0.0, math.cos(tilt)))
        self._forward = np.array((math.cos(tilt), 0.0, math.sin(tilt)))
        self._size = (camera.height, camera.width, 3)

    def see(self, pose: Pose) -> np.ndarray:
        """Return the image, uint8 RGB (height, width, 3), first row at the top."""
        turned = rotation_matrix(pose.attitude)
        image = np.empty(self._size, np.uint8)
        self._scene.draw(pose.position + turned @ self._mount, turned @ self._up, turned @ self._forward, image)
        return image

    def close(self) -> None:
        """Free the OpenGL context."""
        self._scene.close()


def camera_of(contract: dict[str, Any]) -> Camera:
    """Return the camera that an actor's contract describes.

    Raises:
        ValueError: The contract has no camera: the actor was trained on numbers, not on images.
    """
    described = contract.get("camera")
    if described is None:
        raise ValueError(
            "This actor was trained on numbers, not on images (its contract has no camera): it cannot fly here."
        )
    return Camera(
        width=described["width_px"],
        height=described["height_px"],
        field_of_view=described["vertical_field_of_view_deg"],
        tilt=described["tilt_up_deg"],
        position=tuple(described["position_body_m"]),
        rate=described.get("rate_hz"),
    )
