"""What every recipe does around its own work: plain errors for bad input, logging, device choice, run directories."""

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import torch
from omegaconf.errors import MissingMandatoryValue
from torchrl.checkpoint import CheckpointError

CONFIG_DIR = Path(__file__).parents[1] / "config"


@contextmanager
def plain_errors() -> Iterator[None]:
    """Turn errors that a person can mend into one paragraph on stderr and exit status 2.

    Wrap set-up only: the same error types inside training are defects, and keep their tracebacks.
    """
    try:
        yield
    except MissingMandatoryValue as error:
        print(f"error: {error.full_key}= is missing, and there is no default.", file=sys.stderr)
        raise SystemExit(2) from error
    except (ValueError, OSError, CheckpointError, RendererError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error


def _renderer_error() -> type[Exception]:
    from dreamer_racing.envs.simulator.opengl import RendererUnavailableError

    return RendererUnavailableError


RendererError = _renderer_error()


def start_logging() -> None:
    """Show what the package chose and why, one line each."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stdout, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.INFO)
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def choose_device(device: str) -> torch.device:
    """Resolve `auto`, and refuse a device that is not there.

    Raises:
        ValueError: not a device of this machine.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(device)
        torch.empty(1, device=chosen)
    except (RuntimeError, AssertionError) as error:
        available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
        raise ValueError(
            f"device={device}: {str(error).splitlines()[0].rstrip('.')}. This machine has: {', '.join(available)}; "
            "device=auto takes the best."
        ) from error
    return chosen


def computes_bfloat16(device: torch.device) -> bool:
    """Whether a device multiplies in bfloat16 natively, rather than slowly by way of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def new_run_dir(recipe: str, track: str) -> Path:
    """A fresh folder name below `runs/`."""
    return Path("runs") / f"{recipe}_{Path(track).stem}_{datetime.now():%Y%m%d-%H%M%S}"


def override_key(override: str) -> str:
    """The setting that an override is of."""
    return override.partition("=")[0].lstrip("+~")


def merge_overrides(saved: Sequence[str], given: Sequence[str]) -> list[str]:
    """Overrides of a run that is continued: those it was started with, replaced by the ones given now."""
    replaced = {override_key(override) for override in given}
    return [override for override in saved if override_key(override) not in replaced] + list(given)
