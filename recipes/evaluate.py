"""Fly a trained policy and measure how well it races.

    python recipes/evaluate.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 episodes=100

Flies the deterministic and the stochastic policy from the start pose for the track's laps, prints both, and writes
evaluation.json beside plots, videos and the episodes' own numbers.
"""

import json
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from arena import is_race, make_report, restore_learner, trained_config
from command_line import choose_device, plain_errors, start_logging
from omegaconf import DictConfig, OmegaConf
from schema import EvaluateConfig, register

from dreamer_racing.checkpoint import ensure_writable, latest_checkpoint
from dreamer_racing.reporting import EvaluationReport

register()


@hydra.main(version_base="1.3", config_path="config", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Restore the policy, fly it both ways, report."""
    start_logging()
    with plain_errors():
        report, directory = build(cast(EvaluateConfig, OmegaConf.to_object(config)))
    results: dict[str, Any] = {}
    for name in ("deterministic", "stochastic"):
        result = report.evaluate(deterministic=name == "deterministic")
        report.write(name, result)
        results[name] = result.to_dict()
        print(f"\n{name} policy, {len(result.episodes)} episodes\n{result.summary()}")
    (directory / "evaluation.json").write_text(json.dumps(results, indent=2))
    print(f"\nwritten to {directory}")
    report.close()


def build(config: EvaluateConfig) -> tuple[EvaluationReport, Path]:
    """Restore the learner of a checkpoint and make the races that its policy is to fly."""
    device = choose_device(config.device)
    checkpoint = latest_checkpoint(config.checkpoint)
    run_dir = checkpoint.parent.parent
    trained = trained_config(run_dir)
    torch.manual_seed(config.seed)
    if not is_race(trained):
        raise ValueError(f"{checkpoint} was trained on {trained.task}; this recipe evaluates races.")
    trained.track, trained.env.preset = config.track or trained.track, config.preset or trained.env.preset
    trained.env.renderer = config.renderer
    learner, counters = restore_learner(trained, checkpoint, device)
    directory = ensure_writable(config.run_dir or run_dir / "evaluation")
    print(f"checkpoint: {checkpoint} ({trained.algorithm}, {counters['env_steps']:,} env_steps)")
    print(f"race: {trained.track}, {trained.env.preset}, {config.episodes} episodes")
    options = {"num_envs": config.num_envs, "seed": config.seed}
    report = make_report(trained, directory, learner, config.episodes, config.video_steps, **options)
    return cast(EvaluationReport, report), directory


if __name__ == "__main__":
    main()
