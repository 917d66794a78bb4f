"""The CLI of a Betaflight on this machine, over TCP: sends lines, and returns the answers.

The CLI is entered by ``#``, and answers each line with its echo, the output, and a prompt.

Reference: https://betaflight.com/docs/development/Cli; src/main/cli/cli.c.
"""

from __future__ import annotations

import re
import socket
import time

_PROMPT = b"\r\n# "
_HEARD_WITHIN = 3.0  # s, in which a firmware that has booted answers
_REFUSED = re.compile(r"###ERROR.*|.*unknown command.*|.*invalid .*", re.IGNORECASE)


class CommandLine:
    """A session in the CLI, after which the firmware does not arm until it is restarted.

    Args:
        port: TCP port on this machine.
        patience: s to wait for an answer.

    Raises:
        OSError: No firmware answers at the port, or, from each method, it does not answer any more.
    """

    def __init__(self, port: int, patience: float = 30.0) -> None:
        self._port, self._patience = port, patience
        deadline = time.monotonic() + patience
        while True:
            self._socket = connect(port, patience)
            try:
                self._read_to_prompt(b"#", _HEARD_WITHIN)
                return
            except OSError:
                self._socket.close()
                if time.monotonic() > deadline:
                    raise  # else try again: a ``#`` sent while the firmware boots is lost

    def execute(self, line: str) -> str:
        """Type a line; return the answer, without echo and prompt."""
        answer = self._read_to_prompt(line.encode("ascii") + b"\n").decode("utf-8", errors="replace")
        return answer.replace("\r", "").removeprefix(line).strip()

    def type_all(self, lines: list[str]) -> dict[str, str]:
        """Type lines other than comments; return the refused ones, with the firmware's messages."""
        refused = {}
        for line in lines:
            if line and not line.startswith("#") and (found := _REFUSED.search(self.execute(line))):
                refused[line] = found[0].strip("# ")
        return refused

    def leave(self, line: str) -> None:
        """Type the line that ends the session, and with it the process, without waiting for an answer."""
        self._socket.sendall(line.encode("ascii") + b"\n")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _read_to_prompt(self, wanted: bytes, patience: float | None = None) -> bytes:
        self._socket.sendall(wanted)
        said, deadline = b"", time.monotonic() + (patience or self._patience)
        while not said.endswith(_PROMPT):
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-3))
            try:
                received = self._socket.recv(65536)
            except TimeoutError:
                received = b""
            if not received:
                raise OSError(
                    f"the firmware's CLI at port {self._port} did not answer {wanted.decode()!r}: is a "
                    "configurator connected to it?"
                )
            said += received
        return said.removesuffix(_PROMPT)


def connect(port: int, patience: float) -> socket.socket:
    """Return a connection to a port of this machine, waiting for it to open."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=patience)
        except ConnectionRefusedError as error:
            if time.monotonic() > deadline:
                raise OSError(f"no firmware answers at TCP port {port} within {patience:g} s") from error
        time.sleep(0.02)
