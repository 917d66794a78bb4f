"""Figures of training metrics: learning curves over seeds, and comparisons of an experiment's variants."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from dreamer_racing.figures.comparison import Comparison, VariantResult
from dreamer_racing.figures.curves import ALL_TRACKS, ENDS_EARLY, QUANTITIES, Curve, LearningCurves
from dreamer_racing.figures.drawing import INK, MUTED, NOTE_LETTERS, Style, dress, save
from dreamer_racing.figures.runs import CurveKey, axis_of

ALGORITHMS = {
    "dreamer_v3": ("DreamerV3", "#1c7ed6"),
    "latent_ppo": ("Latent PPO", "#2f9e44"),
    "ppo": ("PPO", "#f76707"),
    "sac": ("SAC", "#e03131"),
}
"""Display names and the paper's colours; other algorithms are grey with their own name."""
TRACKS = ("circle", "kidney", "figure8")  # first columns, in the paper's order; others follow
VARIANT_LINES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5)))
VARIANT_SHADES = (0.0, -0.55, 0.5, -0.28)  # change of an algorithm's colour: darker below 0, lighter above
MANY_VARIANTS = 4  # above this number, all variants of an algorithm but the reference are thin and without a band
SHORTEST_LINE = 0.03  # share of the axis; a shorter curve, such as one of a single measurement, is drawn as a dot
LETTER = 0.072  # width of a letter in the legend, inches
BANDS = {
    "mean": ("mean", "sample standard deviation (n − 1)"),
    "iqm": ("interquartile mean", "95 % bootstrap interval"),
}
DRAWN = ("gates", "evaluation_return")  # panels of the comparison
Styles = dict[CurveKey, Style]
COUNT_ROOM = 0.12  # space for n right of the longest bar, as a share of the axis
SMALL: Style = {"fontsize": 8, "color": MUTED}
ERROR: Style = {"ecolor": INK, "elinewidth": 1.4, "capsize": 3.0}
REFERENCE_COLOR = "#1971c2"  # light, so that the error bar is visible
OTHER_COLOR = "#a5d8ff"  # of other variants


def plot_learning_curves(curves: LearningCurves, path: str | Path) -> None:
    """Draw a grid with a column per track and a row per quantity; colours are algorithms, line styles variants.

    Ticks at the bottom mark where the curriculum raised b₂, for every seed.

    Reference: paper, Fig. "Reward evolution".

    Raises:
        ValueError: an algorithm has more variants than there are line styles.
    """
    tracks = sorted({curve.key.track for curve in curves.curves} | {key.track for key in curves.raises}, key=_place)
    quantities = list(dict.fromkeys(curve.quantity for curve in curves.curves))
    keys = sorted({curve.key._replace(track="") for curve in curves.curves}, key=_rank)
    styles = line_styles(keys)
    width = max(7.0, 0.6 + 3.9 * len(tracks))
    names = {key: ALGORITHMS.get(key.algorithm, (key.algorithm,))[0] for key in keys}
    labels = {key: ", ".join(filter(None, (names[key], key.variant))) for key in keys}
    labels = {key: f"{label} ({_seed_count(curves, key)})" for key, label in labels.items()}
    columns = max(1, int((width - 0.8) / (0.6 + LETTER * max(map(len, labels.values())))))
    caption = textwrap.wrap(_caption(curves, styles), int((width - 0.8) / LETTER))
    lines = len(caption) + math.ceil((len(keys) + any(map(len, curves.raises.values()))) / columns)
    legend_height = 0.1 + 0.2 * lines  # inches
    figure = Figure(figsize=(width, 2.7 * len(quantities) + 0.5 + legend_height), layout="constrained")
    grid = figure.add_gridspec(
        len(quantities) + 1, len(tracks), height_ratios=[2.7] * len(quantities) + [legend_height]
    )
    for row, quantity in enumerate(quantities):
        for column, track in enumerate(tracks):
            axes = figure.add_subplot(grid[row, column])
            if row == 0:
                axes.set_title(_track_title(track), fontsize=11, color=INK)
            shown = [curve for curve in curves.curves if curve.quantity == quantity and curve.key.track == track]
            if track == ALL_TRACKS and not shown:
                axes.set_axis_off()  # not comparable across tracks
                continue
            _draw_panel(axes, shown, styles, _end(curves, track))
            _draw_raises(axes, curves, track, styles)
            if column == 0:
                axes.set_ylabel(QUANTITIES[quantity].label.replace(" (", "\n("), color=INK)
            if not axis_of(curves.axis).clock:
                axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            if row == len(quantities) - 1:
                axes.set_xlabel(axis_of(curves.axis).label, color=INK)
    handles = [Line2D([], [], label=labels[key], **styles[key]) for key in keys]
    if any(map(len, curves.raises.values())):
        tick: Style = {"marker": "|", "markersize": 8, "linestyle": "", "color": MUTED}
        handles.append(Line2D([], [], label="the curriculum raises b₂", **tick))
    _draw_legend(figure.add_subplot(grid[-1, :]), handles, "\n".join(caption), columns)
    save(figure, path, curves.problems)


def _end(curves: LearningCurves, track: str) -> float:
    """Return the end of a track's axis, the last point with a value of any quantity; a column's panels share it."""
    own = [curve for curve in curves.curves if curve.key.track == track and curve.seeds.any()]
    return max((float(curve.x[curve.seeds > 0].max()) for curve in own), default=0.0) or 1.0


def _draw_panel(axes: Axes, curves: Sequence[Curve], styles: Styles, end: float) -> None:
    for curve in sorted(curves, key=lambda curve: _rank(curve.key), reverse=True):  # the reference on top
        line = styles[curve.key._replace(track="")]
        if curve.key.is_reference or not _has_many_variants(curve.key, styles):
            ends = (0.0, 1.0) if QUANTITIES[curve.quantity].comparable else (-np.inf, np.inf)  # rates are in [0, 1]
            band = (np.clip(side, *ends) for side in (curve.low, curve.high))
            axes.fill_between(curve.x, *band, color=line["color"], alpha=0.18, linewidth=0)
        axes.plot(curve.x, curve.centre, **line)
        drawn = np.isfinite(curve.centre)
        if drawn.any() and np.ptp(curve.x[drawn]) < SHORTEST_LINE * end:
            last = np.flatnonzero(drawn)[-1:]
            axes.plot(curve.x[last], curve.centre[last], "o", color=line["color"], clip_on=False)
    if not curves:
        axes.text(0.5, 0.5, "no values", transform=axes.transAxes, ha="center", va="center", color=MUTED)
        axes.set_yticks([])
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlim(0.0, end)
    if curves:
        axes.set_ylim(*_limits(curves[0].quantity, axes.get_ylim()))
    dress(axes)


def _limits(quantity: str, limits: tuple[float, float]) -> tuple[float, float]:
    """Return the limits of an axis: 0 to 1 for a rate, 0 to at least 1 for a count."""
    if QUANTITIES[quantity].comparable:
        return -0.02, 1.04
    if QUANTITIES[quantity].counted:
        return 0.0, max(1.0, limits[1])
    if QUANTITIES[quantity].positive:
        return max(0.0, limits[0]), limits[1]
    return limits


def _draw_raises(axes: Axes, curves: LearningCurves, track: str, styles: Styles) -> None:
    """Draw a short tick for every rise of b₂; each curve with rises has its own height above the axis."""
    raised = [key for key in styles if len(curves.raises.get(key._replace(track=track), ()))]
    for level, key in enumerate(raised):
        steps, bottom = curves.raises[key._replace(track=track)], 0.012 + 0.05 * level
        look: Style = {"colors": [styles[key]["color"]], "linewidth": 1.0, "alpha": 0.8}
        axes.vlines(steps, bottom, bottom + 0.04, transform=axes.get_xaxis_transform(), **look)


def _draw_legend(axes: Axes, handles: Sequence[Line2D], caption: str, columns: int) -> None:
    axes.set_axis_off()
    style: Style = {"frameon": False, "fontsize": 9, "borderaxespad": 0.0, "labelcolor": INK}
    legend = axes.legend(handles=handles, loc="upper left", ncols=columns, title=caption, alignment="left", **style)
    legend.get_title().set(fontsize=9, color=MUTED)


def _caption(curves: LearningCurves, styles: Styles) -> str:
    centre, band = BANDS[curves.aggregate]
    of = " of the default only" if any(_has_many_variants(key, styles) for key in styles) else ""
    window = f"{curves.window:.2g}"
    if not axis_of(curves.axis).clock:
        window = EngFormatter(sep="")(float(window))  # 24k, 1.5M
    over = f"running mean over {window} {axis_of(curves.axis).label}"
    return f"{centre} over seeds; band: {band}{of} (none for one seed); {over}"


def _seed_count(curves: LearningCurves, key: CurveKey) -> str:
    """Return the number of seeds as text, with the number at the end if it is smaller; by track if tracks differ."""
    counts: dict[str, tuple[int, int]] = {}
    for curve in curves.curves:
        track = curve.key.track
        if curve.key._replace(track="") == key and track != ALL_TRACKS:
            # Slightly before the last value, because runs do not end at the same step.
            end = ENDS_EARLY * curve.x[curve.seeds > 0].max(initial=0.0)
            at_the_end = int(curve.seeds[np.searchsorted(curve.x, end, "right") - 1])
            most, last = counts.get(track, (0, 0))
            counts[track] = max(most, int(curve.seeds.max())), max(last, at_the_end)
    texts = {
        track: f"{most} seed{'s' if most > 1 else ''}" + (f", {last} at the end" if last < most else "")
        for track, (most, last) in counts.items()
    }
    if len(set(texts.values())) == 1:
        return next(iter(texts.values()))
    return "; ".join(f"{_track_title(track)}: {texts[track]}" for track in sorted(texts, key=_place))


def line_styles(keys: Sequence[CurveKey]) -> Styles:
    """Choose distinct line styles for keys without track: the algorithm's colour, darker or lighter, and dashes.

    Raises:
        ValueError: an algorithm has more variants than there are line styles.
    """
    styles: Styles = {}
    lines, shades = len(VARIANT_LINES), len(VARIANT_SHADES)
    for key in keys:
        own = [other for other in keys if other.algorithm == key.algorithm]
        if len(own) > lines * shades:
            raise ValueError(
                f"{len(own)} variants of {key.algorithm}: a figure can show at most {lines * shades}. Draw several "
                "figures: runs=[...] takes folders and patterns."
            )
        index = own.index(key)
        color = np.array(to_rgb(ALGORITHMS.get(key.algorithm, ("", MUTED))[1]))
        shade = VARIANT_SHADES[(index + index // lines) % shades]  # shifted after each cycle of dashes
        mixed = color * (1 + shade) if shade < 0 else color + (1 - color) * shade
        width = 1.2 if _has_many_variants(key, own) and not key.is_reference else 1.9
        styles[key] = {"color": tuple(mixed), "linestyle": VARIANT_LINES[index % lines], "linewidth": width}
    return styles


def _has_many_variants(key: CurveKey, keys: Collection[CurveKey]) -> bool:
    return sum(other.algorithm == key.algorithm for other in keys) > MANY_VARIANTS


def _rank(key: CurveKey) -> tuple[int, bool, CurveKey]:
    """Return a sort key: by algorithm, the reference before the other variants."""
    names = list(ALGORITHMS)
    return names.index(key.algorithm) if key.algorithm in names else len(names), not key.is_reference, key


def _place(track: str) -> tuple[bool, int, str]:
    """Return a sort key: the paper's tracks, then others alphabetically, then `ALL_TRACKS`."""
    return track == ALL_TRACKS, TRACKS.index(track) if track in TRACKS else len(TRACKS), track


def _track_title(track: str) -> str:
    return re.sub(r"(?<=[a-z])(?=\d)", " ", track.replace("_", " ")).capitalize()


def plot_comparison(comparison: Comparison, path: str | Path) -> None:
    """Draw a bar per variant with the standard deviation over n seeds, a dot per seed, and a line at the reference."""
    results = comparison.results
    shown = [name for name in DRAWN if any(name in result.values for result in results)]
    several = len({result.key[:2] for result in results}) > 1
    figure = Figure(figsize=(3.0 + 3.4 * max(len(shown), 1), 1.2 + 0.34 * len(results)), layout="constrained")
    panels = figure.subplots(1, max(len(shown), 1), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, shown, strict=False):
        for place, result in enumerate(results):
            _draw_bar(axes, place, result, name)
            if result.key.is_reference and not several and len(result.values.get(name, ())):
                axes.axvline(result.values[name].mean(), color=INK, linestyle=(0, (4, 3)), linewidth=0.9)
        axes.set_title(QUANTITIES[name].label, loc="left", fontsize=10, color=INK)
        low, high = _limits(name, axes.get_xlim())
        axes.set_xlim(low, high + COUNT_ROOM * (high - low))
        dress(axes, "x")
    names = [" ".join([*(result.key[:2][::-1] if several else ()), result.name]) for result in results]
    panels[0].set_yticks(np.arange(len(results)), names)
    panels[0].invert_yaxis()
    caption = textwrap.fill(comparison.caption, int(NOTE_LETTERS * figure.get_figwidth()))
    figure.supxlabel(caption, x=0.01, ha="left", fontsize=8, color=MUTED)
    save(figure, path, comparison.problems)


def _draw_bar(axes: Axes, place: int, result: VariantResult, name: str) -> None:
    values = result.values.get(name, np.empty(0))
    if not len(values):
        axes.annotate("no values", (0.0, place), xytext=(4, 0), textcoords="offset points", va="center", **SMALL)
        return
    error = values.std(ddof=1) if len(values) > 1 else None
    color = REFERENCE_COLOR if result.key.is_reference else OTHER_COLOR
    if QUANTITIES[name].counted or QUANTITIES[name].comparable:
        axes.barh(place, values.mean(), xerr=error, color=color, error_kw=ERROR, height=0.65)
    else:  # with negative values, the worst variant would have the longest bar
        axes.errorbar(values.mean(), place, xerr=error, fmt="D", markersize=8, color=color, **ERROR)
    axes.plot(values, np.full(len(values), place), "o", color="white", markeredgecolor=INK, markersize=4, clip_on=False)
    right = max(values.max(), values.mean() + (error or 0.0))
    count = f"n = {len(values)}"
    axes.annotate(count, (right, place), xytext=(9, 0), textcoords="offset points", va="center", **SMALL)
