"""Images: what draws them, and stored ones."""

from __future__ import annotations

import gc
import threading
import weakref
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator.rendering import Renderer, RenderThread
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.simulator.simulators import MujocoSimulator
from dreamer_racing.envs.tracks import load_track
from tests.renderers import IN_PROCESS, renderer_or_skip


class NotedWorker:
    """Notes in which thread it was made and freed."""

    def __init__(self, freed: list[bool]) -> None:
        self._made_in = threading.get_ident()
        self._freed = freed

    def draw(self, *_: Any) -> None:
        """Draw nothing."""

    def close(self) -> None:
        """Note whether this is the thread that made it."""
        self._freed.append(threading.get_ident() == self._made_in)


class Environment:
    """Something in a circle of references that closes its renderer when it goes, as TorchRL's environments do."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.itself = renderer, self

    def __del__(self) -> None:
        self.renderer.close()


def collected_in(seconds: float) -> bool:
    collector = threading.Thread(target=gc.collect, daemon=True)
    collector.start()
    collector.join(seconds)
    return not collector.is_alive()


@pytest.mark.parametrize("keep", ["a circle", "nothing"])
def test_a_renderer_without_references_is_freed_without_deadlock(keep: str) -> None:
    freed: list[bool] = []
    renderer = Renderer("noted", lambda: NotedWorker(freed), Camera(), num_workers=2)
    threads = {thread for thread in threading.enumerate() if thread.name.startswith("render_")}
    if keep == "a circle":
        Environment(renderer)
    del renderer
    assert collected_in(10.0), "the collector waits for a thread that has ended"
    for thread in threads:
        thread.join(10.0)
    assert freed == [True, True]
    assert not threads & set(threading.enumerate())


def test_the_collector_may_come_while_another_renderer_is_given_work() -> None:
    freed: list[bool] = []

    def work() -> None:
        busy = RenderThread("render_busy")
        thresholds = gc.get_threshold()
        gc.set_threshold(2)  # it comes inside of nearly every call
        try:
            for _ in range(200):
                Environment(Renderer("noted", lambda: NotedWorker(freed), Camera(), num_workers=1))
                busy.submit(int).result()
        finally:
            gc.set_threshold(*thresholds)
        busy.end(None)

    worker = threading.Thread(target=work, daemon=True)
    worker.start()
    worker.join(60.0)
    assert not worker.is_alive(), "the collector waits for what its own thread holds"
    gc.collect()
    assert freed == [True] * 200


def test_a_worker_that_cannot_be_freed_does_not_keep_the_others(caplog: pytest.LogCaptureFixture) -> None:
    freed: list[bool] = []

    class Stuck(NotedWorker):
        def close(self) -> None:
            raise RuntimeError("no display")

    workers = iter([Stuck(freed), NotedWorker(freed)])
    Renderer("noted", lambda: next(workers), Camera(), num_workers=2).close()
    assert len(freed) == 1 and "could not be freed" in caplog.text


def test_closing_twice_frees_once() -> None:
    freed: list[bool] = []
    renderer = Renderer("noted", lambda: NotedWorker(freed), Camera(), num_workers=2)
    renderer.close()
    renderer.close()
    assert freed == [True, True]


def test_one_closed_while_the_interpreter_exits_ends_its_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    freed: list[bool] = []
    renderer = Renderer("noted", lambda: NotedWorker(freed), Camera(), num_workers=2)
    monkeypatch.setattr(weakref.finalize, "_shutdown", True)  # what is set before destructors are called
    closing = threading.Thread(target=renderer.close, daemon=True)
    closing.start()
    closing.join(10.0)
    assert not closing.is_alive() and freed == [True, True]


def test_workers_that_were_made_are_freed_where_another_fails() -> None:
    freed: list[bool] = []
    made: list[int] = []

    def make() -> NotedWorker:
        made.append(0)
        if len(made) == 2:
            raise RuntimeError("no context")
        return NotedWorker(freed)

    with pytest.raises(RuntimeError, match="no context"):
        Renderer("noted", make, Camera(), num_workers=3)
    assert freed == [True]


# What the agents that ship see, kept as images: a version of MuJoCo or of mujoco_warp that draws otherwise is
# noticed.


class View(NamedTuple):
    """What an agent's camera is, and where it flies."""

    track: str
    image_size: int
    camera_tilt: float

    @classmethod
    def of(cls, config: Path) -> View:
        settings = yaml.safe_load(config.read_text(encoding="utf-8"))
        return cls(settings["track"], *(settings["env"][name] for name in ("image_size", "camera_tilt")))

    def golden(self, renderer: str) -> Path:
        """The frames that are kept, which lie side by side; agents of one track see the same."""
        return Path(__file__).parent / "golden_images" / f"{self.track}_{renderer}.png"

    def draw(self, renderer: str) -> np.ndarray:
        """Draw leaning towards three gates, uint8 (height, 3 width, 3)."""
        track, camera = load_track(self.track), Camera(self.image_size, self.image_size, tilt=self.camera_tilt)
        simulator = MujocoSimulator(track, PRESETS["easy"], FRAMES, renderer=renderer, camera=camera)
        gates = [track.gates[number * len(track.gates) // FRAMES] for number in range(FRAMES)]
        aside = (0.6, 0.2, -0.2)  # m
        places = [
            np.array(gate.position) - 2.5 * np.array(gate.forward) + left * np.array(gate.left)
            for gate, left in zip(gates, aside, strict=True)
        ]
        roll, pitch = torch.tensor([-0.2, 0.0, 0.2]), torch.full((FRAMES,), 0.3)  # rad
        yaw = torch.tensor([gate.yaw_degrees for gate in gates]).deg2rad() + torch.tensor([0.15, 0.0, -0.15])
        attitude, still = from_roll_pitch_yaw(roll.double(), pitch.double(), yaw.double()), torch.zeros(FRAMES, 3)
        simulator.reset(torch.ones(FRAMES, dtype=torch.bool), torch.tensor(np.array(places)), attitude, still)
        frames = simulator.render().numpy()
        simulator.close()
        return np.concatenate(list(frames), axis=1)


FRAMES = 3
VIEWS = sorted({View.of(file) for file in (Path(__file__).parents[3] / "agents").glob("*/config.yaml")})
BOUND = 2.0
"""Mean difference of a frame's numbers, of 255. The two renderers differ by 0.6 to 0.8; the same frame moved by a pixel
by 6.6 at least, and darkened by 5 % by 5.6."""


@pytest.mark.parametrize("renderer", IN_PROCESS)
@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.track)
def test_an_agent_sees_what_it_saw(view: View, renderer: str) -> None:
    drawn, kept = view.draw(renderer_or_skip(renderer)), np.asarray(Image.open(view.golden(renderer)))
    differences = np.abs(drawn.astype(float) - kept).mean((0, 2)).reshape(FRAMES, -1).mean(1)
    assert differences.max() < BOUND, "if it is meant, draw them anew: python -m tests.envs.simulator.test_rendering"


if __name__ == "__main__":
    for each in VIEWS:
        for name in IN_PROCESS:
            Image.fromarray(each.draw(name)).save(each.golden(name), optimize=True)
            print(each.golden(name))
