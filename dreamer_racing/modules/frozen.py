"""Networks that gradient flows through, but not into."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Let gradient flow through modules but not into their parameters, nor what stands for these (``cast_once``)."""
    layers = {layer: None for module in modules for layer in module.modules()}
    held = [
        (layer, name, parameter)
        for layer in layers
        for name, parameter in layer._parameters.items()
        if parameter is not None and parameter.requires_grad
    ]
    for layer, name, parameter in held:
        layer._parameters[name] = parameter.detach()  # type: ignore[assignment]  # no parameter, but in its place
    try:
        yield
    finally:
        for layer, name, parameter in held:
            layer._parameters[name] = parameter
