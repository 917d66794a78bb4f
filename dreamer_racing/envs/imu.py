"""The flight controller's gyro and accelerometer, as an observation beside images.

A sample is float32 (6,): body rates x, y, z in rad/s, then specific force x, y, z in m/s² (0, 0, 9.81 if a drone
stands or hovers level), both in the body frame, FLU. Shapes: N drones.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dreamer_racing.settings import NOT_NEGATIVE, check_numbers, check_settings, quoted, setting

IMU_SIZE = 6
GYRO_RANGE = 34.9
"""Range of flight controllers' gyros, rad/s, ±2000 deg/s (TDK InvenSense, ICM-42688-P, data sheet)."""
ACCELEROMETER_RANGE = 156.9
"""Range of their accelerometers, m/s², ±16 g (same data sheet)."""


@dataclass(frozen=True)
class ImuErrors:
    """Error model of an IMU: noise is drawn for each sample, biases for each episode, independently for each axis.

    Raises:
        ValueError: a number is out of its range.
    """

    gyro_noise: float = setting(0.0, NOT_NEGATIVE)  # standard deviation, rad/s
    gyro_bias: float = setting(0.0, NOT_NEGATIVE)  # standard deviation, rad/s
    accelerometer_noise: float = setting(0.0, NOT_NEGATIVE)  # standard deviation, m/s²
    accelerometer_bias: float = setting(0.0, NOT_NEGATIVE)  # standard deviation, m/s²
    # age of a sample when it is observed, control steps: 1 if the flight controller is polled in one step and its
    # answer is read in the next
    delay: int = setting(0, NOT_NEGATIVE)

    def __post_init__(self) -> None:
        check_settings(self, "imu.")
        check_numbers({"imu.delay": self.delay}, {})


IMUS = {
    "exact": ImuErrors(),
    # Biases: turn-on biases of the ADIS16448 in RotorS (rotors_simulator, imu_adis16448); the gyro's is what remains
    # after calibration at rest. Noise: that of a vibrating frame, after the firmware's filters [choice].
    "noisy": ImuErrors(gyro_noise=0.02, gyro_bias=0.0087, accelerometer_noise=0.5, accelerometer_bias=0.196, delay=1),
}
"""IMUs by name."""


def load_imu(imu: str | ImuErrors | None, from_pixels: bool = True) -> ImuErrors | None:
    """Return the error model of a named IMU, or the given one; None if there is no IMU.

    Raises:
        ValueError: unknown name, or the environment has no images.
    """
    if imu is None:
        return None
    if not from_pixels:
        raise ValueError(f"imu={quoted(imu)}: needs images, but from_pixels=False: leave it out.")
    if isinstance(imu, ImuErrors):
        return imu
    if not isinstance(imu, str) or imu not in IMUS:
        raise ValueError(f"imu={quoted(imu)}: must be {', '.join(IMUS)}, ImuErrors(...), or None.")
    return IMUS[imu]


class Imu:
    """The IMUs of N drones, sampled once per control step.

    Args:
        errors: their error model.
        ideal_imu: returns the true body rates and specific force (N, 6) at the drones' centres.
        generator: source of noise and biases, on the device of those values.
    """

    def __init__(self, errors: ImuErrors, ideal_imu: Callable[[], Tensor], generator: torch.Generator) -> None:
        self._errors, self._ideal_imu, self._generator = errors, ideal_imu, generator
        measurement = ideal_imu()
        self._bias = torch.zeros_like(measurement)
        self._samples = measurement.new_zeros((errors.delay + 1, *measurement.shape))  # newest first

        def both(gyro: float, accelerometer: float) -> Tensor:
            return measurement.new_tensor([gyro] * 3 + [accelerometer] * 3)

        self._bias_std = both(errors.gyro_bias, errors.accelerometer_bias)
        self._noise_std = both(errors.gyro_noise, errors.accelerometer_noise)
        self._range = both(GYRO_RANGE, ACCELEROMETER_RANGE)

    @property
    def sample(self) -> Tensor:
        """The observed sample, a float32 copy (N, 6)."""
        return self._samples[-1].to(torch.float32, copy=True)

    def begin(self, mask: Tensor) -> None:
        """Draw new biases and refill the delay line for the drones whose episode begins, (N,) bool."""
        rows = mask.unsqueeze(-1)
        if self._errors.gyro_bias or self._errors.accelerometer_bias:
            self._bias = torch.where(rows, self._bias_std * self._normal(), self._bias)
        self._samples = torch.where(rows, self._measure(), self._samples)

    def step(self) -> None:
        """Take a sample at the end of a control step."""
        self._samples = torch.cat((self._measure().unsqueeze(0), self._samples[:-1]))

    def _measure(self) -> Tensor:
        """Return a noisy, biased and clipped measurement (N, 6)."""
        measurement = self._ideal_imu()
        if self._errors.gyro_noise or self._errors.accelerometer_noise:
            measurement = measurement + self._noise_std * self._normal()
        measurement = (measurement + self._bias).nan_to_num(0.0)  # a drone's state may be non-finite
        return torch.minimum(torch.maximum(measurement, -self._range), self._range)

    def _normal(self) -> Tensor:
        like = self._bias
        return torch.randn(like.shape, generator=self._generator, dtype=like.dtype, device=like.device)

    def state_dict(self) -> dict[str, Any]:
        """Return biases and samples."""
        return {"bias": self._bias.clone(), "samples": self._samples.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._bias, self._samples = state_dict["bias"].clone(), state_dict["samples"].clone()
