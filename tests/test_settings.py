"""Settings: which numbers are taken, and what is said of others."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest

from dreamer_racing.settings import COUNT, FINITE, POSITIVE_SHARE, Range, check_settings, setting


@dataclass
class Settings:
    """One of each kind."""

    share: float = setting(0.5, POSITIVE_SHARE)
    count: int = setting(3, COUNT)
    port: int | None = setting(None, Range(1, 65535))
    weight: float = setting(1.0, FINITE)


@pytest.mark.parametrize(
    "change",
    [
        {"share": 1}, {"share": np.float32(0.5)}, {"share": np.float64(1.0)}, {"share": np.int64(1)},
        {"share": Fraction(1, 3)}, {"count": np.int32(2)}, {"count": 10**30}, {"port": None}, {"port": np.uint16(80)},
        {"weight": -1e300}, {"weight": np.float16(-3)},
    ],
)  # fmt: skip
def test_numbers_of_any_kind_are_taken(change):
    check_settings(Settings(**change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"share": "fast"}, "of.share='fast': must be a number, above 0 and at most 1."),
        ({"share": True}, "of.share=True: must be a number, above 0 and at most 1."),
        ({"share": [0.5]}, "of.share=[0.5]: must be a number, above 0 and at most 1."),
        ({"share": 1j}, "of.share=1j: must be a number, above 0 and at most 1."),
        ({"share": None}, "of.share=None: must be a number, above 0 and at most 1."),
        ({"share": 0}, "of.share=0: must be above 0 and at most 1."),
        ({"share": np.float32(1.5)}, "of.share=1.5: must be above 0 and at most 1."),
        ({"share": math.nan}, "of.share=nan: must be above 0 and at most 1."),
        ({"count": 2.5}, "of.count=2.5: must be a whole number, at least 1."),
        ({"count": 0.5}, "of.count=0.5: must be at least 1."),
        ({"count": math.inf}, "of.count=inf: must be at least 1, and finite."),
        ({"port": 80.5}, "of.port=80.5: must be a whole number, at least 1 and at most 65535."),
        ({"weight": math.nan}, "of.weight=nan: must be finite."),
        ({"weight": math.inf}, "of.weight=inf: must be finite."),
        ({"weight": -math.inf}, "of.weight=-inf: must be finite."),
    ],
)  # fmt: skip
def test_what_is_none_or_out_of_range_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_settings(Settings(**change), "of.")
