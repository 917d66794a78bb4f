"""Training on collected steps: epochs of shuffled minibatches, gradient clipping, and control of the KL divergence.

Nothing here waits for a CUDA device. Whether a gradient step is to be made is known there alone: it is made with a mask
that may leave everything as it was, and after too large a divergence the remaining steps of an update are such.

Shape legend: M records of a minibatch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from dreamer_racing import parallel
from dreamer_racing.learners.optimizer import restore
from dreamer_racing.losses.config import PPOUpdateConfig

KL_TOLERANCE = 1.5
"""Factor that a divergence may be off its target. Reference: Schulman et al. 2017, Section 4."""
RATE_CHANGE, SMALLEST_SCALE = 1.25, 0.01
"""Factor by which the learning rate then changes, and its smallest share [choice]."""

MinibatchLoss = Callable[[Tensor], tuple[Tensor, dict[str, Tensor]]]
"""Loss of the records ``(M,)`` at some places, a scalar, and metrics: of a policy ``ppo/kl`` from the one before."""


def masks_steps(device: torch.device) -> bool:
    """Tell whether steps are masked on a device, rather than left out, for which the CPU would have to wait."""
    return device.type == "cuda"


class PPOUpdate:
    """Trains one network on collected steps, with an optimiser of its own.

    Args:
        network: Of the actor, or of a critic.
        learning_rate: Of Adam; the largest, where there is a ``kl_target``.
        config: Epochs, minibatches, clipping and the divergence that ends an update.
        kl_target: Divergence before an update's last gradient step, nats, to which the learning rate is steered; None:
            it stays. May be set between updates.

    Attributes:
        learning_rate_scale: Share of the learning rate that the next update is made at, ``(1,)``.
    """

    def __init__(
        self, network: nn.Module, learning_rate: float, config: PPOUpdateConfig, kl_target: float | None = None
    ) -> None:
        self.network = network
        self.config = config
        self.kl_target = kl_target
        self.device = next(network.parameters()).device
        self.learning_rate_scale = torch.ones(1, device=self.device)
        self._masked = masks_steps(self.device)
        # The fused one takes a mask, and a rate that is a tensor.
        self.optimizer = torch.optim.Adam(
            network.parameters(), lr=learning_rate, eps=1e-5, fused=True if self._masked else None
        )

    def run(self, number: int, loss: MinibatchLoss) -> dict[str, Tensor]:
        """Make the epochs of gradient steps, until one comes upon too large a divergence.

        A step whose gradient is not finite is not made.

        Args:
            number: Of records to learn from.
            loss: Of minibatches of them.

        Returns:
            Means over the gradient steps of what ``loss`` writes, ``loss``, and the gradient's norm before clipping,
            ``gradient_norm``; where it writes ``ppo/kl``, that before the last step, ``ppo/epochs`` and
            ``ppo/learning_rate_scale`` that this update was made at. Scalars.
        """
        if self.kl_target is None:
            self.learning_rate_scale.fill_(1.0)
        scale, group = self.learning_rate_scale.clone(), self.optimizer.param_groups[0]
        rate = group["lr"]
        group["lr"] = rate * (scale if self._masked else float(scale))
        try:
            metrics = self._make_epochs(number, loss)
        finally:
            group["lr"] = rate
        if "ppo/kl" in metrics:
            metrics["ppo/learning_rate_scale"] = scale.squeeze()
            self._control(metrics["ppo/kl"])
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state, and the share of the learning rate."""
        return {"optimizer": self.optimizer.state_dict(), "learning_rate_scale": self.learning_rate_scale.clone()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; learning rates are settings, and stay."""
        restore(self.optimizer, state_dict["optimizer"])
        self.learning_rate_scale.copy_(state_dict["learning_rate_scale"])

    def _make_epochs(self, number: int, loss: MinibatchLoss) -> dict[str, Tensor]:
        minibatches = math.ceil(number / self.config.minibatch)
        active = torch.ones((), dtype=torch.bool, device=self.device)
        done, applied = list[dict[str, Tensor]](), list[Tensor]()
        for _ in range(self.config.epochs):
            # Minibatches differ in size by one at most.
            for chosen in torch.randperm(number, device=self.device).tensor_split(minibatches):
                metrics = self._step(*loss(chosen), active)
                done.append(metrics)
                applied.append(active)
                if "ppo/kl" not in metrics:
                    continue
                active = active & (metrics["ppo/kl"] <= self.config.kl_stop)
                if not self._masked and not active:
                    return _summary(done, applied, minibatches)
        return _summary(done, applied, minibatches)

    def _step(self, loss: Tensor, metrics: dict[str, Tensor], active: Tensor) -> dict[str, Tensor]:
        """Make one gradient step if ``active``, bool, a scalar, unless its gradient is not finite."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if parallel.count() > 1:
            parallel.average_gradients(self.network.parameters())
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.gradient_clip)
        good = norm.isfinite() & active
        if self._masked:
            self.optimizer.found_inf = (~good).float()  # type: ignore[attr-defined]  # what a `GradScaler` tells it
            self.optimizer.step()
        elif good:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return {"loss": loss.detach(), **metrics, "gradient_norm": norm}

    def _control(self, kl: Tensor) -> None:
        """Lower the learning rate after a divergence well above the target; raise it, up to the full one, well below.

        Reference: Schulman et al. 2017, Section 4, who steer the weight of a KL penalty so.
        """
        target, scale = self.kl_target, self.learning_rate_scale
        if target is None:
            return
        lower, higher = (scale / RATE_CHANGE).clamp(min=SMALLEST_SCALE), (scale * RATE_CHANGE).clamp(max=1.0)
        changed = torch.where(kl < target / KL_TOLERANCE, higher, scale)
        scale.copy_(torch.where(kl <= KL_TOLERANCE * target, changed, lower))  # the latter also where it is no number


def _summary(done: list[dict[str, Tensor]], applied: list[Tensor], minibatches: int) -> dict[str, Tensor]:
    """Average over the gradient steps that were ``applied``, bool, scalars; the divergence is that of the last one."""
    mask = torch.stack(applied)
    number = mask.sum()
    values = {name: torch.stack([metrics[name] for metrics in done]) for name in done[0]}
    means = {name: value.where(mask, 0.0).sum() / number for name, value in values.items()}
    if "ppo/kl" not in values:
        return means
    kl = values["ppo/kl"].gather(0, number.unsqueeze(0) - 1).squeeze(0)
    return means | {"ppo/kl": kl, "ppo/epochs": number.to(kl.dtype) / minibatches}
