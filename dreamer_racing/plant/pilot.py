"""The scripted pilot as a flyer, by poses instead of images, to try all else without an agent."""

from __future__ import annotations

import numpy as np
import torch

from dreamer_racing.envs.drone.parameters import (
    QuadrotorParameters,
    at_control_rate,
    load_preset,
    without_randomisation,
)
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.vehicle import Pose, Setpoint


class PilotFlyer:
    """A `dreamer_racing.hil.flyer.Flyer` that flies the planned racing line.

    Args:
        track: To fly.
        preset: Vehicle model that the pilot assumes.
        rate: Hz, of its setpoints.
    """

    camera: Camera | None = None

    def __init__(self, track: Track, preset: str | QuadrotorParameters = "faithful", rate: float = 50.0) -> None:
        self.rate = rate
        parameters = at_control_rate(without_randomisation(load_preset(preset)), rate)
        self._pilot = ScriptedPilot(track, parameters)
        self._thrust_scale = parameters.collective_thrust_scale
        self._rate_max = np.array(parameters.body_rate_max)

    def reset(self) -> None:
        """Begin a flight."""
        self._pilot.reset()

    def act(self, pose: Pose, image: np.ndarray | None, target_gate: int) -> Setpoint:
        """Return the setpoint for a pose."""
        parts = (pose.position, pose.attitude, pose.linear_velocity, pose.body_rates)
        position, attitude, velocity, rates = (torch.from_numpy(part)[None] for part in parts)
        action = self._pilot.act(position, attitude, velocity, rates, torch.tensor([target_gate]))[0].double().numpy()
        return Setpoint(self._thrust_scale * (1.0 + float(action[0])), self._rate_max * action[1:])

    def prepare(self) -> None:
        """Do nothing: the next pose is not known yet."""
