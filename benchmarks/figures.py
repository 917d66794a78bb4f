"""How long the figures of a whole comparison take: algorithms x tracks x seeds, from stored files alone.

    python benchmarks/figures.py --json results/figures.json

The files are synthetic: as many rows and columns as a run of 20 million steps logs, the scripted pilot's flights, and
noise for images. `s` is the wall clock of the recipe as a user starts it, its imports included, and `cpu_s` what it
took of the processor, which other load hardly changes.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from measuring import print_table, write_json

from dreamer_racing.envs.race.pilot import PilotPolicy, ScriptedPilot
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.dreams import PREDICTED_FRAMES, SEEN_FRAMES, Dream
from dreamer_racing.evaluation.evaluate import Trajectory, evaluate
from dreamer_racing.evaluation.trajectory import write_trajectory
from dreamer_racing.training.directory import RunDirectory

ALGORITHMS, TRACKS = ("dreamer_v3", "ppo", "sac"), ("circle", "kidney", "figure8")
SKILL = {"dreamer_v3": 1.0, "ppo": 0.1, "sac": 0.05}
COLUMNS = 64  # of metrics.csv
FIGURES = {
    "learning_curves, mean": ("figure=learning_curves", "aggregate=mean"),
    "learning_curves, iqm": ("figure=learning_curves", "aggregate=iqm"),
    "imagined": ("figure=imagined",),
    "trajectories": ("figure=trajectories",),
    "all": ("figure=all",),
}
QUANTITIES = "quantities=[return,success_rate,gates,lap_time]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--env-steps", type=int, default=20_000_000)
    parser.add_argument("--rows", type=int, default=10_000, help="of every metrics.csv")
    parser.add_argument("--keep", help="new folder to leave runs and figures in")
    parser.add_argument("--json", help="file to write")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or temporary
        write_runs(Path(folder) / "runs", arguments.seeds, arguments.env_steps, arguments.rows)
        records = [measure(Path(folder), name, options) for name, options in FIGURES.items()]
    setting = {name: getattr(arguments, name) for name in ("seeds", "env_steps", "rows")}
    runs = len(ALGORITHMS) * len(TRACKS) * arguments.seeds
    records = [{"benchmark": "figures", "runs": runs, **setting, **record} for record in records]
    print_table(records, ("figure", "runs", "rows", "s", "cpu_s"))
    write_json(records, arguments.json)


def measure(folder: Path, name: str, options: tuple[str, ...]) -> dict[str, float | str]:
    """Time one call of the recipe."""
    recipe = Path(__file__).parents[1] / "recipes" / "plot.py"
    command = [sys.executable, str(recipe), "runs=runs", f"output=figures/{name.split(',')[0]}", QUANTITIES, *options]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"figure": name, "s": seconds, "cpu_s": cpu}


def write_runs(folder: Path, seeds: int, env_steps: int, rows: int) -> None:
    """Write runs whose returns rise to 60, on a schedule of their own, with the noise of training."""
    for number, (algorithm, track) in enumerate((a, t) for a in ALGORITHMS for t in TRACKS):
        for seed in range(seeds):
            run = folder / f"{algorithm}_{track}_paper_seed{seed}"
            write_run(
                RunDirectory(run), np.random.default_rng(100 * number + seed), algorithm, track, seed, env_steps, rows
            )


def write_run(
    run: RunDirectory, generator: np.random.Generator, algorithm: str, track: str, seed: int, env_steps: int, rows: int
) -> None:
    """Write configuration, metrics and what three evaluations leave."""
    run.path.mkdir(parents=True)
    config = {
        "algorithm": algorithm,
        "track": track,
        "seed": seed,
        "run_dir": str(run.path),
        "curriculum": {"increment": 0.001},
    }
    run.config.write_text(yaml.safe_dump(config))
    steps = np.linspace(0, env_steps, rows + 1)[1:]
    names = ["episode/return", "evaluation/success_rate", "evaluation/gates_per_episode", "evaluation/lap_time_mean"]
    skill = 1 / (1 + np.exp(-(steps / env_steps - generator.uniform(0.2, 0.4)) * 15)) * SKILL[algorithm]
    noise = generator.normal(size=(rows, COLUMNS))
    noise[:, 0] = 60 * skill - 4 * (1 - skill) + 3 * noise[:, 0]
    noise[:, 1:4] = np.stack((skill, 18 * skill, 6 - 2 * skill), axis=1)
    cells = np.char.mod("%.8g", noise)
    cells[np.arange(rows) % 12 != 0, 1:4] = ""  # an evaluation every 12 rows
    weight = np.char.mod("%.8g", 0.001 * np.floor(10 * skill))
    header = ["env_steps", "curriculum/body_rate_weight", *names, *(f"other/{i}" for i in range(COLUMNS - 4))]
    lines = [",".join(row) for row in np.column_stack((np.char.mod("%d", steps), weight, cells))]
    run.metrics.write_text("\n".join([",".join(header), *lines]) + "\n")
    for share in (0.02, 0.5, 1.0):
        stem = run.evaluations / f"{int(share * env_steps):09d}"
        write_trajectory(f"{stem}_trajectory.csv", flight(track), track)
        if algorithm == "dreamer_v3":
            images = generator.integers(0, 256, (3, 1, SEEN_FRAMES + PREDICTED_FRAMES, 64, 64, 3), dtype=np.uint8)
            Dream(images[0], images[1], images[2], SEEN_FRAMES, 0.08).save(f"{stem}_dream.npz")


@cache
def flight(track: str) -> Trajectory:
    """Let the scripted pilot fly the track's laps."""
    env = DroneRacingEnv(track, 1, from_pixels=False, evaluation=True, seed=0)
    result = evaluate(env, PilotPolicy(ScriptedPilot(env.track, env.worlds.parameters)), episodes=1)
    env.close()
    return result.trajectories[0]


if __name__ == "__main__":
    main()
