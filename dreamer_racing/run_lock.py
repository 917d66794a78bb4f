"""One process at a time in a run directory."""

import fcntl
import os
import socket
from datetime import datetime
from pathlib import Path


class RunLock:
    """Holds a run directory until `release`, or until the process ends in whatever way.

    Args:
        directory: of the run, which exists.

    Raises:
        ValueError: a live process holds it; the message names that one.

    Example:
        >>> lock = RunLock("runs/example")  # doctest: +SKIP
    """

    def __init__(self, directory: str | Path) -> None:
        path = Path(directory) / ".lock"
        self._file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.seek(0)
            holder = self._file.read().strip() or "another process"
            self._file.close()
            raise ValueError(
                f"run_dir={directory} is in use by a live run ({holder}): wait for its end, stop it, or choose another "
                "run_dir."
            ) from error
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}")
        self._file.flush()

    def release(self) -> None:
        """Let the next one in."""
        self._file.close()
