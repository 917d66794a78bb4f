"""Every warp kernel that a control step launches compiles for a GPU, which needs none, nor a driver."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.simulator.looks import load_looks
from dreamer_racing.envs.simulator.mujoco_warp import WarpSimulator
from dreamer_racing.envs.simulator.warp_device import load_warp
from dreamer_racing.envs.tracks import load_track

ARCHITECTURE = 90  # of an H100 or H200


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that MuJoCo's warp port chooses for a GPU instead of a CPU, if there are any, are not among them."""
    warp = load_warp()
    for looks in ("nominal", "randomised"):
        generator = torch.Generator().manual_seed(0)
        simulator = WarpSimulator(
            load_track("kidney"), PRESETS["faithful"], 2, device="cpu", generator=generator, looks=load_looks(looks)
        )
        simulator.step(torch.zeros(2, 4))
        simulator.render()
    ran = {name: module for name, module in warp._src.context.user_modules.items() if module.execs}
    for wanted in ("push", "settle", "_render_megakernel", "forward", "smooth"):
        assert any(wanted in name for name in ran), f"{wanted} was not launched, so the test would not see it"
    monkeypatch.setattr(warp.config, "optimization_level", 0)  # whether it compiles is known before any of it
    for name, module in ran.items():
        folder = tmp_path / name
        warp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=folder, use_ptx=True)
        compiled = [file.read_text() for file in folder.glob("*.ptx")]
        assert compiled and all(f".target sm_{ARCHITECTURE}" in text for text in compiled), name
