"""Choice of the device and of mixed precision."""

import math
import time

import torch

from dreamer_racing.settings import suggestion


def choose_device(device: str, setting: str = "device") -> torch.device:
    """Return the device of a name; `auto` is CUDA if available, else the CPU.

    Raises:
        ValueError: This machine has no such device; the message names the setting that asks for it.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(device)
        torch.empty(1, device=chosen)
    except (RuntimeError, AssertionError) as error:
        if "device type at start of device string" in str(error):  # torch lists twenty more types
            word = device.partition(":")[0]
            meant = " (did you mean cuda?)" if word == "gpu" else suggestion(word, ("auto", "cpu", "cuda"))
            raise ValueError(f"{setting}={device}: there are auto, cpu, cuda and cuda:1 ...{meant}.") from error
        available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
        raise ValueError(
            f"{setting}={device}: {str(error).splitlines()[0].rstrip('.')}. This machine has: {', '.join(available)}; "
            f"{setting}=auto chooses the best."
        ) from error
    return chosen


WORTH_ROUNDING = 1.2
"""Smallest speed-up over float32 at which bfloat16 is used [choice]; measured CPUs are at 0.5 or at 2 and more."""


def choose_mixed_precision(device: torch.device) -> tuple[bool, str]:
    """Return whether to use mixed precision (bfloat16) on a device, and why."""
    if not computes_bfloat16(device):
        return False, f"this {device.type} device does not compute in bfloat16"
    if device.type == "cuda":
        return True, "this cuda device computes in bfloat16"
    speed = bfloat16_speed()
    return speed > WORTH_ROUNDING, f"this {device.type} device multiplies {speed:.1f} times as fast in bfloat16"


def computes_bfloat16(device: torch.device) -> bool:
    """Return whether a device has bfloat16 instructions; on a CPU they are not always faster than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def bfloat16_speed() -> float:
    """Return the speed-up of bfloat16 over float32 of a timed matrix product on this CPU.

    Intel's `avx512_bf16` without AMX takes twice as long as float32, AMD's half as long.
    """
    factors = {kind: torch.ones(256, 256, dtype=kind) for kind in (torch.float32, torch.bfloat16)}
    seconds = dict.fromkeys(factors, math.inf)
    for _ in range(200):  # short products, so that some are not interrupted by other processes
        for kind, factor in factors.items():
            start = time.perf_counter()
            torch.mm(factor, factor)
            seconds[kind] = min(seconds[kind], time.perf_counter() - start)
    return seconds[torch.float32] / seconds[torch.bfloat16]
