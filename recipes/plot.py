"""Draw the paper's figures from what runs have stored: no simulator, no network, no GPU.

    python recipes/plot.py runs=runs/my_experiment
    python recipes/plot.py runs='runs/*_kidney_*' figure=learning_curves quantities=[return,success_rate] aggregate=iqm

Runs of one algorithm, track and variant become one curve if they differ in their seeds alone; others are refused with
the settings in which they differ. Runs that cannot be read are left out, and named in the figure. `learning_curves.csv`
beside a figure holds what it shows, and `runs=learning_curves.csv` draws it again.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import hydra
from command_line import plain_errors, start_logging
from omegaconf import DictConfig, OmegaConf
from schema import PlotConfig, register

from dreamer_racing.checkpoint import ensure_writable
from dreamer_racing.comparison import COLUMNS, WALL_CLOCK, compare_variants, comparison_table, plot_comparison
from dreamer_racing.curves import LearningCurves, learning_curves, read_curves, wanted_columns, write_curves
from dreamer_racing.dreams import Dream, dream_video
from dreamer_racing.envs.tracks import load_track
from dreamer_racing.figures import Flight, plot_dreams, plot_flights, plot_learning_curves
from dreamer_racing.flights import read_trajectory
from dreamer_racing.recording import write_gif, write_video
from dreamer_racing.runs import RunData, evaluation_files, evaluation_score, find_runs, first_of_each_curve, read_runs

register()

VIDEO_SLOWER = 2  # than the flight, so that one can look


@hydra.main(version_base="1.3", config_path="config", config_name="plot")
def main(config: DictConfig) -> None:
    """Make the figures asked for, say what was left out."""
    start_logging()
    with plain_errors():
        draw(cast(PlotConfig, OmegaConf.to_object(config)))


def draw(config: PlotConfig) -> None:
    """Make one figure, or all for which there is something to draw.

    Raises:
        ValueError: bad setting, nothing to draw, or runs that do not belong into one curve.
    """
    if config.figure != "all" and config.figure not in FIGURES:
        raise ValueError(f"figure={config.figure}: there are {', '.join(FIGURES)} and all.")
    wanted_columns(config.quantities)
    output = ensure_writable(config.output)
    places = config.runs if isinstance(config.runs, list) else [config.runs]
    if [Path(str(place)).suffix for place in places] == [".csv"]:
        draw_curves(read_curves(places[0]), output)
        return
    explicit = config.figure != "all" and (config.flights or config.dreams)
    columns = {*wanted_columns(config.quantities), *(column for _, column in COLUMNS.values()), WALL_CLOCK}
    runs, problems = ([], []) if explicit else read_runs(find_runs(places), columns)
    for problem in problems:
        print(f"warning: {problem}")
    for name, figure in FIGURES.items():
        if config.figure in (name, "all"):
            made = figure(config, output, runs, problems)
            if not made and config.figure == name:
                raise ValueError(f"figure={name}: none of these runs has stored anything for it.")
            print(f"{name + ':':<17} {', '.join(made) or 'none of these runs has stored anything for it'}")


def draw_learning_curves(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> list[str]:
    """Make `learning_curves.png` and `.csv`."""
    curves = learning_curves(runs, config.quantities, config.aggregate.value, config.window, problems)
    write_curves(output / "learning_curves.csv", curves)
    return [*draw_curves(curves, output), "learning_curves.csv"]


def draw_curves(curves: LearningCurves, output: Path) -> list[str]:
    """Make `learning_curves.png`."""
    plot_learning_curves(curves, output / "learning_curves.png")
    return ["learning_curves.png"]


def draw_imagined(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> list[str]:
    """Make a grid, a video and a small GIF of three stages of training of each curve's first seed that has dreams."""
    stages = {"imagined": config.dreams} if config.dreams else dict(dreaming_runs(runs))
    made = []
    for name, files in stages.items():
        dreams = [(stage_name(file), Dream.load(file)) for file in files]
        plot_dreams(dreams, output / f"{name}.png")
        fps, film = 1 / (VIDEO_SLOWER * dreams[0][1].frame_dt), dream_video(dreams)
        write_video(output / f"{name}.mp4", film, fps=fps, scale=2)
        write_gif(output / f"{name}.gif", film, fps=fps)
        made += [f"{name}.png", f"{name}.mp4", f"{name}.gif"]
    return made


def dreaming_runs(runs: list[RunData]) -> Iterator[tuple[str, list[Path]]]:
    """Choose the first, the middle and the last dream of the runs that have three or more, or what there is."""
    for run in first_of_each_curve(runs):
        files = list(evaluation_files(run.directory, "_dream.npz").values())
        if files:
            chosen = {files[0]: None, files[len(files) // 2]: None, files[-1]: None}
            yield f"imagined_{run.name}", list(chosen)


def draw_trajectories(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> list[str]:
    """Make `trajectories.png` of the files named, or of one evaluation of each curve's first seed."""
    flights = [named_flight(file) for file in config.flights or chosen_flights(runs, config.flight)]
    if not flights:
        return []
    plot_flights(flights, output / "trajectories.png", config.over)
    return ["trajectories.png"]


def chosen_flights(runs: list[RunData], which: str) -> Iterator[Path]:
    """Choose the last or the best flight of the first seed of each curve.

    Raises:
        ValueError: neither of them is asked for.
    """
    if which not in ("last", "best"):
        raise ValueError(f"flight={which}: there are last and best.")
    for run in first_of_each_curve(runs):
        files = evaluation_files(run.directory, "_trajectory.csv")
        if files:
            best = max(files, key=lambda env_steps: evaluation_score(run.directory, env_steps))
            yield files[best if which == "best" else max(files)]


def named_flight(file: str | Path) -> Flight:
    """Read a flight with its track; the run's and the evaluation's names are its title."""
    trajectory, track = read_trajectory(file)
    run = Path(file).absolute().parent.parent.name
    return Flight(f"{run}, {stage_name(file)}", load_track(track), trajectory)


def stage_name(file: str | Path) -> str:
    """Say after how many env_steps an evaluation was made, if its file does."""
    name = Path(file).stem.rpartition("_")[0]
    return f"{int(name):,} env_steps" if name.isdigit() else name.replace("_", " ")


def draw_comparison(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> list[str]:
    """Make `comparison.md` and `comparison.png`, if there are variants to compare."""
    results = compare_variants(runs) if runs else []
    if len(results) < 2:
        return []
    (output / "comparison.md").write_text(comparison_table(results), encoding="utf-8")
    plot_comparison(results, output / "comparison.png")
    return ["comparison.md", "comparison.png"]


FIGURES: dict[str, Callable[[PlotConfig, Path, list[RunData], list[str]], list[str]]] = {
    "learning_curves": draw_learning_curves,
    "imagined": draw_imagined,
    "trajectories": draw_trajectories,
    "comparison": draw_comparison,
}


if __name__ == "__main__":
    main()
