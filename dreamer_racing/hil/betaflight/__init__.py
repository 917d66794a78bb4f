"""Betaflight: the settings that an actor needs, why a flight controller does not arm, and the firmware as a process.

    python -m dreamer_racing.hil.betaflight print --contract agents/kidney/contract.json --link crsf
    python -m dreamer_racing.hil.betaflight check --contract agents/kidney/contract.json --link crsf --dump dump.txt

The first prints lines for the flight controller's CLI. The second reads the output of ``dump all`` or ``diff all``, and
exits with status 1 if a setting differs or is missing, 2 if there is nothing to compare.
"""

from dreamer_racing.hil.betaflight.settings import (
    LINKS,
    Status,
    check_dump,
    gains_unlike_training,
    print_settings,
    rate_map,
    require_dump,
    wanted_settings,
)

__all__ = [
    "LINKS",
    "Status",
    "check_dump",
    "gains_unlike_training",
    "print_settings",
    "rate_map",
    "require_dump",
    "wanted_settings",
]
