"""Simulate a drone in a process of its own, to be flown instead of a real one: it may differ from that of training.

    python recipes/plant.py track=figure8 mass=1.1 thrust=0.9 delay=0.02 packet_loss=0.01
    python recipes/plant.py track=kidney firmware=auto      # flown by a Betaflight of this machine, which it starts
    python recipes/plant.py track=kidney betaflight=2026.6  # the same, by one that runs already

It takes commands from UDP port 9101 and sends poses to port 9100, both on this machine, until it is stopped by Ctrl+C
or SIGTERM, and prints a summary at the end. The drone stands on a launch stand at the track's start pose, until a
disarmed command and then armed ones with thrust have arrived.

With firmware= a Betaflight that was built for this machine (SITL) is set up for actor=, started, and commands the
motors; RC channels go to the firmware. auto is that of BETAFLIGHT_SITL=/path/to/betaflight_SITL.elf, or of the extra
sitl. With betaflight= the firmware is one that is already running.
"""

from dataclasses import dataclass

from composing.entry import plain_errors, recipe

from dreamer_racing.export.agents import existing_agent_path
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import print_settings
from dreamer_racing.hil.configuration import PILOT, HilConfig, pilot_contract
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.process import ProcessOptions, firmware_option, open_sockets, run, start_firmware
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle


@dataclass
class PlantConfig(ProcessOptions, Delivery, Mismatch):
    """Configuration of `recipes/plant.py`: the drone, and the settings of its three base classes."""

    track: str = "kidney"  # built-in track, or path to a YAML file
    preset: str = "faithful"  # physics of the nominal drone, without randomisation: easy | faithful | betaflight
    # with firmware=: pilot, or name or path of an agent, whose largest body rates it is set up for
    actor: str = "pilot"

    def check(self) -> None:
        """Refuse a command delay if a firmware flies, and an actor without a firmware to set up for it."""
        if self.delay is not None and (name := firmware_option(self)):
            raise ValueError(
                f"delay={self.delay} is for commands, which {name}={getattr(self, name)} replaces: leave one out."
            )
        if self.actor != PILOT and self.firmware is None:
            raise ValueError(f"actor={self.actor} is for firmware=, which is set up for it: add that, or leave it out.")


@recipe("plant", PlantConfig)
def main(config: PlantConfig) -> None:
    """Fly until stopped."""
    with plain_errors():
        vehicle = PlantVehicle(config.track, config.preset, config)
        sockets = open_sockets(config)
        firmware = None
        if config.firmware is not None:
            if config.actor == PILOT:
                contract = pilot_contract(HilConfig(actor=PILOT))
            else:
                contract = read_contract(existing_agent_path("actor", config.actor))
            lines = print_settings(contract, "betaflight_sitl")  # that set it up for the actor
            firmware = start_firmware(config.firmware, config, sockets, lines)
    run(vehicle, config, config, sockets, firmware)


if __name__ == "__main__":
    main()
