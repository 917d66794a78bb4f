"""The loop's images are those of training, and no torch is needed for them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.rendering import make_renderer
from dreamer_racing.envs.simulator.scene import Camera, build_scene
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.export.contract import describe_camera
from dreamer_racing.hil.camera import NoseCamera, camera_of
from dreamer_racing.hil.vehicle import Pose

TRACK = load_track("figure8")


@pytest.mark.parametrize("camera", [Camera(), Camera(width=96, height=96, field_of_view=100.0, tilt=10.0)])
def test_images_are_those_of_training(camera):
    try:
        ours = NoseCamera(TRACK, camera, "egl")
    except RendererUnavailableError as error:
        pytest.skip(str(error))
    model = build_scene(TRACK, QuadrotorParameters(), camera).compile()
    theirs = make_renderer("egl", model, camera, 1, 1)
    generator = np.random.default_rng(0)
    for _ in range(20):
        position, attitude = generator.uniform((-4, -3, 0.5), (4, 3, 3)), generator.normal(size=4)
        attitude /= np.linalg.norm(attitude)
        image = ours.see(Pose(0.0, position, attitude, np.zeros(3), np.zeros(3)))
        trained = theirs.render(torch.from_numpy(position)[None], torch.from_numpy(attitude)[None])[0].numpy()
        assert np.array_equal(image, trained)
        assert image.std() > 5
    ours.close()
    theirs.close()


def test_a_contract_gives_its_camera_back():
    camera = Camera(width=96, height=48, field_of_view=75.0, tilt=-5.0, position=(0.2, 0.01, 0.0))
    assert camera_of({"camera": describe_camera(camera)}) == camera
    assert camera_of({"camera": describe_camera(replace(camera, rate=25.0))}) == replace(camera, rate=25.0)
    with pytest.raises(ValueError, match="trained on numbers, not on images"):
        camera_of({"camera": None})


def test_what_is_unknown_or_missing_is_said(monkeypatch):
    monkeypatch.setattr(
        "dreamer_racing.envs.simulator.opengl.ctypes.CDLL", lambda name: (_ for _ in ()).throw(OSError())
    )
    with pytest.raises(RendererUnavailableError, match=r"egl needs libEGL.so.1.*osmesa needs libOSMesa.so.8"):
        NoseCamera(TRACK, Camera())


def test_nothing_that_flies_loads_torch():
    """Every module of the package `hil`, in a process of its own."""
    code = (
        "import importlib, pkgutil, sys, dreamer_racing.hil as hil\n"
        "names = [module.name for module in pkgutil.walk_packages(hil.__path__, 'dreamer_racing.hil.')]\n"
        "[importlib.import_module(name) for name in names if not name.endswith('__main__')]\n"
        "assert len(names) > 5, names\n"
        "print([name for name in ('torch', 'torchrl', 'tensordict') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stdout
