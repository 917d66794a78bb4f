"""Evaluations by returns: what they depend on, and what not."""

from __future__ import annotations

from pathlib import Path

import torch

from dreamer_racing.envs.control_suite import ControlSuiteEnv
from dreamer_racing.figures.report import ReturnReport
from dreamer_racing.modules import Interface
from tests.dreamers import learner_of


def test_an_evaluation_by_returns_does_not_depend_on_those_before_it(tmp_path: Path) -> None:
    env = ControlSuiteEnv("cartpole_swingup", 2, from_pixels=False, action_repeat=50, seed=4)
    report = ReturnReport(tmp_path, learner_of(interface=Interface.of(env), seed=0), env, episodes=3, seed=4)
    torch.manual_seed(0)  # the model's latents are samples
    first = report.make(0)
    torch.manual_seed(0)
    second = report.make(1)
    report.close()
    assert first == second and first["evaluation/return_std"] > 0, "all episodes were one"
