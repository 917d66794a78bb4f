"""The flight controller's gyro and accelerometer, as an observation beside images.

A sample is float32 (6,): body rates x, y, z in rad/s, then specific force x, y, z in m/s² (0, 0, 9.81 where a drone
stands or hovers level), both in the body frame, FLU. Shapes: N drones.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.settings import NOT_NEGATIVE, check_settings, quoted, setting

IMU_SIZE = 6
GYRO_RANGE = 34.9
"""rad/s, ±2000 deg/s: what the sensors of flight controllers can tell (TDK InvenSense, ICM-42688-P, data sheet)."""
ACCELEROMETER_RANGE = 156.9
"""m/s², ±16 g, likewise."""


@dataclass(frozen=True)
class ImuErrors:
    """By how much an IMU errs. Noise is drawn anew for each sample, biases where an episode begins, each axis alone.

    Attributes:
        gyro_noise: standard deviation, rad/s.
        gyro_bias: likewise.
        accelerometer_noise: standard deviation, m/s².
        accelerometer_bias: likewise.
        delay: control steps that a sample is old when it is seen: 1 where the flight controller is asked at one step,
            and its answer is read at the next.

    Raises:
        ValueError: a number is out of its range.
    """

    gyro_noise: float = setting(0.0, NOT_NEGATIVE)
    gyro_bias: float = setting(0.0, NOT_NEGATIVE)
    accelerometer_noise: float = setting(0.0, NOT_NEGATIVE)
    accelerometer_bias: float = setting(0.0, NOT_NEGATIVE)
    delay: int = setting(0, NOT_NEGATIVE)

    def __post_init__(self) -> None:
        check_settings(self, "imu.")


IMUS = {
    "exact": ImuErrors(),
    # Biases: those that RotorS gives its ADIS16448 at turn-on (rotors_simulator, imu_adis16448), the gyro's of what is
    # left when it has been calibrated at rest. Noise: of a frame that vibrates, after the firmware's filters [choice].
    "noisy": ImuErrors(gyro_noise=0.02, gyro_bias=0.0087, accelerometer_noise=0.5, accelerometer_bias=0.196, delay=1),
}
"""IMUs by name."""


def load_imu(imu: str | ImuErrors | None, from_pixels: bool = True) -> ImuErrors | None:
    """Return the errors of a named IMU, or the given ones; None: there is no IMU.

    Raises:
        ValueError: unknown name, or no images to have it beside.
    """
    if imu is None:
        return None
    if not from_pixels:
        raise ValueError(f"imu={quoted(imu)}: is seen beside images, and from_pixels=False shows none: leave it out.")
    if isinstance(imu, ImuErrors):
        return imu
    if not isinstance(imu, str) or imu not in IMUS:
        raise ValueError(f"imu={quoted(imu)}: must be {', '.join(IMUS)}, ImuErrors(...), or None.")
    return IMUS[imu]


class Imu:
    """N drones' IMUs: a sample of each at every control step.

    Args:
        errors: by how much they err.
        feel: returns body rates and specific force (N, 6) of the drones' centres now.
        generator: of noise and biases, on the device of what is felt.
    """

    def __init__(self, errors: ImuErrors, feel: Callable[[], Tensor], generator: torch.Generator) -> None:
        self._errors, self._feel, self._generator = errors, feel, generator
        felt = feel()
        self._bias = torch.zeros_like(felt)
        self._samples = felt.new_zeros((errors.delay + 1, *felt.shape))  # newest first

        def both(gyro: float, accelerometer: float) -> Tensor:
            return felt.new_tensor([gyro] * 3 + [accelerometer] * 3)

        self._bias_std = both(errors.gyro_bias, errors.accelerometer_bias)
        self._noise_std = both(errors.gyro_noise, errors.accelerometer_noise)
        self._range = both(GYRO_RANGE, ACCELEROMETER_RANGE)

    @property
    def sample(self) -> Tensor:
        """What is seen now, a copy, float32 (N, 6)."""
        return self._samples[-1].to(torch.float32, copy=True)

    def begin(self, mask: Tensor) -> None:
        """Draw biases where episodes begin, (N,) bool; no sample there is older than the episode."""
        rows = mask.unsqueeze(-1)
        if self._errors.gyro_bias or self._errors.accelerometer_bias:
            self._bias = torch.where(rows, self._bias_std * self._normal(), self._bias)
        self._samples = torch.where(rows, self._measure(), self._samples)

    def step(self) -> None:
        """Take the sample at a control step's end."""
        self._samples = torch.cat((self._measure().unsqueeze(0), self._samples[:-1]))

    def _measure(self) -> Tensor:
        """Sample (N, 6) what is felt now."""
        felt = self._feel()
        if self._errors.gyro_noise or self._errors.accelerometer_noise:
            felt = felt + self._noise_std * self._normal()
        felt = (felt + self._bias).nan_to_num(0.0)  # of a drone whose state broke
        return torch.minimum(torch.maximum(felt, -self._range), self._range)

    def _normal(self) -> Tensor:
        like = self._bias
        return torch.randn(like.shape, generator=self._generator, dtype=like.dtype, device=like.device)

    def state_dict(self) -> dict[str, Any]:
        """Return biases and samples."""
        return {"bias": self._bias.clone(), "samples": self._samples.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._bias, self._samples = state_dict["bias"].clone(), state_dict["samples"].clone()
