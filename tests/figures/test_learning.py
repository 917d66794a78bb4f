"""Figures of training: what is drawn for curves and for variants, told from the figures' artists."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgba

from dreamer_racing.figures import learning
from dreamer_racing.figures.comparison import Comparison, VariantResult
from dreamer_racing.figures.curves import Curve, LearningCurves, learning_curves
from dreamer_racing.figures.learning import line_styles, plot_comparison, plot_learning_curves
from dreamer_racing.figures.runs import CurveKey, find_runs, read_runs
from tests.figures.test_curves import write_metrics, write_run
from tests.running_recipes import compose


def legend_texts(figure) -> list[str]:
    (legend,) = [child for child in figure.axes[-1].get_children() if hasattr(child, "get_texts")]
    return [text.get_text() for text in legend.get_texts()]


def test_learning_curves_have_a_panel_a_track_and_a_row_a_quantity(tmp_path, figures):
    for algorithm in ("sac", "dreamer_v3"):
        for track in ("kidney", "circle"):
            for seed in range(2):
                write_run(tmp_path, f"{algorithm}_{track}_seed{seed}", track=track, seed=seed, algorithm=algorithm)
    (write_run(tmp_path, "ppo_circle_seed0", algorithm="ppo") / "metrics.csv").unlink()
    runs, problems = read_runs(find_runs([tmp_path]))
    curves = learning_curves(runs, ["success_rate", "return"], problems=problems)
    plot_learning_curves(curves, tmp_path / "figure.png")
    *panels, below = figures[0].axes
    assert [axes.get_title() for axes in panels] == ["Circle", "Kidney", "", ""]
    labels = ["Success rate\n(deterministic)", "", "Return\n(training episodes)", ""]
    assert [axes.get_ylabel() for axes in panels] == labels
    assert all(axes.get_xlim() == (0.0, 2000.0) and len(axes.lines) == 2 for axes in panels)
    assert all(len(axes.collections) == 2 for axes in panels)  # bands
    assert legend_texts(figures[0]) == ["DreamerV3 (2 seeds)", "SAC (2 seeds)"]
    assert (tmp_path / "figure_left_out.txt").read_text() == "ppo_circle_seed0 left out: it has no metrics.csv\n"
    (legend,) = [child for child in below.get_children() if hasattr(child, "get_texts")]
    assert "standard deviation (n − 1) (none for one seed); running mean" in legend.get_title().get_text()
    colors = {line.get_color() for line in legend.get_lines()}
    assert len(colors) == 2 and {line.get_color() for line in panels[0].lines} == colors


def curve(key: CurveKey, seeds: list[int], quantity: str = "return") -> Curve:
    """A curve at 0, 100, 200 ... env_steps."""
    steps, zero = 100.0 * np.arange(len(seeds)), np.zeros(len(seeds))
    return Curve(key, quantity, steps, zero, zero - 1, zero + 1, np.array(seeds))


def test_the_band_of_a_rate_ends_where_rates_do(tmp_path, figures):
    key = CurveKey("circle", "ppo", "")
    curves = [curve(key, [2, 2, 2], quantity) for quantity in ("success_rate", "return")]  # each from −1 to 1
    plot_learning_curves(LearningCurves(curves, {}, "mean", 0.0, []), tmp_path / "figure.png")
    heights = [axes.collections[0].get_paths()[0].vertices[:, 1] for axes in figures[0].axes[:2]]
    assert [(height.min(), height.max()) for height in heights] == [(0.0, 1.0), (-1.0, 1.0)]


def test_the_legend_says_where_seeds_are_missing(tmp_path, figures):
    same, ends, differ = (CurveKey("circle", name, "") for name in ("dreamer_v3", "ppo", "sac"))
    curves = [
        curve(same, [3, 3, 3, 0]),  # ends together, before the others
        curve(ends, [3, 3, 1, 1]),
        curve(differ, [1] * 4),
        curve(differ._replace(track="kidney"), [2, 2, 1, 1]),
        curve(differ._replace(track="kidney"), [0, 0, 0, 1], "lap_time"),
    ]
    plot_learning_curves(LearningCurves(curves, {}, "mean", 10.0, []), tmp_path / "figure.png")
    assert legend_texts(figures[0]) == [
        "DreamerV3 (3 seeds)",
        "PPO (3 seeds, 1 at the end)",
        "SAC (Circle: 1 seed; Kidney: 2 seeds, 1 at the end)",
    ]


def test_more_than_sixteen_variants_are_refused():
    keys = [CurveKey("", "sac", f"v{index:02}") for index in range(17)]
    styles = line_styles(keys[:16])
    assert len({(style["color"], str(style["linestyle"])) for style in styles.values()}) == 16
    few = list(line_styles(keys[:4]).values())  # differ in both
    assert len({style["color"] for style in few}) == len({str(style["linestyle"]) for style in few}) == 4
    with pytest.raises(ValueError, match="17 variants of sac: a figure can show at most 16"):
        line_styles(keys)


def test_among_many_variants_the_default_stands_out(tmp_path, figures):
    variants = compose("ablation").variants
    curves = [curve(CurveKey("circle", "dreamer_v3", name), [3, 3]) for name in variants]
    plot_learning_curves(LearningCurves(curves, {}, "mean", 10.0, []), tmp_path / "figure.png")
    panel = figures[0].axes[0]
    assert len(panel.lines) == len(curves) >= 12 and len(panel.collections) == 1  # one band
    assert [line for line in panel.lines if line.get_linewidth() > 1.5] == panel.lines[-1:]  # drawn last
    assert legend_texts(figures[0])[0] == "DreamerV3, default (3 seeds)"


# --- variants side by side ---


def result(variant: str, gates: list[float] | None, seeds: int, algorithm: str = "dreamer_v3") -> VariantResult:
    values = {} if gates is None else {"gates": np.array(gates)}
    return VariantResult(CurveKey("circle", algorithm, variant), seeds, values, (800, 1000), None)


RETURN = "evaluation_return"
COMPARISON = Comparison(
    [result("default", [1.0, 2.0, 6.0], 3), result("no_replay", [4.0], 2), result("lost", [], 1)], ["late left out"]
)


def test_what_may_be_negative_has_no_bar_from_zero(tmp_path, figures):
    returns = VariantResult(CurveKey("circle", "ppo", "default"), 2, {RETURN: np.array([-4.0, -2.0])}, (0, 1), None)
    plot_comparison(Comparison([returns], []), tmp_path / "comparison.png")
    (axes,) = figures[0].axes
    assert not axes.patches
    assert [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "D"] == [[[-3.0, 0.0]]]


def test_a_bar_a_variant_a_dot_a_seed_and_a_line_for_the_reference(tmp_path, figures):
    plot_comparison(COMPARISON, tmp_path / "new" / "comparison.png")
    assert (tmp_path / "new" / "comparison.png").exists()
    assert (tmp_path / "new" / "comparison_left_out.txt").read_text() == "late left out\n"
    assert figures[0].get_suptitle() == "" and " ".join(figures[0].get_supxlabel().split()) == COMPARISON.caption
    (axes,) = figures[0].axes  # no values of the other quantity
    assert axes.get_title(loc="left") == "Gates per episode (deterministic)"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["default", "no replay", "lost"]
    bars = axes.patches
    looks = [(3.0, to_rgba(learning.REFERENCE_COLOR)), (4.0, to_rgba(learning.OTHER_COLOR))]
    assert [(bar.get_width(), bar.get_facecolor()) for bar in bars] == looks
    (spread,) = [line.get_segments()[0] for line in axes.collections]  # none of a single seed
    deviation = np.sqrt((4 + 1 + 9) / 2)
    np.testing.assert_allclose(spread, [(3 - deviation, 0), (3 + deviation, 0)])
    dots = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "o"]
    assert dots == [[[1, 0], [2, 0], [6, 0]], [[4, 1]]]
    dashed = [line.get_xdata() for line in axes.lines if line.get_marker() == "None"]
    assert dashed == [[3.0, 3.0]]
    assert [(note.get_text(), note.xy) for note in axes.texts] == [
        ("n = 3", (max(6.0, 3 + deviation), 0)), ("n = 1", (4.0, 1)), ("no values", (0.0, 2))
    ]  # fmt: skip
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first on top


def test_several_algorithms_are_named_and_have_no_common_reference(tmp_path, figures):
    plot_comparison(Comparison([result("", [1.0], 1), result("", [2.0], 1, "ppo")], []), tmp_path / "comparison.png")
    (axes,) = figures[0].axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["dreamer_v3 circle default", "ppo circle default"]
    assert all(line.get_marker() == "o" for line in axes.lines)


def test_variants_without_any_value_are_still_listed(tmp_path, figures):
    nothing = [replace(one, values={}) for one in COMPARISON.results]
    plot_comparison(Comparison(nothing, []), tmp_path / "comparison.png")
    (axes,) = figures[0].axes
    assert len(axes.get_yticklabels()) == 3 and not axes.patches


@pytest.mark.parametrize("returns", [[0.0], [0.0, 0.0]])
def test_one_row_and_nothing_but_zeros_are_drawn_from_zero_on(tmp_path, figures, returns, recwarn):
    columns = ["evaluation/gates_per_episode", "evaluation/lap_time_mean", "held_out/image_error"]
    rows = [(1000 * index, value, value, value) for index, value in enumerate(returns)]
    write_metrics(write_run(tmp_path, "ppo_circle_seed0", algorithm="ppo"), columns, rows)
    runs, _ = read_runs(find_runs([tmp_path]))
    plot_learning_curves(learning_curves(runs, ["gates", "lap_time", "image_error"]), tmp_path / "figure.png")
    panels = figures[0].axes[:-1]
    assert all(axes.get_xlim()[0] == axes.get_ylim()[0] == 0.0 for axes in panels)
    assert all(axes.get_ylim()[1] > 0.0 and axes.get_xlim()[1] > 0.0 for axes in panels)
    if len(returns) == 1:
        assert all("o" in [line.get_marker() for line in axes.lines] for axes in panels)  # a line of one point is none
    assert not recwarn.list


def test_a_track_s_panels_end_with_its_own_runs(tmp_path, figures):
    for track, rows in (("circle", 2), ("kidney", 8)):
        write_run(tmp_path, f"ppo_{track}_seed0", [1.0] * rows, track=track, algorithm="ppo")
    runs, _ = read_runs(find_runs([tmp_path]))
    plot_learning_curves(learning_curves(runs, ["return", "success_rate"]), tmp_path / "figure.png")
    ends = [axes.get_xlim()[1] for axes in figures[0].axes[:-1]]
    assert ends[0] == ends[2] == pytest.approx(2000, rel=0.05) and ends[1] == ends[3] == 8000
