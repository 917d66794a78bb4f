"""Figures of stored runs, for `recipes/plot.py` and for the end of an experiment."""

import json
import logging
import math
import os
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from dreamer_racing.evaluation.dreams import Dream
from dreamer_racing.evaluation.trajectory import NUMBERS, read_trajectory
from dreamer_racing.figures.comparison import COLUMNS, compare_variants, comparison_table
from dreamer_racing.figures.curves import (
    CURVES,
    curves_file,
    learning_curves,
    read_curves,
    wanted_columns,
    write_curves,
)
from dreamer_racing.figures.drawing import PROFILE_AXES
from dreamer_racing.figures.film import dream_video, write_gif, write_video
from dreamer_racing.figures.flights import NamedFlight, plot_dreams, plot_flights
from dreamer_racing.figures.learning import plot_comparison, plot_learning_curves
from dreamer_racing.figures.runs import RunData, find_runs, first_of_each_curve, group_runs, read_runs
from dreamer_racing.settings import NOT_NEGATIVE, check_choice, check_settings, setting
from dreamer_racing.training.directory import RunDirectory, ensure_writable


class Aggregate(Enum):
    """Aggregate of a learning curve over seeds."""

    mean = "mean"
    iqm = "iqm"


@dataclass
class PlotConfig:
    """Settings of `recipes/plot.py`."""

    # run directory, folder of runs, table metrics*.csv, pattern or list [a,b]; or a learning_curves.csv or its folder
    runs: Any = "runs"
    figure: str = "all"  # learning_curves | imagined | trajectories | comparison | all
    output: str = "figures"  # output folder
    quantities: Any = field(default_factory=lambda: ["return"])  # name or list, see dreamer_racing/figures/curves.py
    aggregate: Aggregate = Aggregate.mean  # mean (and standard deviation) | iqm (and 95 % bootstrap interval)
    axis: str = "env_steps"  # axis of the curves: env_steps | hours (wall clock) | core_hours (CPU time)
    # window of the curves' running mean, in units of their axis; null: 2 % of the longest run
    window: float | None = setting(None, NOT_NEGATIVE)
    flights: Any = field(default_factory=list)  # file *_trajectory.csv or a list; empty: one of each curve's first seed
    flight: str = "last"  # which evaluation of a run to draw: last | best (by gates, then return)
    over: str = "distance"  # axis of the speed profile: distance | time
    dreams: Any = field(default_factory=list)  # file *_dream.npz or a list; empty: first, middle and last of a run


logger = logging.getLogger(__name__)

VIDEO_SLOWER = 2  # slow-motion factor of videos
STORED = ("flight", "deterministic")  # prefixes of the files of recipes/fly.py and recipes/evaluate.py
REASON_LETTERS = 160  # maximum length of the reason why a file cannot be read
T = TypeVar("T")
Drawn = tuple[list[str], list[str]]
"""Names of files in the output folder, none if the runs have no data for the figure, and a line for all left out."""


def draw(config: PlotConfig) -> None:
    """Draw one figure, or all figures with data; if only flight or dream files are given, only their figures.

    Raises:
        ValueError: a setting is invalid, or the requested figure, or none of all figures, can be drawn.
    """
    lists = {name: as_list(getattr(config, name)) for name in ("quantities", "flights", "dreams")}
    config = replace(config, **lists)  # type: ignore[arg-type]
    check_plot(config)
    output = ensure_writable(config.output, "output")
    places = as_list(config.runs)
    if len(places) == 1 and (file := curves_file(places[0])):
        refuse_for_curves(config)
        plot_learning_curves(read_curves(file), output / "learning_curves.png")
        logger.info("learning_curves:  learning_curves.png, with the quantities and statistics of the file")
        return
    named = [name for name, files in (("trajectories", config.flights), ("imagined", config.dreams)) if files]
    asked = list(FIGURES) if config.figure == "all" else [config.figure]
    if config.figure == "all" and named and config.runs == PlotConfig().runs:
        asked = named
    columns = {column for name in asked for column in FIGURES[name].columns(config)}
    runs, problems = ([], []) if set(asked) <= set(named) else read_runs(find_runs(places), columns)
    warn(problems)
    if config.figure == "all":
        draw_all(config, output, runs, problems, asked)
    elif not draw_one(config.figure, config, output, runs, problems):
        raise ValueError(f"figure={config.figure}: none of these runs has data for it.")


def as_list(value: Any) -> list[str]:
    """Return a list of strings: of a single value one entry, of an empty one none."""
    return [str(one) for one in (value if isinstance(value, list) else [value] if value else [])]


def refuse_for_curves(config: PlotConfig) -> None:
    """Raise ValueError if a setting is given that cannot be combined with a file of curves."""
    names = ("quantities", "axis", "aggregate", "window", "flights", "dreams")
    given = [name for name in names if getattr(config, name) != getattr(PlotConfig(), name)]
    if config.figure not in ("all", "learning_curves"):
        given.append("figure")
    if given:
        raise ValueError(
            f"{', '.join(f'{name}=' for name in given)}: runs={config.runs} is a file of curves, which is drawn "
            "unchanged. Leave the setting out, or name runs."
        )


def check_plot(config: PlotConfig) -> None:
    """Raise ValueError if a value is not allowed, or a file does not exist."""
    check_settings(config)
    check_choice("figure", config.figure, (*FIGURES, "all"))
    check_choice("flight", config.flight, ("last", "best"))
    check_choice("over", config.over, PROFILE_AXES)
    for name, files in (("flights", config.flights), ("dreams", config.dreams)):
        if missing := [str(file) for file in files if not Path(file).is_file()]:
            raise ValueError(f"{name}={missing[0]}: there is no such file.")
    wanted_columns(config.quantities, config.axis)


def draw_all(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str], names: Iterable[str]) -> None:
    """Draw every figure that has data, also after one failed.

    Raises:
        ValueError: nothing could be drawn.
        Exception: the first one that was neither ValueError nor OSError, after the other figures were drawn.
    """
    drawn = False
    failures: dict[str, Exception] = {}
    for name in names:
        try:
            drawn |= draw_one(name, config, output, runs, problems)
        except Exception as error:
            failures[name] = error
            warn([f"figure={name} failed: {error}"])
    defects = [failure for failure in failures.values() if not isinstance(failure, (ValueError, OSError))]
    if defects:
        raise defects[0]
    if not drawn:
        reasons = "\n".join(f"figure={name}: {failure}" for name, failure in failures.items())
        raise ValueError(f"figure=all: nothing could be drawn. {reasons or 'These runs have no data for it.'}")


def draw_one(name: str, config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> bool:
    """Draw a figure and log what it has left out; return whether there was data."""
    files, found = FIGURES[name].draw(config, output, runs, problems)
    warn([problem for problem in found if problem not in problems])
    logger.info("%-17s %s", f"{name}:", ", ".join(files) or "none of these runs has data for it")
    return bool(files)


def warn(problems: list[str]) -> None:
    """Log each problem as a warning."""
    for problem in problems:
        logger.warning("warning: %s", problem)


def draw_learning_curves(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> Drawn:
    """Write `learning_curves.png` and `.csv`."""
    curves = learning_curves(runs, config.quantities, config.aggregate.value, config.window, problems, config.axis)
    write_curves(output / CURVES, curves)
    plot_learning_curves(curves, output / "learning_curves.png")
    return ["learning_curves.png", CURVES], curves.problems


def draw_imagined(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> Drawn:
    """Write a grid, a video and a GIF of three stages of training, for the first seed of each curve with dreams."""
    if config.dreams:
        return draw_dreams("imagined", {Path(file): Dream.load(file) for file in config.dreams}, [], output)
    files, missing, names = [], [], Counter[str]()
    for run in first_of_each_curve(runs):
        stages, left_out = stages_of_training(run)
        missing += left_out
        if stages:
            names[run.name] += 1  # runs of two experiments may have the same name
            name = f"imagined_{run.name}" + (f"_{names[run.name]}" if names[run.name] > 1 else "")
            files += draw_dreams(name, stages, left_out, output)[0]
    return files, missing


def stages_of_training(run: RunData) -> tuple[dict[Path, Dream], list[str]]:
    """Read the first, the middle and the last dream of a run; an unreadable one is replaced by the one before it."""
    files = evaluation_files(run.directory, "_dream.npz")
    files = [file for file in files if file.name.partition("_")[0].isdigit()] or files  # of training, if there are any
    problems: list[str] = []
    choices = (files, files[len(files) // 2 :: -1], files[::-1])  # the first one is replaced by the one after it
    found = [first_readable(choice, Dream.load, problems) for choice in choices]
    return dict(sorted(filter(None, found), key=lambda pair: files.index(pair[0]))), problems


def draw_dreams(name: str, stages: dict[Path, Dream], problems: list[str], output: Path) -> Drawn:
    """Write a grid, a video and a GIF of dreams."""
    dreams = [(stage_name(file), dream) for file, dream in stages.items()]
    plot_dreams(dreams, output / f"{name}.png", problems=problems)
    fps, film = 1 / (VIDEO_SLOWER * dreams[0][1].frame_dt), dream_video(dreams)
    filmed = write_video(output / f"{name}.mp4", film, fps=fps, scale=2)
    write_gif(output / f"{name}.gif", film, fps=fps)
    return [f"{name}.png", *([f"{name}.mp4"] if filmed else []), f"{name}.gif"], problems


def draw_trajectories(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> Drawn:
    """Write `trajectories.png` of the given files, or of one evaluation of each curve's first seed."""
    missing: list[str] = []
    flights = [named_flight(file) for file in config.flights] or chosen_flights(runs, config.flight, missing)
    if flights:
        plot_flights(flights, output / "trajectories.png", config.over, problems=missing)
    return ["trajectories.png"] if flights else [], missing


def chosen_flights(runs: list[RunData], which: str, problems: list[str]) -> list[NamedFlight]:
    """Read the last or the best flight of the first seed of each curve, or the next one if it cannot be read."""
    flights = []
    for run in first_of_each_curve(runs):
        files = evaluation_files(run.directory, NUMBERS)
        if which == "last":
            files.reverse()
        else:
            files.sort(key=evaluation_score, reverse=True)
        found = first_readable(files, named_flight, problems)
        flights += [found[1]] if found else []
    return flights


def named_flight(file: str | Path) -> NamedFlight:
    """Read a flight with its track; its title is made of the names of the run and the evaluation."""
    trajectory, track = read_trajectory(file)
    return NamedFlight(f"{run_of(file).name}, {stage_name(file)}", track, trajectory)


def run_of(file: str | Path) -> Path:
    """Return the run directory of an evaluation's file, or for a file outside a run its folder."""
    folder = Path(file).absolute().parent
    if folder.name == RunDirectory(folder).evaluations.name:
        folder = folder.parent
    return folder.parent if re.fullmatch(r"evaluation(_\d+)?", folder.name) else folder


def stage_name(file: str | Path) -> str:
    """Return the env_steps of an evaluation as text, if its file is named by them, else the file's name as words."""
    name = Path(file).stem.rpartition("_")[0]
    return f"{int(name):,} env_steps" if name.isdigit() else name.replace("_", " ")


def evaluation_files(directory: Path, ending: str) -> list[Path]:
    """Find the files of a run's evaluations of the deterministic policy, by their ending.

    First those of training, sorted by env_steps, then those of `recipes/evaluate.py`: `evaluation`, `evaluation_2` ...
    """
    files = RunDirectory(directory).evaluations.glob(f"*{ending}")
    during = {int(name): file for file in files if (name := file.name.removesuffix(ending)).isdigit()}
    number = {folder: re.fullmatch(r"evaluation(?:_(\d+))?", folder.name) for folder in directory.glob("evaluation*")}
    folders = sorted((int(match[1] or 1), folder) for folder, match in number.items() if match)
    after = [RunDirectory(folder).evaluations / f"deterministic{ending}" for _, folder in folders]
    return [*(during[env_steps] for env_steps in sorted(during)), *(file for file in after if file.is_file())]


def stored_flights(folder: Path) -> list[Path]:
    """Return the files of a run's evaluation flights, the latest last; or those in a recipe's output folder."""
    if evaluated := evaluation_files(folder, NUMBERS):
        return evaluated
    places = (folder, RunDirectory(folder).evaluations)
    return [file for place in places for name in STORED if (file := place / f"{name}{NUMBERS}").is_file()]


def evaluation_score(flight: Path) -> tuple[float, float]:
    """Return the score of a flight's evaluation, (gates per episode, mean return); −∞ if it cannot be read."""
    try:
        numbers = json.loads(flight.with_name(f"{flight.name.removesuffix(NUMBERS)}.json").read_text(encoding="utf-8"))
        return float(numbers["gates_per_episode"]), float(numbers["return_mean"])
    except (OSError, ValueError, KeyError, TypeError):
        return -math.inf, -math.inf


def first_readable(files: Iterable[Path], read: Callable[[Path], T], problems: list[str]) -> tuple[Path, T] | None:
    """Return the first of a run's evaluation files that ``read`` can, with its content; None if it can read none.

    If files were skipped, ``problems`` gets a line with the run, the first of these files and the reason.
    """
    failures: list[tuple[Path, Exception]] = []
    found = None
    for file in files:
        try:
            found = file, read(file)
            break
        except (ValueError, OSError) as error:
            failures.append((file, error))
    if failures:
        first, failure = failures[0]
        more = len(failures) - 1
        others = f" and {more} other{'s' if more > 1 else ''}" if more else ""
        reason = textwrap.shorten(str(failure).replace(f"{first.parent}{os.sep}", ""), REASON_LETTERS).rstrip(".")
        line = f"{RunDirectory.of(first).path.name} without {first.name}{others}: {reason}"
        problems += [line] if line not in problems else []
    return found


def draw_comparison(config: PlotConfig, output: Path, runs: list[RunData], problems: list[str]) -> Drawn:
    """Write `comparison.md` and `comparison.png`, if there are variants to compare."""
    if len(group_runs(runs)) < 2:
        if runs and config.figure == "comparison":
            raise ValueError("figure=comparison: these runs have only one variant; runs= takes several paths.")
        return [], []
    comparison = compare_variants(runs, problems, config.axis)
    (output / "comparison.md").write_text(comparison_table(comparison), encoding="utf-8")
    plot_comparison(comparison, output / "comparison.png")
    return ["comparison.md", "comparison.png"], comparison.problems


class Entry(NamedTuple):
    """A figure of the setting `figure`: its function, and which columns of `metrics.csv` it needs."""

    draw: Callable[[PlotConfig, Path, list[RunData], list[str]], Drawn]  # the strings: what was left out of the runs
    columns: Callable[[PlotConfig], Iterable[str]] = lambda config: ()


FIGURES = {
    "learning_curves": Entry(draw_learning_curves, lambda config: wanted_columns(config.quantities, config.axis)),
    "imagined": Entry(draw_imagined),
    "trajectories": Entry(draw_trajectories),
    "comparison": Entry(draw_comparison, lambda config: COLUMNS),
}
