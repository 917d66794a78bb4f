"""What a flight shows: the page for people, the images for actors, and gates passed."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.envs.simulator.rendering import make_renderer
from dreamer_racing.envs.simulator.scene import Camera, build_scene
from dreamer_racing.envs.tracks import Gate, load_track, make_track
from dreamer_racing.export.contract import describe_camera
from dreamer_racing.hil.camera import NoseCamera, camera_of
from dreamer_racing.hil.chain import Outputs
from dreamer_racing.hil.progress import GateProgress
from dreamer_racing.hil.safety import State, Verdict
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.hil.vehicle import Command, Pose, at_rest, hover
from dreamer_racing.hil.view import LiveView, _listen

IMAGE = np.zeros((64, 64, 3), np.uint8)
IMAGE[:32], IMAGE[32:] = (255, 0, 0), (0, 0, 255)  # red above blue


def outputs(image: np.ndarray | None = IMAGE, state: State = State.FLYING, words: tuple[str, ...] = ()) -> Outputs:
    command = Command(True, hover()) if state is State.FLYING else at_rest()
    pose = Pose(1.0, np.array([1.0, 2.0, 3.0]), np.array([1.0, 0, 0, 0]), np.array([3.0, 0.0, 4.0]), np.zeros(3))
    return Outputs(Verdict(state, command, (), words), hover(), pose, 0.0, image, 2, 8, 0.0015, 0.0025)


NO_POSE = outputs(None, State.DISARMED, ("there is no pose", "<b> & more"))._replace(pose=None, setpoint=None)


@pytest.fixture
def view():
    made = LiveView(port=0)
    yield made
    made.close()


def get(view: LiveView, path: str) -> bytes:
    with urllib.request.urlopen(view.address + path, timeout=10.0) as answer:
        return answer.read()


def show(view: LiveView, shown: Outputs) -> None:
    """Show a tick, and wait until the page has it."""
    view.show(shown)
    deadline = time.monotonic() + 10.0
    while json.loads(get(view, "state")).get("tick") != view._shown and time.monotonic() < deadline:
        time.sleep(0.01)


def test_state_and_numbers_are_told_in_text(view):
    assert json.loads(get(view, "state")) == {"text": "no tick yet"}
    show(view, outputs())
    state = json.loads(get(view, "state"))
    assert (state["state"], state["armed"], state["target_gate"], state["passes"]) == ("flying", True, 3, 8)
    assert state["speed"] == 5.0 and state["position"] == [1.0, 2.0, 3.0]
    lines = state["text"].splitlines()
    assert lines[1:6] == [
        "state     flying, armed",
        "gate      3 comes next, 8 passed",
        "speed     5.0 m/s",
        "position  1.00, 2.00, 3.00 m",
        "turns at  0.0, 0.0, 0.0 rad/s about x, y, z",
    ]
    assert lines[6] == "took      1.5 ms to render, 2.5 ms to act"


def test_without_pose_and_camera_it_says_why(view):
    show(view, NO_POSE)
    text = json.loads(get(view, "state"))["text"]
    assert "speed     no pose" in text and "position  unknown m" in text and "the flyer has no camera" in text
    assert text.endswith("there is no pose\n<b> & more")
    page = get(view, "").decode()
    assert "&lt;b&gt; &amp; more" in page and "<b>" not in page
    assert Image.open(io.BytesIO(get(view, "image.jpg"))).getpixel((5, 5)) == pytest.approx((128, 128, 128), abs=3)


def test_the_image_is_enlarged_and_the_right_way_up(view):
    show(view, outputs())
    image = Image.open(io.BytesIO(get(view, "image.jpg")))
    assert image.size == (512, 512)
    red, blue = image.getpixel((256, 200)), image.getpixel((256, 300))
    assert red == pytest.approx((255, 0, 0), abs=8) and blue == pytest.approx((0, 0, 255), abs=8)
    wide = np.zeros((20, 30, 4), np.uint8)[::-1, :, :3]  # neither square nor in one piece
    wide[:, :10] = (0, 255, 0)
    show(view, outputs(wide))
    image = Image.open(io.BytesIO(get(view, "image.jpg")))
    assert image.size == (17 * 30, 17 * 20)
    assert image.getpixel((50, 100)) == pytest.approx((0, 255, 0), abs=8)


def test_the_stream_has_each_new_image(view):
    show(view, outputs())
    with urllib.request.urlopen(view.address + "stream", timeout=10.0) as stream:
        assert stream.headers["Content-Type"].startswith("multipart/x-mixed-replace")
        for value in (200, 50):
            show(view, outputs(np.full((64, 64, 3), value, np.uint8)))
            found = None
            while found is None or abs(found - value) > 3:  # an image from before may come first
                assert stream.readline() == b"--frame\r\n"
                assert stream.readline() == b"Content-Type: image/jpeg\r\n"
                size = int(stream.readline().split(b":")[1])
                assert stream.readline() == b"\r\n"
                found = Image.open(io.BytesIO(stream.read(size))).getpixel((9, 9))[0]
                assert stream.readline() == b"\r\n"


def test_it_says_when_ticks_stop(view):
    show(view, outputs())
    time.sleep(1.2)
    assert json.loads(get(view, "state"))["text"].startswith("NO TICK FOR 1 s")


def test_other_addresses_are_not_there(view):
    for path in ("image.jpg", "etc/passwd", "../view.py"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(view, path)


def test_only_this_machine_sees_the_page():
    with _listen(0) as listening:
        assert listening.getsockname()[0] == "127.0.0.1"


def test_a_port_in_use_is_said(view):
    port = int(view.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(OSError, match=rf"cannot listen on 127.0.0.1:{port}: .* Is another program, or flight, using"):
        LiveView(port=port)


def test_it_closes_at_once_with_a_browser_at_it(view):
    show(view, outputs())
    with urllib.request.urlopen(view.address + "stream", timeout=10.0):
        start = time.monotonic()
        view.close()
        assert time.monotonic() - start < 5.0
    assert view._server.returncode == 0
    with pytest.raises(urllib.error.URLError):
        get(view, "state")
    view.close()
    view.show(outputs())  # a late tick harms nobody
    LiveView(port=int(view.address.rstrip("/").rpartition(":")[2])).close()  # the port is free


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_a_flight_goes_on_when_its_page_dies_or_hangs(view, end):
    os.kill(view._server.pid, end)
    start = time.monotonic()
    for _ in range(100):
        view.show(outputs(np.zeros((500, 500, 3), np.uint8)))
    assert time.monotonic() - start < 5.0
    view.close()


def test_a_large_image_is_shown_too(view):
    show(view, outputs(np.zeros((2000, 2000, 3), np.uint8)))
    assert json.loads(get(view, "state"))["shape"] == [2000, 2000, 3]
    assert Image.open(io.BytesIO(get(view, "image.jpg"))).size == (2000, 2000)


KILLED = """
import os, signal
from dreamer_racing.hil.view import LiveView
view = LiveView(port=0)
print(view._server.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_it_ends_with_a_flight_that_is_killed():
    run = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, timeout=60)
    assert run.returncode == -signal.SIGKILL, run.stderr
    server = int(run.stdout)
    for _ in range(100):
        try:
            os.kill(server, 0)
        except ProcessLookupError:
            return
        stat = Path(f"/proc/{server}/stat")
        if stat.exists() and stat.read_text().split(") ")[1].startswith("Z"):  # ended, and nobody has asked
            return
        time.sleep(0.1)
    os.kill(server, signal.SIGKILL)
    pytest.fail("the page lived on for 10 s")


# The loop's images are those of training, and no torch is needed for them.


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


def test_nothing_that_flies_loads_torch_or_the_packages_of_other_links():
    """Every module of the package `hil`, in a process of its own."""
    code = (
        "import importlib, pkgutil, sys, dreamer_racing.hil as hil\n"
        "names = [module.name for module in pkgutil.walk_packages(hil.__path__, 'dreamer_racing.hil.')]\n"
        "[importlib.import_module(name) for name in names if not name.endswith('__main__')]\n"
        "assert len(names) > 5, names\n"
        "print([name for name in ('torch', 'torchrl', 'tensordict', 'serial', 'pymavlink') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stdout


# Gates passed in order, by hand, and as the race itself counts them.


LINE = make_track("line", [Gate((0.0, 0.0, 1.35), 0.0), Gate((5.0, 0.0, 1.35), 0.0)])


def at(time: float, *position: float) -> Pose:
    return Pose(time, np.array(position), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3))


def fly(*poses: Pose) -> GateProgress:
    progress = GateProgress(LINE, SafetyLimits.of_track(LINE))
    for pose in poses:
        progress.update(pose)
    return progress


def test_a_pass_has_a_time_and_an_offset():
    progress = fly(at(1.0, -0.3, 0.3, 1.35), at(1.1, 0.1, 0.3, 1.75))
    assert progress.target == 1
    assert progress.passes[0].gate == 0
    assert progress.passes[0].time == pytest.approx(1.075)
    assert progress.passes[0].offset == pytest.approx(np.hypot(0.3, 0.3))


@pytest.mark.parametrize(
    "poses",
    [
        (at(0, 0.1, 0, 1.35), at(1, -0.1, 0, 1.35)),  # backwards
        (at(0, -0.1, 0.8, 1.35), at(1, 0.1, 0.8, 1.35)),  # beside the opening
        (at(0, -0.1, 0, 2.1), at(1, 0.1, 0, 2.1)),  # over it
        (at(0, 4.9, 0, 1.35), at(1, 5.1, 0, 1.35)),  # the second first
    ],
)
def test_what_is_no_pass(poses):
    assert not fly(*poses).passes


def test_a_pose_counts_where_safety_would_allow_it():
    """5 ms after the one before it may be 0.175 m further; several gates may be passed from one tick to the next."""
    near = make_track("near", [Gate((0.0, 0.0, 1.35), 0.0), Gate((0.3, 0.0, 1.35), 0.0)])
    progress = GateProgress(near, SafetyLimits.of_track(near))
    for number, x in enumerate((-0.05, 0.05, 0.15, 0.25, 0.35)):
        progress.update(at(0.005 * number, x, 0.0, 1.35), judged=x > 0.3)
    assert [passed.gate for passed in progress.passes] == [0, 1]
    progress.reset()
    progress.update(at(1.0, -0.2, 0.0, 1.35))
    assert progress.update(at(1.005, 0.2, 0.0, 1.35), judged=False) is None
    assert progress.update(at(1.010, -0.1, 0.0, 1.35)) is None
    assert progress.update(at(1.015, 0.2, 0.0, 1.35)) is None, "safety judges it, and cuts"
    assert progress.passes == []


def test_laps_go_on_and_a_reset_begins_anew():
    lap = [at(0, -1, 0, 1.35), at(1, 1, 0, 1.35), at(2, 6, 0, 1.35), at(3, 6, 9, 1.35), at(4, -1, 9, 1.35)]
    progress = fly(*lap, *lap)
    assert [passed.gate for passed in progress.passes] == [0, 1, 0, 1]
    progress.reset()
    assert (progress.target, progress.passes) == (0, [])
