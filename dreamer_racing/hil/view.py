"""A web page that shows a flight live: the actor's image, state, target gate and speed.

`LiveView.show` is one of `FlightLoop`'s ``watchers``. Without waiting, it copies a frame into shared memory. A separate
process at the lowest priority reads it and serves the page; it is this file run as a script:

| path | what |
|---|---|
| ``/`` | the page |
| ``/stream`` | the images as they come, enlarged (MJPEG) |
| ``/image.jpg`` | the newest one |
| ``/state`` | the newest numbers (JSON) |

A frame in memory, little endian: count u32 (odd while it is being written), size of numbers u32, their CRC-32 u32, size
of image u32, numbers (marshal: both ends run the same Python), image (uint8 RGB). A reader that finds the count changed
reads the frame again.
"""

from __future__ import annotations

import html
import io
import json
import logging
import marshal
import math
import mmap
import os
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:  # not needed by the serving process
    from dreamer_racing.hil.chain import Outputs

logger = logging.getLogger(__name__)

PORT = 9103
ROOM = 1 << 22
"""Largest size of a frame, bytes [choice]: images of up to 1000 × 1000 pixels."""
SHOWN_WIDTH = 512
"""Width in pixels to which images are enlarged, by a whole factor [choice]."""
STREAM_RATE = 30.0
"""Largest rate of images, Hz [choice]."""
SILENCE = 1.0
"""s without a tick after which the page says so [choice]."""

_COUNT, _HEAD = struct.Struct("<I"), struct.Struct("<IIII")
_BOUNDARY = "frame"
_START_WITHIN = 20.0  # s


class LiveView:
    """Serves the page for as long as it is open.

    Args:
        port: Port of the page; 0 picks a free one.
        host: Address to listen on; by default only this machine sees the page.

    Attributes:
        address: URL of the page.
        too_large: Number of images so far that were too large for a frame, and were left out.

    Raises:
        OSError: The port is in use, or the page cannot be served; the message says which.

    Example:
        >>> view = LiveView(port=0)
        >>> view.address.startswith("http://127.0.0.1:")
        True
        >>> view.close()
    """

    def __init__(self, port: int = PORT, host: str = "127.0.0.1") -> None:
        self.too_large = 0
        self._shown = 0
        listening = _listen(host, port)
        descriptor = _memory_file()
        try:
            self.address = f"http://{host}:{listening.getsockname()[1]}/"
            self._memory = mmap.mmap(descriptor, ROOM)
            self._memory[:] = bytes(ROOM)  # touched now, to avoid page faults in flight
            self._server = _start_server(descriptor, listening)
        finally:
            listening.close()
            os.close(descriptor)
        if not host.startswith("127."):
            logger.warning("view: listens on %s: everyone who can reach that address can see the flight", host)

    def show(self, outputs: Outputs) -> None:
        """Show the outputs of a tick, without blocking."""
        if self._memory.closed:
            return
        image, memory = outputs.image, self._memory
        pixels = b"" if image is None else np.ascontiguousarray(image).data.cast("B")
        numbers = marshal.dumps(self._numbers(outputs))  # a tenth of JSON's time
        middle = _HEAD.size + len(numbers)
        if middle + len(pixels) > ROOM:
            self.too_large += 1
            pixels = b""
        count = 2 * self._shown % 2**32
        memory[: _HEAD.size] = _HEAD.pack(count + 1, len(numbers), zlib.crc32(numbers), len(pixels))
        memory[_HEAD.size : middle] = numbers
        memory[middle : middle + len(pixels)] = pixels
        memory[: _COUNT.size] = _COUNT.pack(count)

    def _numbers(self, outputs: Outputs) -> dict[str, Any]:
        verdict, pose, image = outputs.verdict, outputs.pose, outputs.image
        self._shown += 1
        return {
            "tick": self._shown,
            "time": time.monotonic(),
            "state": verdict.state.value,
            "armed": bool(verdict.command.armed),
            "words": list(verdict.words),
            "target_gate": int(outputs.target_gate) + 1,
            "passes": int(outputs.passes),
            "speed": None if pose is None else math.hypot(*pose.linear_velocity.tolist()),
            "position": None if pose is None else pose.position.tolist(),
            "body_rates": None if pose is None else pose.body_rates.tolist(),
            "render_ms": 1e3 * float(outputs.render_s),
            "act_ms": 1e3 * float(outputs.act_s),
            "shape": None if image is None else list(image.shape),
        }

    def close(self) -> None:
        """Stop serving the page; may be called twice."""
        if self._memory.closed:
            return
        self._memory.close()
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.close()  # the server ends with its input
        try:
            self._server.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()
        self._server.stdout.close()


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket to which browsers can connect."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a page closed just before may hold the port
    try:
        listening.bind((host, port))
        listening.listen(16)
    except (OSError, OverflowError) as error:
        listening.close()
        message = f"the view cannot listen on {host}:{port}: {error}. Is another program, or flight, using it?"
        raise OSError(message) from error
    return listening


def _memory_file() -> int:
    """Return the descriptor of an unnamed file of `ROOM` bytes, in memory if possible."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("dreamer_racing_view")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, ROOM)
    return descriptor


def _start_server(memory: int, listening: socket.socket) -> subprocess.Popen[bytes]:
    """Start the serving process, and wait until it is ready."""
    shared = (memory, listening.fileno())
    # Run by path, so that it imports nothing of the flight; -P, because files beside this one shadow standard modules.
    command = [sys.executable, "-P", os.path.abspath(__file__), *map(str, shared)]
    # In its own session: Ctrl-C in the terminal is for the flight.
    server = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=shared, start_new_session=True
    )
    assert server.stdin is not None
    assert server.stdout is not None
    patience = threading.Timer(_START_WITHIN, server.kill)
    patience.start()
    ready = server.stdout.readline()
    patience.cancel()
    if not ready:
        server.stdin.close()
        server.stdout.close()
        raise OSError(f"the view's process did not start: it ended with status {server.wait()}; see above.")
    return server


# --- in the serving process ---


class Frame(NamedTuple):
    """A frame read from memory."""

    numbers: dict[str, Any]  # the values of a tick, from `LiveView`
    pixels: bytes  # raw bytes of the image; empty without one


def read_frame(memory: mmap.mmap, tries: int = 20) -> Frame | None:
    """Return the newest frame; None if there is none yet, or it was being written at each try."""
    for _ in range(tries):
        count, length, check, size = _HEAD.unpack_from(memory)
        if not length:
            return None
        middle = _HEAD.size + length
        numbers, pixels = memory[_HEAD.size : middle], memory[middle : middle + size]
        # The CRC is for machines on which other processes may see writes out of order: pixels may then mix two images,
        # but the parsed numbers are intact.
        if not count % 2 and _COUNT.unpack_from(memory)[0] == count and zlib.crc32(numbers) == check:
            return Frame(marshal.loads(numbers), pixels)
        time.sleep(0.0005)
    return None


def enlarged(frame: Frame) -> bytes:
    """Return the image as JPEG, each pixel as a square; a grey one if there is none."""
    from PIL import Image

    shape = frame.numbers["shape"]
    if shape is None or not frame.pixels:
        image, factor = Image.new("RGB", (64, 64), (128, 128, 128)), SHOWN_WIDTH // 64
    else:
        height, width, _ = shape
        image, factor = Image.frombytes("RGB", (width, height), frame.pixels), max(SHOWN_WIDTH // width, 1)
    file = io.BytesIO()
    size = image.width * factor, image.height * factor
    image.resize(size, Image.Resampling.NEAREST).save(file, "JPEG", quality=90)
    return file.getvalue()


def described(frame: Frame | None) -> str:
    """Return the values as text, one per line."""
    if frame is None:
        return "no tick yet"
    numbers = frame.numbers
    silent = time.monotonic() - numbers["time"]
    speed = "no pose" if numbers["speed"] is None else f"{numbers['speed']:.1f} m/s"
    position = ", ".join(f"{value:.2f}" for value in numbers["position"] or ()) or "unknown"
    rates = ", ".join(f"{value:.1f}" for value in numbers["body_rates"] or ()) or "unknown"
    lines = [
        f"NO TICK FOR {silent:.0f} s" if silent > SILENCE else f"tick {numbers['tick']}",
        f"state     {numbers['state']}{', armed' if numbers['armed'] else ''}",
        f"gate      {numbers['target_gate']} comes next, {numbers['passes']} passed",
        f"speed     {speed}",
        f"position  {position} m",
        f"turns at  {rates} rad/s about x, y, z",
        f"took      {numbers['render_ms']:.1f} ms to render, {numbers['act_ms']:.1f} ms to act",
        *("image     none: the flyer has no camera" for _ in range(numbers["shape"] is None)),
        *numbers["words"],
    ]
    return "\n".join(lines)


_PAGE = """<!doctype html>
<meta charset="utf-8">
<title>flight</title>
<style>
body {{ background: #212529; color: #f8f9fa; font: 16px monospace; display: flex; gap: 2em; margin: 2em; }}
img {{ image-rendering: pixelated; }}
</style>
<img src="stream" width="{width}" alt="what the actor sees">
<pre id="state">{text}</pre>
<script>
const state = document.getElementById("state");
async function look() {{
  try {{ state.textContent = (await (await fetch("state")).json()).text; }}
  catch (error) {{ state.textContent = "the flight is over"; }}
  setTimeout(look, 100);
}}
look();
</script>
"""


class _Page(BaseHTTPRequestHandler):
    """Handles requests of browsers."""

    memory: mmap.mmap
    timeout = 5.0  # s that a browser may take

    def do_GET(self) -> None:
        """Answer a request."""
        answer = {"/": self._page, "/state": self._state, "/image.jpg": self._image, "/stream": self._stream}
        try:
            answer.get(self.path.partition("?")[0], self._nothing)()
        except (ConnectionError, TimeoutError):
            self.close_connection = True  # the browser has gone

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the terminal belongs to the flight."""

    def _page(self) -> None:
        text = _PAGE.format(width=SHOWN_WIDTH, text=html.escape(described(read_frame(self.memory))))
        self._send("text/html; charset=utf-8", text.encode())

    def _state(self) -> None:
        frame = read_frame(self.memory)
        numbers = {} if frame is None else frame.numbers
        self._send("application/json", json.dumps({**numbers, "text": described(frame)}).encode())

    def _image(self) -> None:
        frame = read_frame(self.memory)
        if frame is None:
            self._nothing()
        else:
            self._send("image/jpeg", enlarged(frame))

    def _nothing(self) -> None:
        self.send_error(404)

    def _stream(self) -> None:
        """Send each new image until the browser disconnects."""
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        sent = None
        while True:
            frame = read_frame(self.memory)
            if frame is not None and frame.numbers["tick"] != sent:
                sent = frame.numbers["tick"]
                data = enlarged(frame)
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(1.0 / STREAM_RATE)

    def _send(self, kind: str, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(data)


class _Server(ThreadingHTTPServer):
    """Ignores browsers that disconnect during an answer."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


def serve(memory: int, listening: int) -> None:
    """Serve the page until standard input closes, which happens when the flight's process ends for any reason.

    Both arguments are descriptors: of the frame's file, and of the listening socket.
    """
    import PIL.Image  # noqa: F401  # what is missing is to be missed now

    os.nice(19)
    _Page.memory = mmap.mmap(memory, ROOM, access=mmap.ACCESS_READ)
    server = _Server(("", 0), _Page, bind_and_activate=False)
    server.socket.close()
    server.socket = socket.socket(fileno=listening)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.buffer.read()
    server.shutdown()
    server.server_close()


if __name__ == "__main__":
    serve(int(sys.argv[1]), int(sys.argv[2]))
