"""Manual flight: a policy of one drone that follows a keyboard, a gamepad or a script.

The sticks command body rates and thrust, as a radio in acro mode does (mode 2): a centred stick commands zero rate,
and a centred throttle the hover thrust.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from dreamer_racing.commands import install_extra

KINDS = ("keyboard", "gamepad")
WINDOW = 512  # pixels, side of the window
KEYS = (("right", "left"), ("up", "down"), ("d", "a"), ("w", "s"))  # more and less roll, pitch, yaw and throttle
KEYBOARD_SHARE = 0.35  # stick position of a key held down; below 1, because keys are all or nothing
EASE = 0.25  # share of the remaining way that the sticks move towards the keys in a control step
DEAD_ZONE = 0.06  # of a gamepad's stick
GAMEPAD_AXES = {"yaw": 0, "throttle": 1, "roll": 2, "pitch": 3}  # mode 2; in SDL, up and forward are −1


class StickPositions(NamedTuple):
    """Stick positions, each in [−1, 1]."""

    roll: float = 0.0  # + to the right
    pitch: float = 0.0  # + forward, nose down
    yaw: float = 0.0  # + to the right
    throttle: float = 0.0  # 0 is hover thrust, +1 full thrust, −1 no thrust


Sticks = Callable[[np.ndarray], StickPositions]
"""Function that shows an on-board image (H, W, 3) uint8 to the pilot and returns the stick positions."""


class FlightAbandonedError(Exception):
    """The pilot has closed the window or pressed escape."""


class HandPolicy(TensorDictModuleBase):
    """Policy that follows sticks: reads `pixels` of one drone, writes `action`.

    ``hover_action`` is the collective thrust of hover, in units of the action.

    Example:
        >>> from tensordict import TensorDict
        >>> policy = HandPolicy(lambda image: StickPositions(pitch=0.5), hover_action=-0.4)
        >>> policy(TensorDict({"pixels": torch.zeros(1, 64, 64, 3, dtype=torch.uint8)}, [1]))["action"]
        tensor([[-0.4000,  0.0000,  0.5000, -0.0000]])
    """

    def __init__(self, sticks: Sticks, hover_action: float) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["pixels"], ["action"]
        self._sticks, self._hover = sticks, hover_action

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of the next control step."""
        at = self._sticks(tensordict["pixels"][0].cpu().numpy())
        room = 1.0 - self._hover if at.throttle > 0 else 1.0 + self._hover
        action = [self._hover + room * at.throttle, at.roll, at.pitch, -at.yaw]
        return tensordict.set("action", torch.tensor([action], device=tensordict.device).clamp(-1.0, 1.0))


def keys_to_sticks(held: Mapping[str, bool], before: StickPositions) -> StickPositions:
    """Return the sticks a control step after ``before``, moved towards what the `KEYS` that are held down command."""
    wanted = [KEYBOARD_SHARE * (bool(held.get(more)) - bool(held.get(less))) for more, less in KEYS]
    return StickPositions(*(old + EASE * (new - old) for old, new in zip(before, wanted, strict=True)))


def axes_to_sticks(axes: Mapping[str, float]) -> StickPositions:
    """Convert gamepad axes, whose up and forward are negative, and apply the dead zone."""
    live = {name: 0.0 if abs(value) < DEAD_ZONE else value for name, value in axes.items()}
    return StickPositions(live["roll"], -live["pitch"], live["yaw"], -live["throttle"])


def check_by_hand(kind: str, environment: Mapping[str, str] = os.environ) -> None:
    """Raise ValueError, with the remedy, if pygame or a display is not available."""
    if importlib.util.find_spec("pygame") is None:
        raise ValueError(f"pilot={kind} needs the package pygame: {install_extra('play')}.")
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform.startswith("linux") and not any(environment.get(name) for name in displays):
        raise ValueError(
            f"pilot={kind} needs a display to show what the camera sees, and neither DISPLAY nor WAYLAND_DISPLAY is "
            "set: start it on a desktop, or over ssh -X. pilot=scripted needs none."
        )


class PygameSticks:
    """A window with the on-board image, and one of `KINDS`; runs a flight in real time, with steps of control_dt s.

    Arrows: roll and pitch. A and D: yaw. W and S: throttle. Escape ends the flight.

    Raises:
        ValueError: see `check_by_hand`; or there is no gamepad.
    """

    def __init__(self, kind: str, control_dt: float) -> None:
        check_by_hand(kind)
        import pygame

        self._pygame: Any = pygame
        self._control_dt, self._due = control_dt, time.monotonic()
        self._at = StickPositions()
        pygame.display.init()
        pygame.joystick.init()  # not pygame.init(): without a sound card it prints many errors
        self._gamepad = None
        if kind == "gamepad":
            if not pygame.joystick.get_count():
                pygame.quit()
                raise ValueError("pilot=gamepad: there is no gamepad. Plug one in, or use pilot=keyboard.")
            self._gamepad = pygame.joystick.Joystick(0)
        self._window = pygame.display.set_mode((WINDOW, WINDOW))
        pygame.display.set_caption("dreamer_racing: arrows, W A S D; escape ends")

    def __call__(self, image: np.ndarray) -> StickPositions:
        """Show an image, wait until the control step is due, and read the sticks, or raise FlightAbandonedError."""
        pygame = self._pygame
        surface = pygame.surfarray.make_surface(image.swapaxes(0, 1))
        self._window.blit(pygame.transform.scale(surface, (WINDOW, WINDOW)), (0, 0))
        pygame.display.flip()
        self._due = max(self._due + self._control_dt, time.monotonic())
        time.sleep(max(0.0, self._due - time.monotonic()))
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                raise FlightAbandonedError
        if self._gamepad is not None:
            return axes_to_sticks({name: self._gamepad.get_axis(axis) for name, axis in GAMEPAD_AXES.items()})
        pressed = pygame.key.get_pressed()
        held = {name: pressed[pygame.key.key_code(name)] for pair in KEYS for name in pair}
        self._at = keys_to_sticks(held, self._at)
        return self._at

    def close(self) -> None:
        """Close the window."""
        self._pygame.quit()
