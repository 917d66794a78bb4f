"""Images: what draws them, and stored ones."""

from __future__ import annotations

import gc
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from dreamer_racing.envs.drone.parameters import load_preset, without_randomisation
from dreamer_racing.envs.drone.rotation import from_roll_pitch_yaw
from dreamer_racing.envs.simulator.mujoco_cpu import MujocoSimulator
from dreamer_racing.envs.simulator.rendering import Renderer, RenderThread
from dreamer_racing.envs.simulator.scene import Camera
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


def camera_of(agent: Path) -> tuple[object, ...]:
    """Track, size of the images and tilt."""
    config = yaml.safe_load((agent / "config.yaml").read_text(encoding="utf-8"))
    return config["track"], config["env"]["image_size"], config["env"]["camera_tilt"]


EACH = sorted(file.parent for file in (Path(__file__).parents[3] / "agents").glob("*/config.yaml"))
AGENTS = list({camera_of(agent): agent for agent in EACH}.values())
"""One of those that see the same."""
GOLDEN = Path(__file__).parent / "golden_images"
FRAMES = 3
BOUND = 2.0
"""Mean difference of a frame's numbers, of 255. The two renderers differ by 0.6 to 0.8; the same frame moved by a pixel
by 6.6 at least, and darkened by 5 % by 5.6."""


def draw(agent: Path, renderer: str) -> np.ndarray:
    """Draw what an agent sees where it leans towards three gates of its track, uint8 (3, height, width, 3)."""
    config = yaml.safe_load((agent / "config.yaml").read_text(encoding="utf-8"))
    settings, track = config["env"], load_track(config["track"])
    size = settings["image_size"]
    simulator = MujocoSimulator(
        track,
        without_randomisation(load_preset(settings["preset"])),
        FRAMES,
        renderer=renderer,
        camera=Camera(size, size, tilt=settings["camera_tilt"]),
    )
    gates = [track.gates[number * len(track.gates) // FRAMES] for number in range(FRAMES)]
    aside = (0.6, 0.2, -0.2)  # m
    places = [
        np.array(gate.position) - 2.5 * np.array(gate.forward) + left * np.array(gate.left)
        for gate, left in zip(gates, aside, strict=True)
    ]
    roll, pitch = torch.tensor([-0.2, 0.0, 0.2]), torch.full((FRAMES,), 0.3)  # rad
    yaw = torch.tensor([gate.yaw_degrees for gate in gates]).deg2rad() + torch.tensor([0.15, 0.0, -0.15])
    attitude = from_roll_pitch_yaw(roll.double(), pitch.double(), yaw.double())
    everyone = torch.ones(FRAMES, dtype=torch.bool)
    simulator.reset(everyone, torch.tensor(np.array(places)), attitude, torch.zeros(FRAMES, 3, dtype=torch.float64))
    frames = simulator.render().numpy()
    simulator.close()
    return frames


def golden_file(agent: Path, renderer: str) -> Path:
    """Agents of one track see the same."""
    track = yaml.safe_load((agent / "config.yaml").read_text(encoding="utf-8"))["track"]
    return GOLDEN / f"{track}_{renderer}.png"


def golden(agent: Path, renderer: str) -> np.ndarray:
    """The frames that are kept, which lie side by side."""
    return np.stack(np.split(np.asarray(Image.open(golden_file(agent, renderer))), FRAMES, axis=1))


def difference(drawn: np.ndarray, kept: np.ndarray) -> float:
    """Of the frame that differs most."""
    return float(np.abs(drawn.astype(float) - kept).mean((1, 2, 3)).max())


@pytest.mark.parametrize("renderer", IN_PROCESS)
@pytest.mark.parametrize("agent", AGENTS, ids=lambda agent: agent.name)
def test_an_agent_sees_what_it_saw(agent: Path, renderer: str) -> None:
    drawn = draw(agent, renderer_or_skip(renderer))
    assert difference(drawn, golden(agent, renderer)) < BOUND, "if it is meant: draw them anew as above"


@pytest.mark.parametrize("renderer", IN_PROCESS)
@pytest.mark.parametrize("agent", AGENTS, ids=lambda agent: agent.name)
def test_images_that_are_white_moved_or_of_other_colours_are_beyond_the_bound(agent: Path, renderer: str) -> None:
    kept = golden(agent, renderer)
    spoilt = {
        "white": np.full_like(kept, 255),
        "black": np.zeros_like(kept),
        "a pixel to the side": np.roll(kept, 1, 2),
        "a pixel down": np.roll(kept, 1, 1),
        "mirrored": kept[:, :, ::-1],
        "upside down": kept[:, ::-1],
        "blue for red": kept[..., ::-1],
        "darker": (0.95 * kept).astype(np.uint8),
        "of the next place": np.roll(kept, 1, 0),
    }
    assert {name: found for name, frames in spoilt.items() if (found := difference(frames, kept)) < 2 * BOUND} == {}


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for each in AGENTS:
        for name in IN_PROCESS:
            Image.fromarray(np.concatenate(list(draw(each, name)), axis=1)).save(golden_file(each, name), optimize=True)
            print(golden_file(each, name))
