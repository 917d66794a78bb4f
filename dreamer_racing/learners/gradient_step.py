"""Parts of a gradient step besides losses: gradient norms, a guard against non-finite values, CUDA graphs.

An update of a small model is some thousands of kernels, which a GPU runs faster than a CPU can launch them; a CUDA
graph launches them all at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


def gradient_norms(networks: Mapping[str, list[nn.Parameter]]) -> dict[str, Tensor]:
    """Return the gradient's global norm of each network that has one, scalars by ``gradient_norm/<network>``."""
    gradients = {name: [p.grad for p in parameters if p.grad is not None] for name, parameters in networks.items()}
    return {f"gradient_norm/{name}": nn.utils.get_total_norm(found) for name, found in gradients.items() if found}


def check_scalars(values: Mapping[str, Tensor]) -> None:
    """Refuse losses and metrics that are not scalar tensors, as those of one's own may be.

    Raises:
        ValueError: The message names them.
    """
    bad = {name: value for name, value in values.items() if not (isinstance(value, Tensor) and value.dim() == 0)}
    if bad:
        kinds = {name: tuple(each.shape) if isinstance(each, Tensor) else type(each) for name, each in bad.items()}
        found = ", ".join(f"{name} is {'of shape ' * isinstance(kind, tuple)}{kind}" for name, kind in kinds.items())
        raise ValueError(f"Losses and metrics must be scalar tensors: {found}. Take the mean, or use torch.tensor().")


def restore(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimiser's state, but keep its own settings: a run may resume with other rates or another device."""
    saved = {index: group for group in state["param_groups"] for index in group["params"]}
    groups = []
    for own in optimizer.state_dict()["param_groups"]:
        kept = {name: own[name] for name in ("params", "lr", "warmup_steps", "fused") if name in own}
        groups.append({**saved[own["params"][0]], **kept})  # a saved group may have been split since
    optimizer.load_state_dict({**state, "param_groups": groups})


def step_with_gradients(optimizer: torch.optim.Optimizer) -> None:
    """Make a step of the parameter groups that have gradients.

    TorchRL's optimiser counts a step of the others, too. An actor that learns in every n-th update would then have its
    moments corrected for n times too many steps, so that its own steps would be too large.
    """
    idle = [group for group in optimizer.param_groups if all(each.grad is None for each in group["params"])]
    optimizer.step()
    for group in idle:
        group["step"] -= 1


class NonFiniteLossError(RuntimeError):
    """Raised if a loss, its gradient or a reward is infinite or not a number.

    Attributes:
        batch: Data of that update: a replayed batch ``[B, T]``, or the collected steps of an actor's update.
    """

    def __init__(self, batch: TensorDictBase, of: str = "") -> None:
        super().__init__(
            f"The loss{of}, its gradient or a reward is not finite: the learning rate may be too high, or a reward or "
            "observation is bad."
        )
        self.batch = batch

    def save_batch(self, path: Path) -> str:
        """Save the batch; return in words where it is, or why it could not be saved."""
        try:
            torch.save(self.batch.to("cpu").to_dict(), path)
        except (OSError, RuntimeError) as refused:  # torch raises RuntimeError on a full disk
            return f"The batch could not be saved ({' '.join(str(refused).split())})"
        return f"The batch is saved in {path}"


class FiniteGuard:
    """Raises ``NonFiniteLossError`` if the metrics of an update are not finite.

    Args:
        lag: Number of updates by which the check is delayed; 0 checks at once, and waits for the device.
    """

    def __init__(self, lag: int) -> None:
        self._lag = lag
        self._pending: deque[tuple[Tensor, torch.cuda.Event | None, TensorDictBase, str]] = deque()

    def check(self, metrics: dict[str, Tensor], batch: TensorDictBase, of: str = "") -> None:
        """Queue the metrics of an update; raise ``NonFiniteLossError`` if those of ``lag`` updates ago are not finite.

        The loss alone is no proof: two-hot targets are clamped, so an infinite reward only makes the loss large.
        ``of`` are words of the error message after "The loss", such as " of the actor's update".
        """
        watched = [
            value
            for name, value in metrics.items()
            if name in ("loss", "reward_error") or name.startswith("gradient_norm/")
        ]
        finite = torch.stack(watched).isfinite().all()
        copied: torch.cuda.Event | None = None
        if finite.is_cuda:  # copied asynchronously, so that reading it does not wait for later kernels
            stream, copied = torch.cuda.current_stream(finite.device), torch.cuda.Event()
            finite = finite.to("cpu", non_blocking=True)
            copied.record(stream)
        self._pending.append((finite, copied, batch, of))
        self.settle(self._lag)

    def settle(self, lag: int = 0) -> None:
        """Check all pending updates but the latest ``lag``; raise ``NonFiniteLossError`` for the first bad one."""
        while len(self._pending) > lag:
            finite, copied, batch, of = self._pending.popleft()
            if copied is not None:
                copied.synchronize()
            if not finite:
                raise NonFiniteLossError(batch, of)


Step = Callable[[TensorDictBase], dict[str, Tensor]]
"""Function that computes the losses of a batch ``[B, T]`` and their gradients, and returns scalars by name."""
WARMUPS = 3
"""Calls of a step before its capture, in which libraries allocate memory and choose kernels."""


class GraphedStep:
    """Replays a step as one CUDA graph, captured at the first call.

    The step must not wait for the device. Gradients live in the graph's memory and are overwritten at every replay:
    ``.grad`` must not be set to None between calls.

    Args:
        step: Function to capture.
        module: Module whose gradients and buffers the step writes; the buffers are restored after the warm-up.

    Raises:
        ValueError: At a call, if the shape of the batch is not that of the first.
    """

    def __init__(self, step: Step, module: nn.Module) -> None:
        self._step = step
        self._module = module
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Run the step on a batch ``[B, T]`` on the CUDA device; return copies of the scalars."""
        with torch.cuda.device(batch.device):  # streams and graphs belong to the current device
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
        # The warm-up must change neither random generators nor buffers, because a resumed run repeats it.
        with torch.random.fork_rng(devices=[batch.device]), torch.cuda.stream(side):
            for _ in range(WARMUPS):
                self._module.zero_grad(set_to_none=True)
                self._step(self._batch)
        torch.cuda.current_stream().wait_stream(side)
        for name, buffer in self._module.named_buffers():
            buffer.copy_(buffers[name])
        self._module.zero_grad(set_to_none=True)
        graph = torch.cuda.CUDAGraph()
        # Thread-local, because threads that prefetch samples may use the device meanwhile.
        with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
            metrics = self._step(self._batch)
        self._names, self._scalars = list(metrics), [value.detach() for value in metrics.values()]
        self._graph = graph
        return graph
