"""The battery's voltage, from what the vehicle sends back: for the thrust map, which reckons with it.

There is no clock and no I/O in here: the same readings give the same voltages, so a recorded flight can be played back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from dreamer_racing.settings import ALLOWED, POSITIVE, Range, check_settings, setting

STALE = 2.0
"""s without a plausible reading after which the voltage counts as old [choice]; it stays what it was."""


class Reading(NamedTuple):
    """A voltage and when it arrived.

    Args:
        time: s, ``time.monotonic``.
        voltage: V, of the whole battery.
    """

    time: float
    voltage: float


@dataclass(frozen=True, kw_only=True)
class BatteryConfig:
    """What is known of a battery before it is heard, and what is believed of what is heard.

    Attributes:
        voltage: V, until the first reading.
        tolerance: Share of ``voltage`` by which a reading may differ from it; beyond it, it is no reading of this
            battery, but of one cell, say.
        smoothing: s, time constant of a low-pass: what counts is the battery in a flight, not in a punch.

    Raises:
        ValueError: A number is out of its range.
    """

    voltage: float = field(metadata={ALLOWED: POSITIVE})
    tolerance: float = setting(0.25, Range(0, 0.5))
    smoothing: float = setting(0.5, Range(0, 60))

    def __post_init__(self) -> None:
        check_settings(self, "BatteryConfig.")

    @property
    def limits(self) -> tuple[float, float]:
        """Least and largest voltage that is believed, V."""
        return self.voltage * (1.0 - self.tolerance), self.voltage * (1.0 + self.tolerance)


class Battery:
    """Follows a battery's voltage.

    The first plausible reading is taken as it is, later ones through the low-pass. Without readings the voltage stays
    what it was last, at first that of the configuration.

    Args:
        config: What is known of it.

    Attributes:
        voltage: V, now.
        readings: Plausible ones so far.
        implausible: Those beyond the tolerance so far, which are left out.
        age: s from the last plausible one to the last update; infinite before the first.

    Example:
        >>> battery = Battery(BatteryConfig(voltage=16.0, smoothing=0.0))
        >>> battery.update(1.2, [Reading(1.0, 15.2), Reading(1.1, 3.8)]), battery.implausible
        (15.2, 1)
    """

    def __init__(self, config: BatteryConfig) -> None:
        self.config = config
        self.voltage = config.voltage
        self.readings = self.implausible = 0
        self.age = math.inf
        self._heard_at: float | None = None

    def update(self, now: float, readings: Sequence[Reading]) -> float:
        """Take in readings, oldest first; return the voltage, V, which is always within `BatteryConfig.limits`."""
        low, high = self.config.limits
        for time, voltage in readings:
            if low <= voltage <= high:
                self.readings += 1
                self.voltage += self._gain(time) * (voltage - self.voltage)
                self._heard_at = time
            else:
                self.implausible += 1
        if self._heard_at is not None:
            self.age = now - self._heard_at
        return self.voltage

    def _gain(self, time: float) -> float:
        """Return the low-pass's, exact for a voltage that is constant from one reading to the next."""
        if self._heard_at is None or self.config.smoothing == 0.0:
            return 1.0
        return -math.expm1(-max(time - self._heard_at, 0.0) / self.config.smoothing)
