"""Fly a trained policy and measure how well it races.

    python recipes/evaluate.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 episodes=100
    python recipes/evaluate.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 protocol=full
    python recipes/evaluate.py checkpoint=agents/kidney

Flies the deterministic and the stochastic policy from the start pose for the track's laps, prints both, and writes
evaluation.json beside plots, videos and the numbers of each episode. protocol=full does it under every condition of
docs/evaluation.md, with easy and faithful physics and the agent's own, and adds evaluation.md. An earlier evaluation is
never overwritten.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from composing.building import shared_env_arguments
from composing.entry import plain_disk_errors, plain_errors, recipe
from composing.restoring import FlightConfig, Restored, restore

from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.evaluation.protocol import CONDITIONS, EPISODES, MODES, Result, check_protocol, run_protocol
from dreamer_racing.figures.protocol import write_markdown
from dreamer_racing.figures.report import EvaluationReport, report_condition
from dreamer_racing.settings import COUNT, NOT_NEGATIVE, SEED, check_choice, setting
from dreamer_racing.terminal import say
from dreamer_racing.training.directory import EVALUATION, RunDirectory, fresh_directory, replace_text

PROTOCOLS = ("nominal", "full")


@dataclass
class EvaluateConfig(FlightConfig):
    """Configuration of `recipes/evaluate.py`."""

    protocol: str = "nominal"  # nominal | full: every condition of docs/evaluation.md, with several physics
    # with protocol=nominal: noise of starts, as a multiple of the noise of training
    start_noise: float = setting(0.0, NOT_NEGATIVE)
    run_dir: str | None = None  # null: <run of the checkpoint>/evaluation
    video_steps: int = setting(500, COUNT)
    seed: int = setting(1, SEED)  # of starts and drones; evaluations in training use 0

    def check(self) -> None:
        """Refuse an unknown protocol, and noise that would be ignored."""
        check_choice("protocol", self.protocol, PROTOCOLS)
        if self.protocol == "full" and self.start_noise:
            raise ValueError(
                f"start_noise={self.start_noise} is for protocol=nominal: protocol=full has noise among its conditions."
            )


@recipe("evaluate", EvaluateConfig)
def main(config: EvaluateConfig) -> None:
    """Restore the policy, fly it, report."""
    with plain_errors():
        restored = restore(config)
        track = restored.trained.saved_track()
        if config.protocol == "full":
            env = restored.trained.env
            check_protocol(CONDITIONS, track, config.seed, env.preset, env.control_rate)
        else:
            StartSampler(track, start_noise=config.start_noise)  # refuses noise that the track leaves no room for
        directory = fresh_directory(config.run_dir or RunDirectory(restored.run_dir).evaluation, EVALUATION)
        print(f"race: {restored.trained.track}, {restored.trained.env.preset}, {config.episodes} episodes")
        report = None
        if config.protocol == "nominal":
            worlds = {**shared_env_arguments(restored.trained), "start_noise": config.start_noise}
            report = EvaluationReport(
                directory, restored.flyer, worlds, config.episodes, config.video_steps, config.num_envs, config.seed
            )
    with plain_disk_errors():
        if report:
            written = evaluate_nominal(report)
        else:
            results = evaluate_fully(config, restored, directory)
            written = describe(results, restored.trained.env.preset)
        written["provenance"] = restored.provenance(config)
        written["provenance"]["start_noise"] = config.start_noise
        if not report:
            write_markdown(directory, results, written["provenance"])
        replace_text(directory / EVALUATION, json.dumps(written, indent=2, allow_nan=False) + "\n")
    say(f"\nwritten to {directory}")


def evaluate_nominal(report: EvaluationReport) -> dict[str, Any]:
    """Fly the policy deterministically and stochastically; return the statistics of each for evaluation.json."""
    written: dict[str, Any] = {}
    for name in MODES:
        result = report.evaluate(deterministic=name == "deterministic")
        report.write(name, result)
        written[name] = result.to_dict()
        say(f"\n{name} policy, {len(result.episodes)} episodes\n{result.summary()}")
    report.close()
    return written


def evaluate_fully(config: EvaluateConfig, restored: Restored, directory: Path) -> list[Result]:
    """Fly the policy under all conditions and write each one's episodes, plot and, for some, video."""
    if config.episodes < EPISODES:
        print(f"note: the protocol asks for {EPISODES} episodes of each condition; episodes={config.episodes}")
    trained = restored.trained
    policy, worlds = restored.flyer.evaluation_policy(), shared_env_arguments(trained)
    results = []
    for result in run_protocol(policy, worlds, config.episodes, num_envs=config.num_envs, seed=config.seed):
        results.append(result)
        say(f"\n{result.preset}, {result.condition}, {result.mode} policy\n{result.evaluation.summary()}")
        if result.preset == Path(trained.env.preset).name:
            report_condition(RunDirectory(directory), result, config.video_steps)
        path = RunDirectory(directory).evaluations / f"{result.name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(result.evaluation.to_json())
    return results


def describe(results: list[Result], preset: str) -> dict[str, Any]:
    """Return the contents of evaluation.json: the nominal race as with protocol=nominal, and all conditions."""
    own = [result for result in results if result.preset == Path(preset).name and result.condition == "nominal"]
    nominal = {result.mode: result.evaluation.to_dict() for result in own}
    return {**nominal, "conditions": [result.to_dict() for result in results]}


if __name__ == "__main__":
    main()
