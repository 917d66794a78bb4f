"""Use of warp beside torch: kernels on the same CUDA stream, and captured into one CUDA graph."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.caches import ensure_caches

WARMUPS = 3  # calls of a function before it is captured


@cache
def load_warp() -> Any:
    """Return the package `warp`, initialised so that it reports only errors, not the absence of CUDA.

    Raises:
        CacheError: there is no usable folder for its kernel cache.
    """
    ensure_caches()
    import warp

    warp.config.log_level = warp.LOG_ERROR
    with nullcontext() if torch.cuda.is_available() else _silenced_stderr():
        warp.init()
    return warp


@contextmanager
def _silenced_stderr() -> Iterator[None]:
    """Discard what compiled code writes to standard error, where warp warns of an absent driver."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def scope(device: torch.device) -> Any:
    """Return a context manager in which warp uses a device, on CUDA with torch's current stream, to keep the order.

    It sets warp's device for the whole process: two threads must not step worlds of different devices.
    """
    warp = load_warp()
    if device.type != "cuda":
        return warp.ScopedDevice(str(device))
    # sync_enter would add another stream to a graph capture
    return warp.ScopedStream(_stream(warp, device), sync_enter=False)


def _stream(warp: Any, device: torch.device) -> Any:
    """Return the warp stream of torch's current stream, always the same object, by which warp tracks captures."""
    stream = torch.cuda.current_stream(device)
    key = (stream.device, stream.cuda_stream)  # every device's default stream has the handle 0
    if key not in _STREAMS:
        _STREAMS[key] = warp.stream_from_torch(stream)
    return _STREAMS[key]


_STREAMS: dict[tuple[torch.device, int], Any] = {}


class GraphedFunction:
    """Replays a function of a tensor that runs torch and warp kernels, as one CUDA graph.

    The function must not synchronise with the device, and must update its state in place. It is called a few times
    before the capture, so that libraries allocate and compile; the caller must restore the state that this changes.

    Args:
        function: what to capture.
        example: an input, on the CUDA device.
    """

    def __init__(self, function: Callable[[Tensor], Sequence[Tensor]], example: Tensor) -> None:
        warp, device = load_warp(), example.device
        self._input = example.clone()
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.device(device), torch.cuda.stream(stream), scope(device):
            for _ in range(WARMUPS):
                function(self._input)
            torch.cuda.synchronize(device)
            self._graph = torch.cuda.CUDAGraph()
            warp_stream = _stream(warp, device)
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                warp.capture_begin(stream=warp_stream, external=True)
                self._outputs = tuple(function(self._input))
                # keeps the kernels' modules loaded; allocations belong to torch's graph
                self._warp_graph = warp.capture_end(stream=warp_stream)
        torch.cuda.current_stream(device).wait_stream(stream)

    def __call__(self, value: Tensor) -> tuple[Tensor, ...]:
        """Return copies of the function's outputs for a tensor like the example."""
        self._input.copy_(value)
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)
