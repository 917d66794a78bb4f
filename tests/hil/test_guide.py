"""The pages on flight have every limit with its default, every reason, and every source and link that there is."""

from __future__ import annotations

import re
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from dreamer_racing.hil.links import LINKS
from dreamer_racing.hil.operator import DEAD_MAN
from dreamer_racing.hil.pose_sources import POSE_SOURCES
from dreamer_racing.hil.safety import Reason, State
from dreamer_racing.hil.safety_limits import BELOW_FLOOR, SafetyLimits
from dreamer_racing.hil.stamping import Stamping
from dreamer_racing.hil.view import PORT

DOCS = Path(__file__).parents[2] / "docs"
SAFETY = (DOCS / "hil_safety.md").read_text(encoding="utf-8")
TEXT = "".join(page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("hil*.md")))
LIMITS = SAFETY.partition("## Limits")[2].partition("\n## ")[0]
ROWS = {
    name: cells.split(" | ") for name, cells in re.findall(r"^\| (?:\*\*)?`(\w+)`(?:\*\*)? \| (.*) \|$", LIMITS, re.M)
}


@pytest.mark.parametrize("limit", fields(SafetyLimits), ids=lambda limit: limit.name)
def test_every_limit_is_there_with_its_default(limit):
    default, says = ROWS[limit.name]
    assert says
    if limit.default is MISSING:
        assert default.startswith("the track's")
    else:
        numbers = [float(number) for number in re.findall(r"[\d.]+", default)]
        assert numbers == list(limit.default if isinstance(limit.default, tuple) else [limit.default])


def test_no_limit_is_there_that_is_none():
    assert ROWS.keys() == {limit.name for limit in fields(SafetyLimits)}


@pytest.mark.parametrize("reason", Reason, ids=lambda reason: reason.name)
def test_every_reason_is_there(reason):
    assert f"*{reason.value}*" in " ".join(TEXT.split())


@pytest.mark.parametrize("name", [*LINKS, *POSE_SOURCES, *(each.value for each in (*State, *Stamping))])
def test_every_choice_is_there(name):
    assert f"`{name}`" in TEXT


def test_numbers_in_the_text():
    assert f"{BELOW_FLOOR:g} m lower" in ROWS["fence_low"][0]
    assert f"lapses after {DEAD_MAN:g} s without" in TEXT and f"`view={PORT}`" in TEXT
