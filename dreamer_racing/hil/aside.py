"""What must not hold up a flight, done beside it: disks stall, and terminals are stopped with Ctrl+S."""

from __future__ import annotations

from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread


class Aside:
    """Does one thing after the other in a thread of its own; who asks for it never waits.

    Args:
        most: Things that may wait.

    Attributes:
        error: What the first thing raised that failed, if one did; nothing is done after it.

    Example:
        >>> done = []
        >>> aside = Aside(most=2)
        >>> aside.do(lambda: done.append(1)), aside.close(patience=1.0), done
        (True, True, [1])
    """

    def __init__(self, most: int) -> None:
        self.error: Exception | None = None
        self._most, self._closed = most, False
        self._waiting: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread: Thread | None = None  # begun with the first thing to do: what forks before has no thread to lose

    def do(self, thing: Callable[[], object]) -> bool:
        """Have something done; return whether it will be: not so if too much waits, one failed, or it is closed."""
        if self.error is not None or self._closed or self._waiting.qsize() >= self._most:
            return False
        if self._thread is None:
            self._thread = Thread(target=self._work, daemon=True)
            self._thread.start()
        self._waiting.put(thing)
        return True

    def close(self, patience: float) -> bool:
        """Wait for what was asked for, so many s at most; return whether all of it is done."""
        self._closed = True
        if self._thread is None:
            return True
        self._waiting.put(None)
        self._thread.join(patience)
        return not self._thread.is_alive() and self.error is None

    def _work(self) -> None:
        while (thing := self._waiting.get()) is not None:
            try:
                thing()
            except Exception as error:
                self.error = error
                return
