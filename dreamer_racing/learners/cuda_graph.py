"""What makes an update fast on a CUDA device: forward and backward captured as one CUDA graph.

An update of a small model is some thousands of kernels, which a GPU finishes sooner than a CPU can launch them; a graph
launches them all at once.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

Step = Callable[[TensorDictBase], dict[str, Tensor]]
"""Computes losses of a batch ``[B, T]`` and their gradients; returns scalars."""


class GraphedStep:
    """Replays a step as one CUDA graph, captured at the first call.

    The step must not wait for the device, and must find ``.grad`` unset: gradients live in the graph's own memory and
    are overwritten at every replay, so they must not be set to None between calls.

    Args:
        step: What to capture.
        module: Whose gradients and buffers the step writes; the buffers are put back after the warm-up.
        warmups: Calls before the capture, in which libraries allocate and choose kernels.

    Raises:
        ValueError: At a call with a batch of other shapes than the first.
    """

    def __init__(self, step: Step, module: nn.Module, warmups: int = 3) -> None:
        self._step = step
        self._module = module
        self._warmups = warmups
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Run the step on a batch ``[B, T]`` on the CUDA device; return copies of its scalars."""
        with torch.cuda.device(batch.device):  # streams and graphs belong to the current device
            return self._replay(batch)

    def _replay(self, batch: TensorDictBase) -> dict[str, Tensor]:
        graph = self._graph or self._capture(batch)
        if batch.batch_size != self._batch.batch_size:
            raise ValueError(
                f"The CUDA graph was captured for a batch of {list(self._batch.batch_size)}, got "
                f"{list(batch.batch_size)}: keep the shape, or set cuda_graph=False."
            )
        self._batch.update_(batch)
        graph.replay()
        return dict(zip(self._names, torch.stack(self._scalars).unbind(0), strict=True))

    def _capture(self, batch: TensorDictBase) -> torch.cuda.CUDAGraph:
        self._batch = batch.clone()
        buffers = {name: buffer.clone() for name, buffer in self._module.named_buffers()}
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        # The warm-up leaves neither random numbers nor buffers changed: a resumed run makes it again.
        with torch.random.fork_rng(devices=[batch.device]), torch.cuda.stream(side):
            for _ in range(self._warmups):
                self._module.zero_grad(set_to_none=True)
                self._step(self._batch)
        torch.cuda.current_stream().wait_stream(side)
        for name, buffer in self._module.named_buffers():
            buffer.copy_(buffers[name])
        self._module.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        # Threads that prefetch samples may use the device meanwhile.
        with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
            metrics = self._step(self._batch)
        self._names, self._scalars = list(metrics), [value.detach() for value in metrics.values()]
        self._graph = graph
        return graph
