"""Curves over seeds: values by hand, runs that do not belong together, files in any state."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import yaml

from dreamer_racing.figures.curves import (
    ALL_TRACKS,
    bootstrap_interval,
    interquartile_mean,
    learning_curves,
    read_curves,
    resample,
    weight_raises,
    write_curves,
)
from dreamer_racing.figures.plotting import evaluation_files, evaluation_score
from dreamer_racing.figures.runs import CurveKey, find_runs, first_of_each_curve, group_runs, read_runs
from dreamer_racing.training.directory import RunDirectory
from dreamer_racing.training.metrics import read_metrics


def write_run(folder: Path, name: str, returns=(0.0, 10.0), track: str = "circle", **settings) -> Path:
    """A run whose return has these values after 1000, 2000 ... env_steps."""
    run = folder / name
    run.mkdir(parents=True)
    config = {"track": track, "seed": 0, "run_dir": str(run), "env": {"preset": "easy"}} | settings
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    rows = [(1000 * (i + 1), value, value / 100) for i, value in enumerate(returns)]
    return write_metrics(run, ["episode/return", "evaluation/success_rate"], rows)


def write_metrics(run: Path, columns: list[str], rows: Iterable[tuple]) -> Path:
    """Replace the metrics of a run; a row begins with env_steps, and None is an empty cell."""
    with (run / "metrics.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([["env_steps", *columns], *rows])
    return run


def curves_of(folder: Path, **options):
    runs, problems = read_runs(find_runs([folder]))
    return learning_curves(runs, problems=problems, **options)


def at(curve, env_steps: float) -> tuple[float, float, float, int]:
    index = int(np.abs(curve.x - env_steps).argmin())
    return curve.centre[index], curve.low[index], curve.high[index], curve.seeds[index]


# --- values ---


def test_running_mean_between_and_beyond_rows():
    steps, values = np.array([10.0, 20, 30, 60]), np.array([1.0, 2, 6, 12])
    grid = np.array([-1.0, 0, 20, 45, 60, 71])
    expected = [np.nan, 1, (1 + 2 + 6) / 3, 8, 12, np.nan]  # 45: halfway between 4, of the row at 30, and 12
    np.testing.assert_allclose(resample(steps, values, grid, window=20.0), expected)
    values[2] = np.nan  # looked for at 30, and not found
    expected = [np.nan, 1, (1 + 2) / 2, np.nan, 12, np.nan]
    np.testing.assert_allclose(resample(steps, values, grid, window=20.0), expected)


def test_a_short_run_is_drawn_without_steps():
    steps, grid = np.arange(1.0, 21.0) * 500, np.linspace(500, 10_000, 240)
    np.testing.assert_allclose(resample(steps, steps, grid, window=200.0), grid)  # 2 % of the run: less than a row
    np.testing.assert_allclose(resample(steps, steps, grid, window=1400.0)[30:-30], grid[30:-30])  # two or three rows


def test_mean_and_standard_deviation_over_seeds(tmp_path):
    for seed, value in enumerate((1.0, 2.0, 6.0)):
        write_run(tmp_path, f"dreamer_v3_circle_paper_seed{seed}", [value] * 4, seed=seed)
    (curve,) = curves_of(tmp_path).curves
    assert curve.key == CurveKey("circle", "dreamer_v3", "paper")
    spread = np.sqrt((4 + 1 + 9) / 2)  # of a sample: n − 1
    np.testing.assert_allclose(at(curve, 2500), (3.0, 3 - spread, 3 + spread, 3))


@pytest.mark.parametrize("aggregate", ["mean", "iqm"])
def test_a_seed_that_ends_early_is_named_and_a_single_one_has_no_band(tmp_path, aggregate):
    write_run(tmp_path, "dreamer_v3_circle_seed0", [5.0] * 10, seed=0)
    write_run(tmp_path, "dreamer_v3_circle_seed1", [5.0] * 5, seed=1)
    result = curves_of(tmp_path, aggregate=aggregate)
    assert result.problems == ["dreamer_v3_circle_seed1 ends at 5,000 of 10,000 env_steps: fewer seeds after that"]
    (curve,) = result.curves
    assert at(curve, 4000) == (5.0, 5.0, 5.0, 2)
    np.testing.assert_array_equal(at(curve, 8000), (5.0, np.nan, np.nan, 1))


# --- evaluations without a value ---


def write_laps(folder: Path, seed: int, laps: list[float | None]) -> Path:
    """A run with an evaluation after 1000, 2000 ... env_steps, some without a lap."""
    run = write_run(folder, f"ppo_circle_seed{seed}", algorithm="ppo", seed=seed)
    rows = [row for i, lap in enumerate(laps) for row in ((1000 * i + 500, None, None), (1000 * (i + 1), 20, lap))]
    return write_metrics(run, ["evaluation/num_episodes", "evaluation/lap_time_mean"], rows)  # with rows of training


def test_no_lap_is_drawn_where_none_was_flown(tmp_path):
    write_laps(tmp_path, 0, [None, 6.0, None, 5.0, 4.0])
    result = curves_of(tmp_path, quantities=["lap_time"], window=100.0)
    (curve,) = result.curves
    drawn = [at(curve, env_steps)[0] for env_steps in range(1000, 5500, 500)]
    np.testing.assert_allclose(drawn, [np.nan, np.nan, 6.0, np.nan, np.nan, np.nan, 5.0, 4.5, 4.0], rtol=0.01)
    assert result.problems == []


def test_laps_of_fewer_than_half_of_the_seeds_are_not_drawn(tmp_path):
    write_laps(tmp_path, 0, [7.0, 6.0, 6.0, 5.0])
    write_laps(tmp_path, 1, [None, 4.0, 4.0])  # ends early: then it does not count
    write_laps(tmp_path, 2, [None, None, 2.0, 3.0])
    result = curves_of(tmp_path, quantities=["lap_time"], window=100.0)
    (curve,) = result.curves
    np.testing.assert_array_equal(at(curve, 1000), (np.nan, np.nan, np.nan, 1))  # 1 of 3
    np.testing.assert_allclose(at(curve, 2000), (5.0, 5 - np.sqrt(2), 5 + np.sqrt(2), 2))  # 2 of 3
    np.testing.assert_allclose(at(curve, 3000), (4.0, 2.0, 6.0, 3))
    np.testing.assert_allclose(at(curve, 4000), (4.0, 4 - np.sqrt(2), 4 + np.sqrt(2), 2), atol=0.02)
    assert [problem for problem in result.problems if "has no value" in problem] == [
        "Mean lap time (s, deterministic): where a seed has no value, the mean of the others; "
        "a gap where fewer than half of the seeds have one (1 of 1 curves)"
    ]


def test_a_seed_that_never_flew_a_lap_counts_as_one_without(tmp_path):
    write_laps(tmp_path, 0, [None, 6.0])
    for seed in (1, 2):
        write_metrics(write_laps(tmp_path, seed, []), ["evaluation/num_episodes"], [(1000, 20), (2000, 20)])
    result = curves_of(tmp_path, quantities=["lap_time"])
    assert np.isnan(result.curves[0].centre).all() and result.curves[0].seeds.max() == 1
    assert "no values of evaluation/lap_time_mean: ppo_circle_seed1, ppo_circle_seed2" in result.problems


def test_the_stochastic_policy_can_be_drawn(tmp_path):
    columns = ["evaluation_stochastic/success_rate", "evaluation_stochastic/gates_per_episode"]
    write_metrics(write_run(tmp_path, "ppo_circle_seed0"), columns, [(1000, 0.5, 7), (2000, 0.5, 7)])
    rate, gates = curves_of(tmp_path, quantities=["stochastic_success_rate", "stochastic_gates"]).curves
    assert (rate.centre[-1], gates.centre[-1]) == (0.5, 7.0)


def test_interquartile_mean_is_that_of_the_middle_half():
    assert interquartile_mean(np.array([100.0, 1, 2, 3, -50])) == 2.0  # the middle three of five
    assert interquartile_mean(np.array([1.0, 2, 6])) == 3.0  # nothing to cut


def test_bootstrap_draws_within_strata():
    constant = [np.full((3, 1), 1.0), np.full((3, 1), 9.0)]  # pooled draws would give 1 ... 9
    np.testing.assert_allclose(bootstrap_interval(constant), [[5.0], [5.0]])
    scores = np.random.default_rng(1).normal(size=(400, 1))
    low, high = bootstrap_interval([scores], statistic=lambda x: x.mean(0)).ravel()
    half = 1.96 * scores.std() / 20  # of the mean, by the normal distribution
    np.testing.assert_allclose([low, high], [scores.mean() - half, scores.mean() + half], atol=0.015)


def test_iqm_pools_tracks_only_where_values_are_comparable(tmp_path):
    for track, value in (("circle", 20.0), ("kidney", 60.0)):
        for seed in range(2):
            write_run(tmp_path, f"dreamer_v3_{track}_seed{seed}", [value] * 2, track=track, seed=seed)
    write_run(tmp_path, "ppo_circle_seed0", [0.0] * 2, algorithm="ppo")  # not on every track: not pooled
    curves = curves_of(tmp_path, quantities=["return", "success_rate"], aggregate="iqm").curves
    pooled = [curve for curve in curves if curve.key.track == ALL_TRACKS]
    assert [(curve.key.algorithm, curve.quantity) for curve in pooled] == [("dreamer_v3", "success_rate")]
    np.testing.assert_allclose(at(pooled[0], 1500), (0.4, 0.4, 0.4, 4))


def test_a_raise_is_a_whole_increment(tmp_path):
    run = write_run(tmp_path, "run", [], curriculum={"increment": 0.001})
    weights = [0, 0, 0.0005, 0.001, 0.001, 0.0017, 0.003, 0.003]  # rows between two levels are means of both
    write_metrics(run, ["curriculum/body_rate_weight"], [(1000 * i, weight) for i, weight in enumerate(weights)])
    ((data,), _) = read_runs([run])
    np.testing.assert_array_equal(weight_raises(data), [3000, 6000])


@pytest.mark.parametrize("window", [None, 700.0])
def test_curves_survive_their_file(tmp_path, window):
    for seed in range(3):
        write_run(tmp_path / "runs", f"dreamer_v3_circle_seed{seed}", [seed, seed + 1.5], seed=seed)
    (tmp_path / "runs" / "dreamer_v3_circle_seed2" / "metrics.csv").write_text("")
    before = curves_of(tmp_path / "runs", window=window)
    write_curves(tmp_path / "curves.csv", before)
    after = read_curves(tmp_path / "curves.csv")
    assert (after.aggregate, after.window) == ("mean", window or 0.02 * 2000)
    assert after.problems == before.problems != []
    for old, new in zip(before.curves, after.curves, strict=True):
        assert (old.key, old.quantity) == (new.key, new.quantity)
        np.testing.assert_array_equal(old.seeds, new.seeds)
        np.testing.assert_allclose(new.x, old.x, atol=0.5)
        for name in ("centre", "low", "high"):
            np.testing.assert_allclose(getattr(new, name), getattr(old, name), rtol=1e-5)
    with pytest.raises(ValueError, match="no learning curves"):
        read_curves(tmp_path / "runs" / "dreamer_v3_circle_seed0" / "metrics.csv")


# --- along a clock ---


@pytest.mark.parametrize(("axis", "clock", "longest"), [("hours", "wall_clock", 4.0), ("core_hours", "cpu_clock", 2.0)])
def test_runs_of_different_speed_are_compared_at_the_same_hour(tmp_path, axis, clock, longest):
    """The second run makes its env_steps in half the time, the third notes none: it is left out by name."""
    for algorithm, hour in (("ppo", 7200.0), ("sac", 3600.0)):
        run = write_run(tmp_path, f"{algorithm}_circle_seed0", algorithm=algorithm)
        rows = [(1000, 1.0, hour, hour / 2), (2000, 3.0, 2 * hour, hour)]
        write_metrics(run, ["episode/return", "wall_clock", "cpu_clock"], rows)
    write_run(tmp_path, "dreamer_v3_circle_seed0")
    resumed = write_run(tmp_path, "latent_ppo_circle_seed0", algorithm="latent_ppo")  # where the clock is not known
    rows = [(1000, 1.0, 3600.0, 1800.0), (2000, 3.0, "", "")]
    write_metrics(resumed, ["episode/return", "wall_clock", "cpu_clock"], rows)
    drawn = curves_of(tmp_path, axis=axis)
    assert f"dreamer_v3_circle_seed0 left out: it has no {clock}, which axis={axis} needs" in drawn.problems
    assert f"latent_ppo_circle_seed0 left out: its {clock} ends at 1,000 env_steps" in drawn.problems
    slow, fast = drawn.curves
    assert (drawn.axis, slow.x[-1], slow.key.algorithm) == (axis, longest, "ppo")
    for curve, hours, value in ((slow, 0.75, 2.0), (fast, 0.375, 2.0), (fast, 0.5, 3.0)):
        assert np.interp(hours * longest, curve.x, curve.centre) == pytest.approx(value, abs=0.1)
    assert np.isnan(fast.centre[fast.x > 0.51 * longest]).all()
    write_curves(tmp_path / "curves.csv", drawn)
    again = read_curves(tmp_path / "curves.csv")
    assert again.axis == axis
    np.testing.assert_allclose(again.curves[0].x, slow.x, rtol=1e-5)
    with pytest.raises(ValueError, match=r"axis=minutes: must be one of env_steps, hours, core_hours"):
        curves_of(tmp_path, axis="minutes")


# --- which runs make a curve ---


def test_runs_are_found_but_not_inside_of_runs(tmp_path):
    runs = [write_run(tmp_path / "a" / "b", "one"), write_run(tmp_path, "two")]
    for run in runs:
        write_run(run, "best")
    assert find_runs([tmp_path]) == find_runs([tmp_path / "a", f"{tmp_path}/t*", runs[0]]) == sorted(runs)
    with pytest.raises(ValueError, match=r"runs=.*nothing.*no run directory"):
        find_runs([tmp_path / "nothing"])


@pytest.mark.parametrize(
    ("name", "settings", "key"),
    [
        ("dreamer_v3_circle_paper_seed3", {}, ("circle", "dreamer_v3", "paper")),
        ("ppo_figure8_decoys_no_noise_seed10", {"algorithm": "ppo", "track": "figure8_decoys"},
         ("figure8_decoys", "ppo", "no_noise")),
        ("sac_mine_seed0", {"algorithm": "sac", "track": "tracks/mine.yaml"}, ("mine", "sac", "")),
        ("dreamer_v3_circle_20260101-120000", {}, ("circle", "dreamer_v3", "")),
        ("dreamer_v3_cartpole_swingup_wide_seed0", {"task": "cartpole_swingup", "env": {"suite": "dmc"}},
         ("cartpole_swingup", "dreamer_v3", "wide")),
    ],
)  # fmt: skip
def test_names_say_the_variant(tmp_path, name, settings, key):
    ((run,), _) = read_runs([write_run(tmp_path, name, **settings)])
    assert run.key == key


def variants(folder: Path) -> list[str]:
    """The variants of a folder's curves."""
    runs, _ = read_runs(find_runs([folder]))
    return [key.variant for key in group_runs(runs)]


def test_mixed_configurations_are_curves_of_their_own_named_by_the_overrides_that_differ(tmp_path):
    for seed, given in enumerate(((), (), ("env.preset=faithful",), ("tuned=race", "+decoys=paper"))):
        settings = {"env": {"preset": "faithful"}} if seed == 2 else {"decoys": "paper"} if seed == 3 else {}
        name = f"dreamer_v3_circle_2026010{seed}"  # as recipes name them
        run = write_run(tmp_path, name, [float(seed)] * 2, seed=seed, **{"decoys": None} | settings)
        overrides = [f"seed={seed}", "track=circle", "logger.every=5", *given]
        (run / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    curves = curves_of(tmp_path).curves
    assert [(curve.key.variant, curve.centre[-1], curve.seeds.max()) for curve in curves] == [
        ("", 0.5, 2),  # of both that are set alike
        ("decoys=paper, tuned=race", 3.0, 1),
        ("env.preset=faithful", 2.0, 1),
    ]
    assert [curve.key.is_reference for curve in curves] == [True, False, False]


def test_settings_name_curves_whose_command_lines_do_not(tmp_path):
    for seed, (preset, tilt) in enumerate((("easy", 25), ("faithful", 25), ("faithful", 20))):
        env = {"env": {"preset": preset, "camera_tilt": tilt, "zoom": seed}}
        write_run(tmp_path, f"dreamer_v3_circle_paper_seed{seed}", seed=seed, device=f"cuda:{seed}", **env)
    assert variants(tmp_path) == [
        "paper env.camera_tilt=20, env.preset=faithful, …",  # no more than tells them apart: not their zoom
        "paper env.camera_tilt=25, env.preset=easy, …",
        "paper env.camera_tilt=25, env.preset=faithful, …",
    ]


def test_a_track_file_that_was_edited_between_two_runs_makes_two_curves(tmp_path):
    for seed, described in enumerate(('{"name": "mine"}', '{"name": "mine", "laps": 2}')):
        write_run(tmp_path, f"ppo_mine_seed{seed}", seed=seed, track="mine.yaml", track_description=described)
    assert [len(variant) for variant in variants(tmp_path)] == [len("track_description=01234567")] * 2
    for seed, folder in enumerate(("a", "b")):  # from before tracks were noted
        write_run(tmp_path / "old", f"ppo_mine_seed{seed}", seed=seed, track=f"{folder}/mine.yaml")
    assert variants(tmp_path / "old") == ["(1)", "(2)"]


def test_a_setting_that_an_older_version_did_not_have_is_no_difference(tmp_path):
    for seed, decoys in enumerate(({}, {"decoys": None}, {"decoys": {"count": 4}})):
        write_run(tmp_path, f"dreamer_v3_circle_seed{seed}", seed=seed, **decoys)
    assert curves_of(tmp_path).curves[0].seeds.max() == 3
    write_run(tmp_path, "dreamer_v3_circle_seed3", seed=3, decoys={"count": 2})
    drawn = {curve.key.variant: curve.seeds.max() for curve in curves_of(tmp_path).curves}
    assert drawn == {"decoys.count=2": 1, "decoys.count=4": 3}  # unlike seed 2, but not unlike the first


def test_runs_that_differ_in_what_does_not_matter_are_one_curve(tmp_path):
    write_run(tmp_path, "dreamer_v3_circle_seed0", seed=0, device="cpu", total_env_steps=10, logger={"every": 10})
    write_run(tmp_path, "dreamer_v3_circle_seed1", seed=1, device="cuda", total_env_steps=20, logger={"every": 20})
    runs, _ = read_runs(find_runs([tmp_path]))
    assert [[run.seed for run in group] for group in group_runs(runs).values()] == [[0, 1]]
    assert [run.seed for run in first_of_each_curve(runs)] == [0]


def test_a_ramp_over_the_run_makes_its_length_matter(tmp_path):
    for folder, by, curves in (("a", "run", 2), ("b", "passes", 1)):
        for seed in (0, 1):
            schedule = {"rates": {"to": 0.3, "by": by}}
            run = f"dreamer_v3_circle_seed{seed}"
            write_run(tmp_path / folder, run, seed=seed, total_env_steps=10 + seed, schedule=schedule)
        runs, _ = read_runs(find_runs([tmp_path / folder]))
        assert len(group_runs(runs)) == curves


def test_a_run_whose_drone_file_is_lost_is_left_out(tmp_path):
    write_run(tmp_path, "dreamer_v3_circle_seed0", seed=0, env={"preset": "drone.yaml"})
    runs, (problem,) = read_runs(find_runs([tmp_path]))
    assert not runs and "left out: There is no drone.yaml: copy drone.yaml there" in problem


def test_a_run_that_was_resumed_with_other_settings_is_named(tmp_path):
    write_run(tmp_path, "dreamer_v3_circle_seed0", seed=0)
    directory = RunDirectory(tmp_path / "dreamer_v3_circle_seed0")
    directory.note_start(0, ["track=circle"], None)
    directory.note_start(500, ["track=circle", "device=cpu", "total_env_steps=1000"], None)
    directory.note_start(1000, ["track=circle", "loss.entropy_scale=0.1"], None)
    _, problems = read_runs(find_runs([tmp_path]))
    words = "resumed at 1,000 env_steps with other loss.entropy_scale; drawn with its last settings"
    assert problems == [f"dreamer_v3_circle_seed0: {words}"]
    directory.starts.write_text("3\n")
    runs, (problem,) = read_runs(find_runs([tmp_path]))
    assert not runs and "left out: starts.jsonl is damaged" in problem


def test_of_the_same_seed_twice_the_longer_run_counts(tmp_path):
    write_run(tmp_path / "a", "first", [1.0] * 3)
    write_run(tmp_path / "b", "again", [5.0] * 2)
    result = curves_of(tmp_path)
    assert at(result.curves[0], 1500)[::3] == (1.0, 1)
    assert result.problems == ["again left out: same settings and seed as first, which has at least as many env_steps"]
    ((first,), _), ((again,), _) = (read_runs([tmp_path / name]) for name in ("a/first", "b/again"))
    with pytest.raises(ValueError, match="same run twice.*seed: 0"):
        learning_curves([first, again])


# --- files in any state ---


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("metrics.csv", None, "it has no metrics.csv"),
        ("config.yaml", None, "it has no config.yaml"),
        ("metrics.csv", b"", "metrics.csv has no rows"),
        ("metrics.csv", b"env_steps,episode/return\n", "metrics.csv has no rows"),
        ("metrics.csv", b"\x89PNG\r\n\x00\xff\n" * 9, "no column env_steps"),
        ("config.yaml", b"a: [b", "config.yaml is not YAML"),
        ("config.yaml", b"just words", "config.yaml holds no settings"),
    ],
)
def test_unreadable_runs_are_named_and_left_out(tmp_path, name, content, words):
    write_run(tmp_path, "dreamer_v3_circle_seed0", [5.0, 5.0])
    spoilt = write_run(tmp_path, "dreamer_v3_circle_seed1", [9.0, 9.0], seed=1) / name
    spoilt.unlink()
    if content is not None:
        spoilt.write_bytes(content)
    result = curves_of(tmp_path)
    assert at(result.curves[0], 1500)[::3] == (5.0, 1)
    (problem,) = result.problems
    assert problem.startswith("dreamer_v3_circle_seed1 left out: ") and words in problem


def test_no_run_to_draw_is_refused_with_the_reasons(tmp_path):
    (write_run(tmp_path, "lonely") / "metrics.csv").unlink()
    with pytest.raises(ValueError, match="no run to draw. lonely left out: it has no metrics.csv"):
        curves_of(tmp_path)


@pytest.mark.parametrize(
    ("text", "steps", "values", "problems"),
    [
        ("1,5\n2,6\n3,7", [1, 2], [5, 6], ["its last row is cut short"]),
        ("1,5\n2\n3,7\n", [1, 3], [5, 7], ["1 of 3 rows are incomplete"]),
        ("1,5\nx,6\n3,7\n", [1, 3], [5, 7], ["1 of 3 rows have no number of env_steps"]),
        ("1,5\n2,?\n3,\n4,nan\n", [1], [5], ["1 cells are not numbers"]),
        ("3,7\n1,5\n", [1, 3], [5, 7], []),
    ],
)
def test_half_written_files_are_read_as_far_as_they_go(tmp_path, text, steps, values, problems):
    path = tmp_path / "metrics.csv"
    path.write_text("env_steps,loss\n" + text)
    table = read_metrics(path)
    assert table.problems == problems
    for found, expected in zip(table.columns["loss"], (steps, values), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_only_wanted_columns_are_read(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("env_steps,a,b,empty\n1,x,2,\n")
    table = read_metrics(path, ["b", "c", "empty"])
    assert list(table.columns) == ["b"] and table.problems == []


def test_what_a_run_does_not_log_is_named(tmp_path):
    write_run(tmp_path, "dreamer_v3_circle_seed0")
    result = curves_of(tmp_path, quantities=["return", "lap_time"])
    assert [curve.quantity for curve in result.curves] == ["return"]
    assert result.problems == ["no values of evaluation/lap_time_mean: all runs of dreamer_v3 circle"]
    with pytest.raises(ValueError, match="no run has values of lap_time"):
        curves_of(tmp_path, quantities=["lap_time"])
    with pytest.raises(ValueError, match="quantities=speed: must be one of return"):
        curves_of(tmp_path, quantities=["speed"])


def test_evaluations_by_env_steps_then_those_after_training(tmp_path):
    folder = tmp_path / "evaluations"
    folder.mkdir()
    for name in ("000000200", "000000100", "000000100_stochastic"):
        (folder / f"{name}_trajectory.csv").touch()
    after = [tmp_path / f"evaluation{suffix}" / "evaluations" for suffix in ("", "_2", "_10", "_x")]
    for place in after:
        place.mkdir(parents=True)
        for policy in ("deterministic", "stochastic"):
            (place / f"{policy}_trajectory.csv").touch()
    first, second, *others = evaluation_files(tmp_path, "_trajectory.csv")
    assert [first, second] == [folder / f"000000{n}00_trajectory.csv" for n in (1, 2)]
    assert others == [place / "deterministic_trajectory.csv" for place in after[:3]]
    (folder / "000000100.json").write_text('{"gates_per_episode": 2, "return_mean": 7.5}')
    assert evaluation_score(first) == (2.0, 7.5) > evaluation_score(second)
    (folder / "000000100.json").write_text('{"gates_per_episode": null, "return_mean": 7.5}')
    assert evaluation_score(first) == evaluation_score(second)


def test_tables_that_results_keep_are_drawn_by_their_names(tmp_path):
    folder = tmp_path / "ppo_state"
    for name in ("circle_seed0", "circle_seed1", "figure8_decoys_wide_seed3"):
        run = write_run(tmp_path / "made", name)
        folder.mkdir(exist_ok=True)
        (run / "metrics.csv").rename(folder / f"metrics_{name}.csv")
    for place in (folder, tmp_path / "ppo_*" / "metrics_*.csv"):
        runs, problems = read_runs(find_runs([place]))
        assert [(run.key, run.seed) for run in runs] == [
            (CurveKey("circle", "", "ppo_state"), 0),
            (CurveKey("circle", "", "ppo_state"), 1),
            (CurveKey("figure8_decoys", "", "ppo_state wide"), 3),
        ]
        assert problems == []
    assert [at(curve, 2000)[0] for curve in learning_curves(runs).curves] == [10.0, 10.0]


def test_the_columns_of_a_table_say_who_learned():
    """Of those that results keep: what their pages say trained them."""
    results = Path(__file__).parents[2] / "results"
    for name, algorithm in (
        ("dreamer_v3/metrics_circle_seed0.csv", "dreamer_v3"),
        ("latent_ppo/metrics_kidney_seed1.csv", "latent_ppo"),
        ("baselines_from_pixels/metrics_sac_circle.csv", "sac"),
        ("split_s/metrics_ppo_state.csv", "ppo"),
    ):
        ((run,), _) = read_runs(find_runs([results / name]), ["episode/return"])
        assert run.key.algorithm == algorithm
        folder = name.partition("/")[0]
        words = run.key.variant.split()
        assert words[:1] == ([] if folder == algorithm else [folder])
        assert algorithm not in words
