"""One process at a time in a run directory."""

import contextlib
import fcntl
import logging
import os
import socket
from datetime import datetime
from pathlib import Path

logger = logging.getLogger(__name__)


class RunLock:
    """Holds a run directory until `release`, or until the process ends in whatever way.

    Across machines it holds where the file system's locks do (NFS 4, Lustre with flock); where there are no locks it
    warns, and holds nothing.

    Args:
        directory: of the run, which exists.
        made: whether it was made for this lock.

    Attributes:
        directory: as given.

    Raises:
        ValueError: a live process holds it; the message names that one.

    Example:
        >>> lock = RunLock("runs/example")  # doctest: +SKIP
    """

    def __init__(self, directory: str | Path, made: bool = False) -> None:
        self.directory = Path(directory)
        self._made = made
        self._file = (self.directory / ".lock").open("a+", encoding="utf-8")
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
        except OSError as error:
            logger.warning("%s cannot be locked (%s): see to it yourself that no other run uses it.", directory, error)
        self._file.truncate(0)
        self._file.write(f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}")
        self._file.flush()

    def release(self) -> None:
        """Let the next one in."""
        self._file.close()

    def abandon(self) -> None:
        """Let the next one in; a folder that was made for this lock, and holds nothing else, goes."""
        path = Path(self._file.name)
        with contextlib.suppress(OSError):  # it stays, then
            if self._made and list(self.directory.iterdir()) == [path]:
                path.unlink()
                self.directory.rmdir()
        self.release()
