"""Workers of a renderer: freed once, in their threads, whoever lets go of them and how."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import Any

import pytest

from dreamer_racing.envs.simulator.rendering import Renderer, RenderThread
from dreamer_racing.envs.simulator.scene import Camera


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
def test_one_that_is_let_go_is_freed_and_nobody_waits_for_ever(keep: str) -> None:
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
