"""Stops training at the first loss, gradient or reward that is not finite, without waiting for the device."""

from __future__ import annotations

from collections import deque

import torch
from tensordict import TensorDictBase
from torch import Tensor


class NonFiniteLossError(RuntimeError):
    """The loss, its gradient or a reward became infinite or not a number.

    Attributes:
        batch: What it was computed of: an update's batch ``[B, T]``, or what the actor's loss keeps for improvements.
    """

    def __init__(self, batch: TensorDictBase, of: str = "") -> None:
        super().__init__(
            f"The loss{of}, its gradient or a reward is not finite: the learning rate may be too high, or a reward or "
            "observation is bad."
        )
        self.batch = batch


class Flag:
    """A truth value on its way from the device, so that reading it later waits for nothing that came after it.

    Args:
        value: bool, a scalar.
    """

    def __init__(self, value: Tensor) -> None:
        self._value = value.to("cpu", non_blocking=True)
        self._arrived: torch.cuda.Event | None = None
        if value.is_cuda:
            self._arrived = torch.cuda.Event()
            self._arrived.record(torch.cuda.current_stream(value.device))

    def __bool__(self) -> bool:
        """Wait until it is here."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return bool(self._value)


class FiniteGuard:
    """Raises once an update would spoil the networks.

    Args:
        lag: Updates after which one is looked at: 0 at once, which waits for the device.
    """

    def __init__(self, lag: int) -> None:
        self._lag = lag
        self._pending: deque[tuple[Flag, TensorDictBase, str]] = deque()

    def check(self, metrics: dict[str, Tensor], batch: TensorDictBase, of: str = "") -> None:
        """Take note of an update's metrics; raise ``NonFiniteLossError`` if those ``lag`` updates ago were bad.

        The loss alone does not tell: two-hot targets are clamped, so that an infinite reward makes it merely large.

        Args:
            metrics: Scalars by name.
            batch: What they are of.
            of: Whose loss it is, as the error says it; the update's if empty.
        """
        watched = [
            value
            for name, value in metrics.items()
            if name in ("loss", "reward_error") or name.startswith("gradient_norm/")
        ]
        self._pending.append((Flag(torch.stack(watched).isfinite().all()), batch, of))
        self.settle(self._lag)

    def settle(self, lag: int = 0) -> None:
        """Look at all updates but the latest ``lag``; raise ``NonFiniteLossError`` at the first that was bad."""
        while len(self._pending) > lag:
            finite, batch, of = self._pending.popleft()
            if not finite:
                raise NonFiniteLossError(batch, of)
