"""The picture of a sim-to-real study: success and lap time over each thing that was changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from dreamer_racing.figures.drawing import dress, save

LABELS = {
    "delay": ("command delay (ms)", 1e3),
    "latency": ("pose latency, not told (ms)", 1e3),
    "mass": ("mass, relative", 1.0),
    "thrust": ("thrust, relative", 1.0),
    "position_noise": ("position noise (mm)", 1e3),
    "rate": ("poses a second (Hz)", 1.0),
}
"""Label of each sweep's axis, and by what its values are multiplied there."""

COLORS = ("#2f5fb3", "#e8590c", "#1fa2a6", "#7950f2")


def plot_study(results: Sequence[Mapping[str, Any]], path: str | Path) -> None:
    """Draw studies over each other: above the share of flights that finished, below the mean lap.

    Args:
        results: As recipes/sim_to_real.py writes them, one for each flyer.
        path: The file to write.

    Raises:
        ValueError: They hold no flight.
    """
    sweeps = [name for name in LABELS if any(flight["sweep"] == name for r in results for flight in r["flights"])]
    if not sweeps:
        raise ValueError("These studies hold no flight: there is nothing to draw.")
    figure = Figure(figsize=(max(7.0, 2.6 * len(sweeps) + 0.6), 5.0), layout="constrained")
    panels: np.ndarray = figure.subplots(2, len(sweeps), sharex="col", sharey="row", squeeze=False)
    for result, color in zip(results, COLORS, strict=False):
        made = result["provenance"]
        label = f"{made['actor']} on {made['track']}, {made['preset']}, n = {made['flights']}"
        for column, sweep in zip(panels.T, sweeps, strict=True):
            _draw(column, sweep, [flight for flight in result["flights"] if flight["sweep"] == sweep], color, label)
    for column, sweep in zip(panels.T, sweeps, strict=True):
        column[1].set_xlabel(LABELS[sweep][0])
        for axes in column:
            dress(axes)
    panels[0, 0].set_ylabel("flights that finished")
    panels[0, 0].set_ylim(-0.03, 1.05)
    panels[0, 0].yaxis.set_major_formatter(PercentFormatter(1.0))
    panels[1, 0].set_ylabel("lap (s)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, fontsize=8, ncols=len(labels))
    save(figure, path)


def _draw(column: np.ndarray, sweep: str, flights: Sequence[Mapping[str, Any]], color: str, label: str) -> None:
    """Draw one sweep of one study into its two panels."""
    values = sorted({flight["value"] for flight in flights})
    by_value = [[flight for flight in flights if flight["value"] == value] for value in values]
    at = LABELS[sweep][1] * np.array(values)
    success = [np.mean([flight["finished"] for flight in group]) for group in by_value]
    laps = [_mean([flight["lap_time"] for flight in group]) for group in by_value]
    above, below = column
    _line(above, at, np.array(success), color, label)
    _line(below, at, np.array(laps), color, label)


def _line(axes: Axes, at: np.ndarray, values: np.ndarray, color: str, label: str) -> None:
    axes.plot(at, values, "o-", color=color, label=label, markersize=4, linewidth=1.5, clip_on=False)


def _mean(values: Sequence[float | None]) -> float:
    """Mean of what is there; not a number if nothing is."""
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else np.nan
