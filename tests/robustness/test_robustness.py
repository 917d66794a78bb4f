"""A small share of the attacks on every run of the suite; `faults.py` and `fuzz.py` say how to run them whole."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.robustness import faults, fuzz


@pytest.mark.slow
@pytest.mark.parametrize("kind", fuzz.CASES)
def test_input_that_nobody_means_is_taken_or_refused(kind: str) -> None:
    record = fuzz.in_a_process(kind, share=0.0125, seed=0)
    assert record["cases"] and not record["failed"], "\n".join(record["failures"])


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[faults.Arena]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        folder: Path = tmp_path_factory.mktemp("faults")
        yield faults.Arena(folder)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kill", "clock"])
def test_a_disturbed_run_ends_as_one_that_was_not(arena: faults.Arena, kind: str) -> None:
    cases = list(arena.cases(kind, Namespace(kills=2, sigterms=1, most=1, seed=0)))
    assert cases and not [case for case in cases if not case["survived"]], cases
