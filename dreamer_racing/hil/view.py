"""A web page that shows a flight live: the actor's image, state, target gate and speed.

`LiveView.show` is one of `FlightLoop`'s ``watchers``. Without waiting, it leaves the newest frame to a thread,
which sends it by a pipe to a separate process at the lowest priority. That serves the page; it is this file run as a
script:

| path | what |
|---|---|
| ``/`` | the page |
| ``/stream`` | the images as they come, enlarged (MJPEG) |
| ``/image.jpg`` | the newest one |
| ``/state`` | the newest numbers (JSON) |
"""

from __future__ import annotations

import html
import io
import json
import marshal
import math
import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import IO, TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:  # not needed by the serving process
    from dreamer_racing.hil.chain import Outputs

PORT = 9103
SHOWN_WIDTH = 512  # width in pixels to which images are enlarged, by a whole factor [choice]
STREAM_RATE = 30.0  # largest rate of images, Hz [choice]
SILENCE = 1.0  # s without a tick after which the page says so [choice]

_BOUNDARY = "frame"
_START_WITHIN = 20.0  # s


class LiveView:
    """Serves the page for as long as it is open.

    Args:
        port: Port of the page; 0 picks a free one.

    Attributes:
        address: URL of the page.

    Raises:
        OSError: The port is in use, or the page cannot be served; the message says which.

    Example:
        >>> view = LiveView(port=0)
        >>> view.address.startswith("http://127.0.0.1:")
        True
        >>> view.close()
    """

    def __init__(self, port: int = PORT) -> None:
        from dreamer_racing.hil.background_worker import BackgroundWorker  # not needed by the serving process

        self._shown = 0
        self._newest: deque[tuple[dict[str, Any], bytes]] = deque(maxlen=1)  # not sent yet
        with _listen(port) as listening:
            self.address = f"http://127.0.0.1:{listening.getsockname()[1]}/"
            self._server, self._pipe = _start_server(listening)
        self._worker = BackgroundWorker(most=1)

    def show(self, outputs: Outputs) -> None:
        """Show the outputs of a tick, without blocking."""
        pixels = b"" if outputs.image is None else outputs.image.tobytes()
        self._newest.append((self._numbers(outputs), pixels))
        self._worker.submit(self._send)

    def _send(self) -> None:
        if self._newest:
            marshal.dump(self._newest.popleft(), self._pipe)  # a tenth of JSON's time
            self._pipe.flush()

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
        if not self._worker.close(patience=1.0):
            self._server.kill()  # it reads no more
        with suppress(BrokenPipeError):
            self._pipe.close()  # the server ends with its input
        try:
            self._server.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()


def _listen(port: int) -> socket.socket:
    """Return a socket to which browsers of this machine, and no other, can connect."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a page closed just before may hold the port
    try:
        listening.bind(("127.0.0.1", port))
        listening.listen(16)
    except (OSError, OverflowError) as error:
        listening.close()
        message = f"the view cannot listen on 127.0.0.1:{port}: {error}. Is another program, or flight, using it?"
        raise OSError(message) from error
    return listening


def _start_server(listening: socket.socket) -> tuple[subprocess.Popen[bytes], IO[bytes]]:
    """Start the serving process, and wait until it is ready; return it and the pipe to it."""
    # Run by path, so that it imports nothing of the flight; -P, because files beside this one shadow standard modules.
    command = [sys.executable, "-P", os.path.abspath(__file__), str(listening.fileno())]
    # In its own session: Ctrl-C in the terminal is for the flight.
    server = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(listening.fileno(),), start_new_session=True
    )
    assert server.stdin is not None
    assert server.stdout is not None
    patience = threading.Timer(_START_WITHIN, server.kill)
    patience.start()
    with server.stdout as answer:
        ready = answer.readline()
    patience.cancel()
    if not ready:
        server.stdin.close()
        raise OSError(f"the view's process did not start: it ended with status {server.wait()}; see above.")
    return server, server.stdin


# --- in the serving process ---


class Frame(NamedTuple):
    """What the page shows of a tick."""

    numbers: dict[str, Any]  # the values of the tick, from `LiveView`
    pixels: bytes  # raw bytes of the image; empty without one


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

    frame: Frame | None = None  # the newest one
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
        text = _PAGE.format(width=SHOWN_WIDTH, text=html.escape(described(self.frame)))
        self._send("text/html; charset=utf-8", text.encode())

    def _state(self) -> None:
        frame = self.frame
        numbers = {} if frame is None else frame.numbers
        self._send("application/json", json.dumps({**numbers, "text": described(frame)}).encode())

    def _image(self) -> None:
        if self.frame is None:
            self._nothing()
        else:
            self._send("image/jpeg", enlarged(self.frame))

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
            frame = self.frame
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


def serve(listening: int) -> None:
    """Serve the page at a listening socket, given by its descriptor, and read frames from standard input.

    It ends with the input, which closes when the flight's process ends for any reason.
    """
    import PIL.Image  # noqa: F401  # what is missing is to be missed now

    os.nice(19)
    server = _Server(("", 0), _Page, bind_and_activate=False)
    server.socket.close()
    server.socket = socket.socket(fileno=listening)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True).start()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    with suppress(EOFError):
        while True:
            _Page.frame = Frame(*marshal.load(sys.stdin.buffer))
    server.shutdown()
    server.server_close()


if __name__ == "__main__":
    serve(int(sys.argv[1]))
