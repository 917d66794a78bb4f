"""On what a recipe computes."""

import torch

from dreamer_racing.settings import suggestion


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
        if "device type at start of device string" in str(error):  # torch names twenty more, for other machines
            word = device.partition(":")[0]
            meant = " (did you mean cuda?)" if word == "gpu" else suggestion(word, ("auto", "cpu", "cuda"))
            raise ValueError(f"device={device}: there are auto, cpu, cuda and cuda:1 ...{meant}.") from error
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
