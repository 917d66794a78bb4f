"""Variants side by side: what is averaged, and what the table says."""

from pathlib import Path

import numpy as np
import pytest

from dreamer_racing.comparison import compare_variants, comparison_table, plot_comparison
from dreamer_racing.metrics_file import MetricsTable
from dreamer_racing.runs import RunData


def make_run(variant: str, seed: int, gates: list[float], **columns: list[float]) -> RunData:
    """A run with rows at 100, 200 ... env_steps."""
    steps = 100.0 * np.arange(1, len(gates) + 1)
    values = {"evaluation/gates_per_episode": gates, **columns}
    table = MetricsTable({name: (steps, np.array(column)) for name, column in values.items()}, steps, [])
    directory = Path(f"runs/ablation/dreamer_v3_circle_{variant}_seed{seed}")
    return RunData(directory, {"track": "circle", "seed": seed, "algorithm": "dreamer_v3"}, table)


RUNS = [
    make_run("late", 0, [0.0] * 10, wall_clock=[30.0] * 9 + [60.0]),
    make_run("default", 0, [9.0] * 7 + [1.0, 2.0, 3.0]),  # the last fifth: from 800 env_steps on
    make_run("default", 1, [0.0] * 7 + [4.0, 4.0, 4.0]),
]


def test_the_last_fifth_of_every_seed_counts_once() -> None:
    reference, late = compare_variants(RUNS)
    assert reference.name == "default" and late.name == "late"
    assert reference.values["gates"].tolist() == [2.0, 4.0]
    assert reference.env_steps == 1000 and reference.wall_clock is None and late.wall_clock == 60.0


def test_the_table_has_a_row_a_variant_and_no_column_without_values() -> None:
    head, _, reference, late = comparison_table(compare_variants(RUNS)).strip().splitlines()
    assert head == "| algorithm | track | variant | seeds | env_steps | Gates per evaluation | wall clock |"
    assert reference == "| dreamer_v3 | circle | default | 2 | 1,000 | 3 ± 1.41 |  |"
    assert late == "| dreamer_v3 | circle | late | 1 | 1,000 | 0 | 1.0 min |"


def test_a_picture(tmp_path: Path) -> None:
    plot_comparison(compare_variants(RUNS), tmp_path / "new" / "comparison.png")
    assert (tmp_path / "new" / "comparison.png").stat().st_size > 5000


def test_nothing_to_compare() -> None:
    with pytest.raises(ValueError, match="no run to compare"):
        compare_variants([])
