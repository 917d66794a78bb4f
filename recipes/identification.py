"""Fit the parameters of a vehicle's rate loop, motors and thrust to a flight, and write a drone for training.

    python recipes/hil.py actor=identify track=circle arm=true     # flies what tells most: small steps about a hover
    python recipes/identification.py flight=runs/hil_circle_20260101-120000 output=drone.yaml
    python recipes/dreamer_v3.py env=betaflight env.preset=drone.yaml

Any flight of recipes/hil.py that moves all axes will do, or a table (.csv, .csv.gz) with one row per ms. Parameters
that it does not determine stay as in preset=, and are named. More: docs/betaflight.md, "Your own drone".
"""

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from composing.entry import plain_errors, recipe

from dreamer_racing.envs.drone.parameters import SUFFIXES

if TYPE_CHECKING:
    from dreamer_racing.identification.fitting import Fit


@dataclass
class IdentificationConfig:
    """Configuration of `recipes/identification.py`."""

    flight: str | None = None  # recorded flight: folder of recipes/hil.py, its file, or a table
    preset: str = "betaflight"  # initial values: a preset with a Betaflight, or a drone's file; mass and inertia stay
    output: str = "drone.yaml"  # the file to write

    def check(self) -> None:
        """Refuse an output name that would fail only after the fit."""
        if not self.output.endswith(SUFFIXES):
            raise ValueError(f"output={self.output}: the name of the file must end in {' or '.join(SUFFIXES)}.")


@recipe("identification", IdentificationConfig)
def main(config: IdentificationConfig) -> None:
    """Fit a drone to the flight, write it, and print the results."""
    with plain_errors():
        if config.flight is None:
            raise ValueError("flight= is missing: a folder in which recipes/hil.py flew, or a table.")
        from dreamer_racing.envs.drone.parameters import load_preset, save_drone
        from dreamer_racing.identification.fitting import fit
        from dreamer_racing.identification.recorded import read_recorded

        recorded = read_recorded(config.flight)
        recorded.check(f"flight={config.flight}")
        nominal = recorded.drone(load_preset(config.preset))
        if recorded.thrust_map is not None:
            print(f"as in the flight: {nominal.mass:g} kg, {4 * nominal.rotor_thrust_max:.4g} N at full command")
        logging.getLogger("dreamer_racing.identification").setLevel(logging.INFO)
        found = fit(recorded, nominal)
        if not all(math.isfinite(error) for error in found.errors.values()):
            raise ValueError("The fit diverged: start from a preset= closer to the drone.")
        save_drone(Path(config.output), found.parameters, sources(config, found))
        for line in found.lines(config.preset):
            print(line)
        print(f"written to {config.output}: env=betaflight env.preset={config.output}")


def sources(config: IdentificationConfig, found: "Fit") -> dict[str, Any]:
    """Return where the numbers of a drone's file come from."""
    return {
        "flight": Path(config.flight or "").name,
        "begun_with": Path(config.preset).name,
        "error_of_rates": {axis: round(error, 4) for axis, error in found.errors.items()},
        "not_told": list(found.unknown),
    }


if __name__ == "__main__":
    main()
