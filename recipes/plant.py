"""A drone to fly instead of a real one: this project's physics in a process of its own, not quite as in training.

    python recipes/plant.py track=figure8 mass=1.1 thrust=0.9 delay=0.02 packet_loss=0.01
    python recipes/plant.py track=kidney betaflight=2026.6

It takes commands from UDP port 9101 and sends poses to port 9100, both on this machine, until it is stopped by Ctrl+C
or SIGTERM, and says at the end what came of it. The drone stands on a launch stand at the track's start pose, until a
disarmed command and then armed ones with thrust have come.

With betaflight= a Betaflight firmware built for this machine (SITL), which must be running, flies it by its motors:
channels go to the firmware.
"""

from dataclasses import dataclass
from typing import cast

from composing.command_line import plain_errors, start_logging
from composing.entry import recipe
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.process import ProcessOptions, open_sockets, run
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle
from dreamer_racing.settings import check_settings


@dataclass
class PlantConfig(ProcessOptions, Delivery, Mismatch):
    """`recipes/plant.py`: which drone, and all that `Mismatch`, `Delivery` and `ProcessOptions` say."""

    track: str = "kidney"  # built-in track, or path to a YAML file
    preset: str = "faithful"  # physics of the nominal drone, without their randomisation: easy | faithful | betaflight


ConfigStore.instance().store(name="plant_schema", node=PlantConfig)


@recipe("plant")
def main(config: DictConfig) -> None:
    """Fly until stopped."""
    start_logging()
    with plain_errors():
        settings = cast(PlantConfig, OmegaConf.to_object(config))
        check(settings)
        vehicle = PlantVehicle(settings.track, settings.preset, settings)
        sockets = open_sockets(settings)
    run(vehicle, settings, settings, sockets)


def check(config: PlantConfig) -> None:
    """Refuse numbers that cannot be, and a delay where nothing would be delayed.

    Raises:
        ValueError: The message names the setting and what is allowed.
    """
    check_settings(config)
    if config.betaflight is not None and config.delay is not None:
        raise ValueError(f"delay={config.delay} is of commands, and betaflight={config.betaflight}: leave one out.")


if __name__ == "__main__":
    main()
