"""A background thread for work that must not delay a flight: disks stall, and Ctrl+S stops terminals."""

from __future__ import annotations

from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread


class BackgroundWorker:
    """Runs tasks one after another in a background thread; the caller never waits.

    Args:
        most: Largest number of queued tasks.

    Attributes:
        error: Exception of the first task that failed, if any; no task runs after it.

    Example:
        >>> done = []
        >>> worker = BackgroundWorker(most=2)
        >>> worker.submit(lambda: done.append(1)), worker.close(patience=1.0), done
        (True, True, [1])
    """

    def __init__(self, most: int) -> None:
        self.error: Exception | None = None
        self._most, self._closed = most, False
        self._waiting: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread: Thread | None = None  # started with the first task, so that a fork before that loses no thread

    def submit(self, task: Callable[[], object]) -> bool:
        """Queue a task; return whether it was accepted: not if the queue is full, a task failed, or this is closed."""
        if self.error is not None or self._closed or self._waiting.qsize() >= self._most:
            return False
        if self._thread is None:
            self._thread = Thread(target=self._work, daemon=True)
            self._thread.start()
        self._waiting.put(task)
        return True

    def close(self, patience: float) -> bool:
        """Wait at most ``patience`` s for the queued tasks; return whether all of them are done."""
        self._closed = True
        if self._thread is None:
            return True
        self._waiting.put(None)
        self._thread.join(patience)
        return not self._thread.is_alive() and self.error is None

    def _work(self) -> None:
        while (task := self._waiting.get()) is not None:
            try:
                task()
            except Exception as error:
                self.error = error
                return
