"""A headless Chromium for tests, driven by its DevTools protocol; no network but this machine."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from PIL import Image

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PROGRAM = next((found for name in NAMES if (found := shutil.which(name))), None)
ARGUMENTS = (
    "--headless", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-port=0", "--no-first-run",
    "--enable-unsafe-swiftshader", "--use-angle=swiftshader",  # WebGL without a GPU
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip


class Page:
    """An open page."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._numbers = socket, count(1)
        self.requests: list[str] = []
        self.errors: list[str] = []
        for domain in ("Runtime", "Network"):
            self._call(f"{domain}.enable")

    def evaluate(self, expression: str) -> Any:
        """Value of an expression of JavaScript, as far as JSON has it."""
        answer = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str, seconds: float = 120.0) -> None:
        """Wait until it is true."""
        end = time.monotonic() + seconds
        while not self.evaluate(f"Boolean({expression})"):
            assert time.monotonic() < end, f"after {seconds} s still not: {expression}"
            time.sleep(0.3)

    def press(self, key: str) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key=key, text=key if kind == "keyDown" else "")

    def screenshot(self) -> Image.Image:
        """What is to be seen."""
        data = self._call("Page.captureScreenshot")["data"]
        return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=180))
            if message.get("id") == number:
                assert "error" not in message, (method, message)
                return message["result"]
            if message["method"] == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            if message["method"] == "Runtime.exceptionThrown":
                self.errors.append(str(message["params"]["exceptionDetails"]))


@contextmanager
def open_page(address: str, width: int = 900, height: int = 560) -> Iterator[Page]:
    """Open an address, `file:` too, in a browser of its own."""
    from websockets.sync.client import connect

    assert PROGRAM is not None
    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [PROGRAM, *ARGUMENTS, f"--window-size={width},{height}", f"--user-data-dir={profile}", "about:blank"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command, **quiet, start_new_session=True)
        try:
            with connect(_socket_address(Path(profile)), max_size=None) as socket:
                page = Page(socket)
                page._call("Page.navigate", url=address)
                yield page
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # the program may be a script, whose own end leaves the browser
            process.wait(timeout=30)


def _socket_address(profile: Path, seconds: float = 60.0) -> str:
    """Where the first page is to be reached, once the browser has said so."""
    end, file = time.monotonic() + seconds, profile / "DevToolsActivePort"
    while time.monotonic() < end:
        if file.is_file() and (port := file.read_text().partition("\n")[0]):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.1)
    raise TimeoutError(f"{PROGRAM} did not start within {seconds} s.")
