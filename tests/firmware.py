"""A stand-in for Betaflight's SITL firmware, from the firmware's side: the model of its rate loop behind its packets.

It uses nothing of what it is to test: packets, links and plant. The model is held against recordings elsewhere.
"""

from __future__ import annotations

import struct

import numpy as np
import torch

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.drone.rate_loop import RateLoop

IDLE = 0.055  # of the motors, armed
MIN_CHECK = 1050  # µs: arms below, and the throttle begins there
FULL_STICK = np.radians((580.0, 580.0, 230.0))  # rad/s: ACTUAL rates of 58, 58, 23 without expo
FAILSAFE = 0.5  # s: failsafe_delay = 5, procedure DROP
STATE_DT = 0.001  # s from one state packet to the next, and so its clock: the stamps stand still


class Firmware:
    """A rate loop that reads and writes the firmware's packets.

    It turns the rates around as sitl.c does, and flies by the rate loop of ``preset=betaflight`` once armed. With
    `hear` it is flown by a radio: it arms by AUX1 at low throttle only, once it has been seen disarmed, and drops when
    the radio falls silent; without, what it is to do is set from outside.
    """

    def __init__(self, version: str) -> None:
        self.version = version
        self.armed, self.throttle, self.rates = False, 0.0, np.zeros(3)  # rates: right, forward and LEFT positive
        self.stamps: set[float] = set()
        self.gyro = np.zeros(3)
        self.accelerometer = np.zeros(3)
        self.time, self.refused = 0.0, 0
        self._heard: float | None = None  # when the radio last spoke; None: never, or not since it was lost
        self._may_arm = self._was_armed = False
        self._loop = RateLoop(PRESETS["betaflight"], 1)
        self._loop.motor_commands(torch.zeros(1, 4), torch.zeros(1, 3))  # compiled now, not in flight; arming resets it

    def hear(self, data: bytes) -> None:
        """Read a packet of the radio: f64 stamp, 16 u16 µs in the order AETR, then AUX1."""
        roll, pitch, throttle, yaw, aux1 = struct.unpack("<d16H", data)[1:6]
        self._heard = self.time
        wants = 1700 <= aux1 <= 2100
        if not wants:
            self.armed, self._may_arm = False, True
        elif not self.armed:
            self.armed = self._may_arm and throttle < MIN_CHECK
            self.refused += not self.armed
        right, forward, yaw_right = (np.array((roll, pitch, yaw)) - 1500.0) / 500.0 * FULL_STICK
        self.rates = np.array((right, forward, -yaw_right))
        share = max(throttle - MIN_CHECK, 0) / (2000 - MIN_CHECK)
        self.throttle = IDLE + (1.0 - IDLE) * share

    def answer(self, data: bytes) -> bytes:
        """Take a state packet; return the motors'."""
        self.time += STATE_DT
        if self._heard is not None and self.time - self._heard > FAILSAFE:
            self.armed, self._may_arm, self._heard = False, False, None
        numbers = struct.unpack("<18d", data)
        self.stamps.add(numbers[0])
        x, y, z = numbers[1:4]
        self.gyro = np.array((x, -y, z if self.version == "2026.6" else -z))  # sitl.c, updateState
        self.accelerometer = -np.array(numbers[4:7])
        return self.pack(self.motors())

    def motors(self) -> np.ndarray:
        """M1 … M4: rear right, front right, rear left, front left."""
        if self.armed and not self._was_armed:
            self._loop.reset(torch.ones(1, 1, dtype=torch.bool))
        self._was_armed = self.armed
        if not self.armed:
            return np.zeros(4)
        setpoint = np.append(self._loop.thrust_max * self.throttle**2, self.rates)
        return self._loop.motor_commands(torch.from_numpy(setpoint[None]), torch.from_numpy(self.gyro[None]))[0].numpy()

    def pack(self, motors: np.ndarray) -> bytes:
        """Return the packet of four motors, in this version's order."""
        m1, m2, m3, m4 = motors
        return struct.pack("<4f", *((m1, m2, m3, m4) if self.version == "2026.6" else (m2, m3, m4, m1)))
