"""Counter of the kernels, synchronisations and device mismatches that code would cause on a CUDA device.

It intercepts torch's dispatcher, and runs on a CPU: the operations are the same, and the name and arguments of each
tell what it would do on a CUDA device.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

FREE = frozenset((
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "chunk", "detach", "diagonal", "expand",
    "lift_fresh", "permute", "real", "reshape", "select", "slice", "split", "split_with_sizes", "squeeze", "t",
    "transpose", "unbind", "unfold", "unsafe_split", "unsqueeze", "view", "view_as",
    "_record_function_enter_new", "_record_function_exit", "empty", "empty_like", "empty_permuted",
    "empty_strided", "new_empty", "new_empty_strided", "record_stream", "resize_", "set_",
))  # fmt: skip
"""Operations that only make views of memory, allocate it, record its use, or mark a profiler's range."""
WAITS = frozenset((
    "_local_scalar_dense", "_unique2", "bincount", "equal", "is_nonzero", "item", "masked_select", "nonzero",
    "unique_consecutive", "unique_dim",
))  # fmt: skip
"""Operations that make the CPU wait for a result or its size."""
INDEXED = frozenset((
    "_index_put_impl_", "_unsafe_index", "_unsafe_index_put", "index", "index_put", "index_put_",
))  # fmt: skip
COPIES = frozenset(("_to_copy", "copy_"))
MACHINERY = ("/torch/", "/tensordict/", "/contextlib", __file__)


class Launches(TorchDispatchMode):
    """Context that counts operations that launch kernels, and lists those that would stall or fail on CUDA.

    A fused or ``foreach`` operation counts once for any number of tensors; so does a matrix product or a reduction, for
    which a library may launch two kernels.

    Attributes:
        kernels: Number of operations by name.
        waits: Places where the CPU would wait for the device, as ``operation at file:line``.
        mixed: Places where an operation has tensors on several devices, or copies between devices; likewise.
    """

    def __init__(self) -> None:
        super().__init__()
        self.kernels: Counter[str] = Counter()
        self.waits: list[str] = []
        self.mixed: list[str] = []

    @property
    def count(self) -> int:
        """Total number of kernels."""
        return self.kernels.total()

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Record one operation, and run it."""
        kwargs = kwargs or {}
        name = func._schema.name.partition("::")[2]
        tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
        indices = tree_leaves(args[1]) if name in INDEXED else []
        masks = [value for value in indices if isinstance(value, Tensor) and value.dtype in (torch.bool, torch.uint8)]
        if name in WAITS or masks:  # how many elements a mask selects is waited for
            self.waits.append(_place(name))
        elif name not in FREE:
            self.kernels[name] += 1
        result = func(*args, **kwargs)
        if name in COPIES:
            tensors += [value for value in tree_leaves(result) if isinstance(value, Tensor)]
        # Scalars on the CPU fit any device.
        if len({value.device.type for value in tensors if value.ndim or value.device.type != "cpu"}) > 1:
            self.mixed.append(_place(name))
        return result


def _place(name: str) -> str:
    """Return an operation and the innermost line outside of torch and tensordict that called it."""
    stack = traceback.extract_stack()
    frame = [frame for frame in stack if not any(part in frame.filename for part in MACHINERY)][-1]
    return f"{name} at {'/'.join(frame.filename.split('/')[-2:])}:{frame.lineno}"


def launches(function: Callable[[], Any]) -> Launches:
    """Call a function, and return the record of its operations."""
    with Launches() as seen:
        function()
    return seen
