"""Warp beside torch on one device: in order on one stream, and captured into one CUDA graph."""

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


@cache
def load_warp() -> Any:
    """Return the package `warp`, initialised so that it reports errors only: no CUDA is no news.

    Raises:
        CacheError: it finds no folder for what it compiles.
    """
    ensure_caches()
    import warp

    warp.config.log_level = warp.LOG_ERROR
    with nullcontext() if torch.cuda.is_available() else _silent():
        warp.init()
    return warp


@contextmanager
def _silent() -> Iterator[None]:
    """Drop what compiled code writes to the standard error stream: warp warns of an absent driver there."""
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
    """Let warp work on a device, on CUDA in torch's present stream, so that all is in order: a context manager.

    It sets what is current for the whole process: two threads must not step worlds of different devices.
    """
    warp = load_warp()
    if device.type != "cuda":
        return warp.ScopedDevice(str(device))
    # no waiting for the stream before: under a graph's capture that would draw another stream into it
    return warp.ScopedStream(_stream(warp, device), sync_enter=False)


def _stream(warp: Any, device: torch.device) -> Any:
    """Return the one warp stream of torch's present stream: captures are booked by the object."""
    stream = torch.cuda.current_stream(device)
    key = (stream.device, stream.cuda_stream)  # every device's default stream has the handle 0
    if key not in _STREAMS:
        _STREAMS[key] = warp.stream_from_torch(stream)
    return _STREAMS[key]


_STREAMS: dict[tuple[torch.device, int], Any] = {}


class GraphedFunction:
    """Replays a function of a tensor, made of torch's and warp's kernels, as one CUDA graph.

    The function must not wait for the device, and must keep what it remembers in place. It is called a few times before
    its capture, so that libraries allocate and compile: what that changed is for the caller to restore.

    Args:
        function: what to capture.
        example: an input, on the CUDA device.
        warmups: calls before the capture.
    """

    def __init__(self, function: Callable[[Tensor], Sequence[Tensor]], example: Tensor, warmups: int = 3) -> None:
        warp, device = load_warp(), example.device
        self._input = example.clone()
        stream = torch.cuda.Stream(device)
        stream.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.device(device), torch.cuda.stream(stream), scope(device):
            for _ in range(warmups):
                function(self._input)
            torch.cuda.synchronize(device)
            self._graph = torch.cuda.CUDAGraph()
            warp_stream = _stream(warp, device)
            with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                warp.capture_begin(stream=warp_stream, external=True)
                self._outputs = tuple(function(self._input))
                # keeps the kernels' modules loaded; what was allocated belongs to torch's graph
                self._warp_graph = warp.capture_end(stream=warp_stream)
        torch.cuda.current_stream(device).wait_stream(stream)

    def __call__(self, value: Tensor) -> tuple[Tensor, ...]:
        """Return copies of what the function returns for a tensor like the example."""
        self._input.copy_(value)
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)
