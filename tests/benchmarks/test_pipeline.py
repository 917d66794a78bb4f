"""`benchmarks/pipeline.py`: the model says what can be worked out by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.running_recipes import ROOT, module_of

pipeline = module_of("benchmarks", "pipeline")
IDEAL = pipeline.Pipeline(fly=1.0, learn=0.01, weights=0.0, link=1e15, copy=1e15, overhead=0.0, scatter=0.0)
"""Nothing costs but flying and, little, learning."""


@pytest.mark.parametrize("workers", [1, 2, 64])
def test_where_flying_is_all_workers_add_up(workers: int) -> None:
    found = pipeline.play(IDEAL, workers, 200)
    assert found["env_steps_per_s"] == pytest.approx(1000 * workers, rel=0.02)
    assert found["held_back_by"] == "worker" and found["worker_busy"] == pytest.approx(1.0, abs=0.02)


def test_beyond_what_the_learner_learns_workers_gain_nothing() -> None:
    found = pipeline.play(IDEAL, 512, 200)
    assert found["env_steps_per_s"] == pytest.approx(100_000, rel=0.01)
    assert found["held_back_by"] == "learner" and found["weights_age"] == 2 * 512 * 16 * 8


def test_a_link_carries_what_it_carries() -> None:
    found = pipeline.play(IDEAL._replace(link=2_000 * IDEAL.sent), 8, 200)
    assert found["env_steps_per_s"] == pytest.approx(2_000 / (1 + 2_000 / 8_000), rel=0.05)
    assert found["held_back_by"] == "link"


def test_the_slowest_worker_and_deaths_hold_all_back() -> None:
    speeds = [
        pipeline.play(IDEAL._replace(scatter=scatter, deaths=deaths), 64, 500)["env_steps_per_s"]
        for scatter, deaths in ((0.0, 0.0), (0.3, 0.0), (0.3, 20.0))
    ]
    assert speeds[0] > 1.3 * speeds[1] > 1.3 * speeds[2]


@pytest.mark.parametrize(
    ("work", "cores", "done"),
    [
        ([1.0, 1.0, 1.0], 1.5, [2.0, 2.0, 2.0]),
        ([3.0, 1.0], 1.0, [4.0, 2.0]),
        ([3.0, 1.0], 4.0, [3.0, 1.0]),
        ([3.0, 1.0], 0.0, [3.0, 1.0]),
    ],
)
def test_what_runs_shares_the_cores(work: list[float], cores: float, done: list[float]) -> None:
    assert pipeline.share(np.array(work), cores) == pytest.approx(done)


@pytest.mark.parametrize(("workers", "holds_back"), [(1, "worker"), (4, "cores")])
def test_more_workers_than_cores_fly_as_much_as_the_cores_do(workers: int, holds_back: str) -> None:
    found = pipeline.play(IDEAL._replace(cores=2.0), workers, 200)
    assert found["env_steps_per_s"] == pytest.approx(1000 * min(workers, 2), rel=0.03)
    assert found["held_back_by"] == holds_back


def test_weights_age_until_what_they_flew_is_learned_from() -> None:
    alone = IDEAL._replace(learn=1.0, worlds=16, steps=8)  # 0.128 s to fly, as much to learn
    assert pipeline.play(alone, 1, 200)["weights_age_s"] == pytest.approx(0.256, rel=0.02)
    assert pipeline.play(alone._replace(cores=1.0), 1, 200)["weights_age_s"] == pytest.approx(0.512, rel=0.02)


def test_workers_are_forecast_from_processes_that_share_nothing() -> None:
    def record(processes: int, workers: int, speed: float) -> dict[str, float]:
        kind = {"processes": processes, "workers": workers}
        return {**kind, "worlds": 16, "rollout_steps": 8, "env_steps_per_s": speed, "cores": 2}

    measured = [record(1, 0, 1000.0), record(2, 0, 1500.0), record(0, 2, 1400.0)]
    (found,) = pipeline.check(measured)
    assert found["cores"] == 1.5 and found["ratio"] == pytest.approx(found["forecast"] / 1400.0)
    assert 1200.0 < found["forecast"] < 1500.0
    with pytest.raises(ValueError, match="needs one and two processes"):
        pipeline.check(measured[1:])


def test_the_forecast_that_is_published_is_that_of_the_measurement_beside_it() -> None:
    published, measured = (
        json.loads((ROOT / "results" / f"{name}.json").read_text()) for name in ("pipeline_check", "collection_on_ray")
    )
    page = (ROOT / "docs" / "scaling.md").read_text()
    for found, stored in zip(pipeline.check(measured), published, strict=True):
        assert found["forecast"] == pytest.approx(stored["forecast"])
        assert f"| {found['forecast']:,.0f} | {found['measured']:,.0f} | {found['ratio']:.2f} |" in page
