"""In what a recipe computes: measured, since a list of instructions does not say how fast they are."""

import time

import pytest
import torch

from dreamer_racing import devices

INSTRUCTIONS = {"avx512_bf16": True, "amx_bf16": False}


@pytest.mark.parametrize("slow", [torch.float32, torch.bfloat16])
def test_a_cpu_computes_in_bfloat16_where_that_is_faster(slow: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    def as_slow_as_said(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        time.sleep(0.001 if left.dtype == slow else 0.0)
        return left

    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: INSTRUCTIONS)
    monkeypatch.setattr(torch, "mm", as_slow_as_said)
    chosen, reason = devices.choose_mixed_precision(torch.device("cpu"))
    assert chosen == (slow is torch.float32)
    assert "times as fast in bfloat16" in reason


def test_a_cpu_without_instructions_for_bfloat16_does_not_compute_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    chosen = devices.choose_mixed_precision(torch.device("cpu"))
    assert chosen == (False, "this cpu device does not compute in bfloat16")
