"""An agent of losses and a reward of one's own, which lie in another folder than one starts the next recipe from."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.running_recipes import ROOT, TINY, UNDRAWN, recipe


def written(page: str) -> list[str]:
    """The Python that a page writes."""
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.M | re.S)


LARGER = (ROOT / "examples" / "losses" / "overshooting.py").read_text(encoding="utf-8")
LOSSES, REWARDS = "\n\n".join([*written("losses.md"), LARGER]), "\n\n".join(written("own_rewards.md")[:-1])
OVERRIDES = [
    "loss.world_model=reconstruction+my_losses:Overshooting",
    "loss.actor=my_losses:smooth_reinforce",
    "env.reward=my_rewards:smooth",
]


@pytest.mark.slow
def test_an_agent_of_own_losses_is_evaluated_flown_exported_and_drawn_from_elsewhere(tmp_path: Path) -> None:
    home, elsewhere, run = tmp_path / "home", tmp_path / "elsewhere", tmp_path / "run"
    home.mkdir()
    elsewhere.mkdir()
    (home / "my_losses.py").write_text(LOSSES)
    (home / "my_rewards.py").write_text(REWARDS)
    overrides = [*TINY, "tuned=none", *OVERRIDES, f"run_dir={run}", "evaluation.every=100"]
    trained = recipe("dreamer_v3", *overrides, cwd=home, before=UNDRAWN)
    assert trained.returncode == 0, trained.stderr
    assert "my_losses:Overshooting" in (run / "config.yaml").read_text()
    assert "reward: my_rewards:smooth, minus the curriculum's penalty of body rates" in trained.stdout
    lost = recipe("evaluate", f"checkpoint={run}", "episodes=1", cwd=elsewhere)
    assert lost.returncode == 2 and f"there is no my_losses.py in {elsewhere}" in lost.stderr
    assert "set PYTHONPATH to that folder" in lost.stderr
    path = f"import sys; sys.path.append({str(home)!r})"  # what PYTHONPATH does
    for name, *overrides in (
        ("evaluate", f"checkpoint={run}", "episodes=1", "video_steps=5"),
        ("fly", f"agent={run}", f"run_dir={elsewhere / 'flight'}"),
        ("export", f"checkpoint={run}", f"output={elsewhere / 'export' / 'actor.onnx'}"),
        ("plot", f"runs={run}", f"output={elsewhere / 'figures'}"),
    ):
        done = recipe(name, *overrides, cwd=elsewhere, before=path)
        assert done.returncode == 0, f"{name}: {done.stderr}"
    assert json.loads((run / "evaluation" / "evaluation.json").read_text())["deterministic"]["num_episodes"] == 1
    assert list((elsewhere / "flight").rglob("*trajectory.csv"))
    assert (elsewhere / "export" / "actor.onnx").is_file()
    assert (elsewhere / "figures" / "learning_curves.png").is_file()
