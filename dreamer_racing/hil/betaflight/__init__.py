"""Betaflight: what a flight controller must be set to, why it does not arm, and the firmware itself on this machine.

    python -m dreamer_racing.hil.betaflight print --contract agents/kidney/contract.json --link crsf
    python -m dreamer_racing.hil.betaflight check --contract agents/kidney/contract.json --link crsf --dump dump.txt

The first prints lines for the flight controller's CLI. The second reads what ``dump all`` or ``diff all`` gave there,
and exits with status 1 if a setting differs or is missing, 2 if there is nothing to compare.

`settings` knows what is wanted, `status` reads what a flight controller says of itself, `command_line` types into its
CLI, and `firmware` starts one that was built for a computer.
"""

from dreamer_racing.hil.betaflight.settings import (
    AXES,
    LINKS,
    Finding,
    Status,
    Wanted,
    check_dump,
    print_settings,
    rate_map,
    require_dump,
    wanted_settings,
)

__all__ = [
    "AXES",
    "LINKS",
    "Finding",
    "Status",
    "Wanted",
    "check_dump",
    "print_settings",
    "rate_map",
    "require_dump",
    "wanted_settings",
]
