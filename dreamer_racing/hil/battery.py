"""Tracks the battery's voltage from telemetry, for the thrust map.

There is no clock and no I/O in here: the same readings give the same voltages, so a recorded flight can be played back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from dreamer_racing.settings import ALLOWED, POSITIVE, Range, check_settings, setting

STALE = 2.0  # s without a plausible reading after which the voltage counts as old [choice]; it keeps its value


class Reading(NamedTuple):
    """A voltage and when it arrived."""

    time: float  # s, `time.monotonic`
    voltage: float  # V, of the whole battery


@dataclass(frozen=True, kw_only=True)
class BatteryConfig:
    """A battery's expected voltage, and how readings of it are checked and smoothed."""

    voltage: float = field(metadata={ALLOWED: POSITIVE})  # V, assumed until the first reading
    # share of `voltage` by which a reading may differ from it; one that differs more is rejected, as it may be of a
    # single cell
    tolerance: float = setting(0.25, Range(0, 0.5))
    # s, time constant of a low-pass that smooths out short bursts of throttle
    smoothing: float = setting(0.5, Range(0, 60))

    def __post_init__(self) -> None:
        check_settings(self, "BatteryConfig.")

    @property
    def limits(self) -> tuple[float, float]:
        """Least and largest voltage that is accepted, V."""
        return self.voltage * (1.0 - self.tolerance), self.voltage * (1.0 + self.tolerance)


class Battery:
    """Filters the readings of a battery's voltage.

    The first plausible reading is taken unfiltered, later ones pass the low-pass. Without readings the voltage keeps
    its last value, initially that of the configuration.

    Attributes:
        voltage: V, now.
        readings: Number of plausible readings so far.
        implausible: Number of readings beyond the tolerance so far, which are ignored.
        age: s from the last plausible reading to the last update; infinite before the first.

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
        """Process readings, oldest first; return the voltage, V, which is always within `BatteryConfig.limits`."""
        low, high = self.config.limits
        for time, voltage in readings:
            if low <= voltage <= high:
                self.readings += 1
                if self._heard_at is None or self.config.smoothing == 0.0:
                    gain = 1.0
                else:  # exact for a voltage that is constant from one reading to the next
                    gain = -math.expm1(-max(time - self._heard_at, 0.0) / self.config.smoothing)
                self.voltage += gain * (voltage - self.voltage)
                self._heard_at = time
            else:
                self.implausible += 1
        if self._heard_at is not None:
            self.age = now - self._heard_at
        return self.voltage

    def summary(self) -> dict[str, Any]:
        """Return counts of readings and the age of the last one, s, as JSON values; an age of None: there was none."""
        age = self.age if math.isfinite(self.age) else None
        return {"readings": self.readings, "implausible": self.implausible, "last_reading_age_s": age}


def battery_words(battery: dict[str, Any]) -> str:
    """Return, in words, the voltage that the thrust map used at the end of a flight, and where it came from."""
    if not battery["readings"]:
        return f"battery: no usable reading; thrust was computed with voltage={battery['voltage_set']:g}"
    age = battery["last_reading_age_s"]
    old = f", the last one {age:.1f} s before the end: STALE" if age > STALE else ""
    left_out = f", {battery['implausible']} implausible ones ignored" if battery["implausible"] else ""
    return f"battery: {battery['voltage']:.2f} V at the end, from {battery['readings']} readings{left_out}{old}"
