"""Figure of a sim-to-real study: success and lap time over each parameter varied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dreamer_racing.figures.drawing import INK, MUTED, dress, from_zero, save
from dreamer_racing.figures.protocol import Bar, mean_bar, share_axis, share_bar

LABELS = {
    "delay": ("command delay (ms)", 1e3),
    "latency": ("pose latency, unknown to the loop (ms)", 1e3),
    "mass": ("mass, relative", 1.0),
    "thrust": ("thrust, relative", 1.0),
    "position_noise": ("position noise (mm)", 1e3),
    "rate": ("poses a second (Hz)", 1.0),
}
"""Axis label of each sweep, and the factor from its values to the label's unit."""
COLORS = ("#2f5fb3", "#e8590c", "#1fa2a6", "#7950f2")
APART = 0.16  # horizontal offset between studies at one value, as a share of the step between values, against overlap
NOTE = "Lines: 95 % intervals over n flights (success: Wilson, mean laps: normal). Horizontal axes are not to scale."


def plot_study(results: Sequence[Mapping[str, Any]], path: str | Path) -> None:
    """Draw results of recipes/sim_to_real.py: the share of finished flights above, the mean lap time below.

    Raises:
        ValueError: The results hold no flight, or there are more studies than colours.
    """
    sweeps = [name for name in LABELS if any(flight["sweep"] == name for r in results for flight in r["flights"])]
    if not sweeps:
        raise ValueError("These studies hold no flight: there is nothing to draw.")
    if len(results) > len(COLORS):
        raise ValueError(f"{len(results)} studies: at most {len(COLORS)} fit into one figure.")
    figure = Figure(figsize=(max(7.0, 2.6 * len(sweeps) + 0.6), 5.6), layout="constrained")
    panels: np.ndarray = figure.subplots(2, len(sweeps), sharex="col", sharey="row", squeeze=False)
    for column, sweep in zip(panels.T, sweeps, strict=True):
        _draw_sweep(column, sweep, results)
    _dress_rows(panels)
    figure.align_ylabels(panels[:, 0])
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, fontsize=8, ncols=len(labels))
    figure.supxlabel(NOTE, x=0.01, ha="left", fontsize=8, color=MUTED)
    save(figure, path)


def _draw_sweep(column: np.ndarray, sweep: str, results: Sequence[Mapping[str, Any]]) -> None:
    flown = [[flight for flight in result["flights"] if flight["sweep"] == sweep] for result in results]
    values = sorted({flight["value"] for flights in flown for flight in flights})
    for number, (result, flights, color) in enumerate(zip(results, flown, COLORS, strict=False)):
        made = result["provenance"]
        label = f"{made['actor']} on {made['track']}, {made['preset']}"
        by_value = [[flight for flight in flights if flight["value"] == value] for value in values]
        laps = [[one["lap_time"] for one in group if one["lap_time"] is not None] for group in by_value]
        success = [share_bar([one["finished"] for one in group]) if group else None for group in by_value]
        shift = APART * (number - 0.5 * (len(results) - 1))
        _draw_bars(column[0], shift, success, color, label)
        _draw_bars(column[1], shift, [mean_bar(times) if times else None for times in laps], color, label)
    label, unit = LABELS[sweep]
    column[1].set_xlabel(label)
    column[1].set_xticks(range(len(values)), [f"{unit * value:g}" for value in values])
    column[1].set_xlim(-0.6, len(values) - 0.4)


def _draw_bars(axes: Axes, shift: float, bars: Sequence[Bar | None], color: str, label: str) -> None:
    """Draw means with their intervals and n above; a value without flights is a gap."""
    heights = [np.nan if bar is None else bar.height for bar in bars]
    ends = np.array([(0.0, 0.0) if bar is None else (bar.height - bar.low, bar.high - bar.height) for bar in bars]).T
    at = np.arange(len(bars)) + shift
    axes.plot(at, heights, color=color, linewidth=1.0, alpha=0.5)
    style: dict[str, Any] = {"fmt": "o", "markersize": 4, "elinewidth": 1.2, "capsize": 2.5}
    axes.errorbar(at, heights, yerr=ends.clip(0.0), color=color, label=label, **style)
    for place, bar in zip(at, bars, strict=True):
        if bar is not None:
            above: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom", "fontsize": 6}
            axes.annotate(f"{bar.n}", (place, bar.high), (0, 3), color=color, **above)


def _dress_rows(panels: np.ndarray) -> None:
    success, laps = panels[:, 0]
    for axes in panels.flat:
        dress(axes)
    success.set_ylabel("flights that finished")
    share_axis(success)
    success.set_ylim(-0.04, 1.16)
    laps.set_ylabel("lap (s)")
    laps_flown = [line.get_ydata() for axes in panels[1] for line in axes.lines]
    if not any(np.isfinite(np.asarray(heights, float)).any() for heights in laps_flown):
        from_zero(laps)
        for axes in panels[1]:
            axes.text(0.5, 0.5, "no lap", transform=axes.transAxes, ha="center", va="center", color=INK, fontsize=9)
