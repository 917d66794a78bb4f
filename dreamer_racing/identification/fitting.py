"""Fits the parameters of a rate loop, so that the simulation responds to a recording's commands as its vehicle did.

The model is the one that agents train in: flight controller, mixer and motors of `preset=betaflight`, turning a rigid
body. All candidates fly all stretches of the recording in parallel, so that a Gauss-Newton step is one simulation.

Shapes: C candidates, S stretches (segments), T ms, P parameters; N = C · S drones. SI units, body frame FLU.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.drone.quadrotor import Quadrotor
from dreamer_racing.envs.drone.rate_loop import DroneParameter, Row
from dreamer_racing.envs.simulator.fused_flight import FusedFlight
from dreamer_racing.identification.recorded import AXES, DT, Recorded, stretches

logger = logging.getLogger(__name__)

STRETCH = 1.1  # s of open-loop simulation, from a measured start [choice]: longer ones stray by what is not modelled
BURN_IN = 0.2
"""s at its start that are not compared [choice]: the states of filters and integrators are not known there."""
EVERY = 5  # ms between two comparisons
CORRELATED = 0.04  # s over which errors are correlated [choice]: they are not noise, but what the model lacks
FLOOR = 0.003  # least assumed error, as a share of the RMS of rates [choice]
OUTLIER = 3.0
"""Standard deviations beyond which an error counts linearly, not squared: recordings have pauses and gusts."""
TRIMMED_SHARE = 0.1  # share of the largest errors, due to pauses and gusts, that `Fit.errors` leaves out
STEPS = 15  # largest number of Gauss-Newton steps
UNKNOWN_SHARE = 0.5  # share of the prior's standard deviation above which a fitted parameter counts as unknown [choice]
CONVERGED = 0.02  # largest change of a parameter, as a share of its prior's standard deviation, at which the fit ends


class Parameter(NamedTuple):
    """A parameter to be fitted."""

    name: str
    prior: float  # standard deviation of its prior: of its logarithm, or of a delay in s [choice]
    probe: float  # finite-difference step
    axis: str | None = None  # axis of `AXES` whose steps determine it; None: all


PARAMETERS = (
    *(Parameter(f"p_{axis}", 0.7, 0.05, axis) for axis in AXES[:3]),
    *(Parameter(f"i_{axis}", 1.0, 0.2, axis) for axis in AXES[:3]),
    *(Parameter(f"d_{axis}", 0.7, 0.1, axis) for axis in AXES[:2]),
    Parameter("motor_lag", 0.7, 0.1),
    Parameter("delay", 0.015, 0.003),
)
"""Gains relative to the initial ones, and the lag, as logarithms; delay in s, added. Cut-offs of filters are not
fitted: their effect is like that of D, and the flight controller's settings give them."""


@dataclass(frozen=True)
class Fit:
    """The result of a fit."""

    parameters: QuadrotorParameters  # of the drone that responds as the recorded one did
    values: dict[str, float]  # by name: fitted value, relative to the initial one; for the delay, its change in s
    # by name: its standard deviation, as a share, or in s for the delay; from differences of stretches
    deviations: dict[str, float]
    # names of parameters that the recording hardly determines: they stay near their initial values
    unknown: tuple[str, ...]
    # by axis: RMS error of body rates, without the largest `TRIMMED_SHARE`, relative to the RMS of commanded ones
    errors: dict[str, float]
    before: dict[str, float]  # as `errors`, of the initial parameters
    thrust: float | None  # measured collective thrust, relative to the model's; None if no force was measured

    def lines(self, preset: str) -> Iterator[str]:
        """Yield the fitted parameters, errors and thrust as text; ``preset`` names the initial parameters."""
        yield f"{'':<10}{'relative':>10}{'±':>8}  (to {preset}; delay in ms, added)"
        for name, value in self.values.items():
            scale = 1e3 if name == "delay" else 1.0
            width = scale * self.deviations[name] * (1.0 if name == "delay" else value)
            remark = "   poorly determined" if name in self.unknown else ""
            yield f"{name:<10}{scale * value:>10.3f}{width:>8.3f}{remark}"
        for axis, error in self.errors.items():
            before = f"{self.before[axis]:.1%} before"
            yield f"{axis}: RMS error of body rates {error:.1%} of the commanded rates ({before})"
        if self.thrust is None:
            yield "thrust: no force was measured"
        else:
            yield f"thrust: {self.thrust:.3f} of the assumed thrust: multiply full_thrust= of recipes/hil.py by it"


class Simulated(NamedTuple):
    """Stretches as simulated with candidates."""

    rates: Tensor  # (T / EVERY, C, S, 3) rad/s
    force: Tensor  # (T / EVERY, C, S) rotor thrust per mass, m/s²


class Model:
    """Simulates S stretches of T ms of a recording with C candidates in parallel, which are variations of a drone."""

    def __init__(
        self, nominal: QuadrotorParameters, recorded: Recorded, parts: Sequence[slice], candidates: int
    ) -> None:
        assert nominal.betaflight is not None, "checked"
        self._drone = replace(
            nominal, physics_dt=DT, control_dt=DT, command_delay=0.0, drag=(0.0, 0.0, 0.0), randomisation=None
        )
        self._delay = nominal.command_delay
        self._shape = candidates, len(parts)
        num_drones = candidates * len(parts)
        self._quadrotor = Quadrotor(self._drone, num_drones)
        loop = self._quadrotor.rate_loop
        assert loop is not None
        self._loop = loop
        self._qpos = torch.zeros(num_drones, 7, dtype=torch.float64)
        self._qvel, self._force = (torch.zeros(num_drones, 6, dtype=torch.float64) for _ in range(2))
        self._inertia = torch.tensor(self._drone.inertia, dtype=torch.float64)
        self._flight = FusedFlight(self._quadrotor, self._qpos, self._qvel, self._force, self._integrate)
        command, fresh, rates = (
            torch.from_numpy(np.stack([values[part] for part in parts], 1))
            for values in (recorded.command, recorded.fresh, recorded.rates)
        )
        # a controller's state at the start of a stretch is that in the stretch before, as last simulated
        begins = np.array([part.start for part in parts])
        self._handover = round((STRETCH - BURN_IN) / DT)
        self._follows = torch.from_numpy(np.diff(begins, prepend=begins[0] - 1) == self._handover)  # (S,)
        self._remembered: tuple[Tensor, Tensor] | None = None
        command[..., 0] *= self._drone.mass
        self._command, self._fresh, self._rates = command, fresh, rates  # each (T, S, ...)

    def _integrate(self) -> None:
        """Integrate the rotation of the bodies, whose positions stay fixed, as MuJoCo would."""
        rates = self._qvel[:, 3:]
        gyroscopic = torch.linalg.cross(rates, self._inertia * rates)
        rates += DT / self._inertia * (self._force[:, 3:] - gyroscopic)

    def fly(self, candidates: Tensor) -> Simulated:
        """Simulate all stretches with candidates (C, P), from the measured rates at their starts on."""
        quadrotor, (_, stretches_) = self._quadrotor, self._shape
        late = self._set_parameters(candidates)  # (C,) ms
        quadrotor.reset(torch.ones(len(self._qpos), dtype=torch.bool))
        self._begin(len(candidates))
        rates, force = [], []
        columns = torch.arange(stretches_)
        for step in range(len(self._command)):
            at = (step - late).clamp(min=0).unsqueeze(1)  # (C, 1)
            quadrotor.setpoints[0] = self._command[at, columns].flatten(0, 1)
            arrived = self._fresh[at, columns].flatten() & (step >= late).repeat_interleave(stretches_)
            self._loop.state[:, Row.THROTTLE, 2].masked_fill_(arrived, 0.0)
            if step == self._handover:
                self._store_states()
            self._flight.step(0)
            if step % EVERY == EVERY - 1:
                rates.append(self._qvel[:, 3:].view(*self._shape, 3).clone())
                force.append(quadrotor.rotor_speed.square().sum(1).view(self._shape) / self._drone.mass)
        self._remembered = self._next
        return Simulated(torch.stack(rates), torch.stack(force))

    def _begin(self, candidates: int) -> None:
        """Put the drones at the starts of their stretches."""
        self._qpos[:, 3:] = torch.tensor((1.0, 0.0, 0.0, 0.0), dtype=torch.float64)
        start = self._rates[0].expand(candidates, -1, -1).reshape(-1, 3)
        self._qvel.zero_()
        self._qvel[:, 3:] = start
        for row in (Row.GYRO_LPF1, Row.GYRO_LPF2, Row.DTERM_LPF1, Row.DTERM_LPF2):
            self._loop.state[:, row] = torch.rad2deg(start)
        if self._remembered is not None:
            for kept, remembered in zip((self._loop.state, self._quadrotor.rotor_speed), self._remembered, strict=True):
                of_all = remembered.repeat(candidates, *[1] * (remembered.ndim - 1))
                rows = self._follows.repeat(candidates).view(-1, *[1] * (kept.ndim - 1))
                kept.copy_(torch.where(rows, of_all, kept))

    def _store_states(self) -> None:
        """Store controller states and rotor speeds of the first candidate, each for the stretch after its own."""
        own = slice(self._shape[1])
        self._next = self._loop.state[own].roll(1, 0).clone(), self._quadrotor.rotor_speed[own].roll(1, 0).clone()

    def _set_parameters(self, candidates: Tensor) -> Tensor:
        """Set the parameters of the drones of candidates (C, P); return the delay of each, (C,) ms."""
        values = {parameter.name: candidates[:, index] for index, parameter in enumerate(PARAMETERS)}
        own = torch.ones(len(candidates), len(DroneParameter), 3, dtype=torch.float64)
        for row, gain, axes in ((DroneParameter.P, "p", 3), (DroneParameter.I, "i", 3), (DroneParameter.D, "d", 2)):
            for index, axis in enumerate(AXES[:axes]):
                own[:, row, index] = values[f"{gain}_{axis}"].exp()
        decay = math.log(self._quadrotor.motor_decay) / values["motor_lag"].exp()
        motors = torch.stack((decay.exp(), (0.5 * decay).exp(), torch.zeros_like(decay)), dim=1)
        own[:, DroneParameter.MOTORS] = motors
        self._loop.drone_parameters.copy_(own.repeat_interleave(self._shape[1], 0))
        return ((self._delay + values["delay"]) / DT).round().long().clamp(min=0)


def fit(recorded: Recorded, nominal: QuadrotorParameters) -> Fit:
    """Fit the parameters of a recording's drone.

    Each parameter has a prior, so that one that the recording does not determine stays near its initial value, that of
    the nominal drone. `Recorded.check` refuses unsuitable recordings.

    Raises:
        ValueError: The drone has no `betaflight`, or there is no stretch that was measured throughout.
    """
    if nominal.betaflight is None:
        raise ValueError("The fit needs Betaflight's rate loop: start from preset=betaflight, or one based on it.")
    parts = stretches(recorded, STRETCH, BURN_IN)
    if not parts:
        raise ValueError(f"No {STRETCH:g} s of this recording are without a gap: nothing can be fitted.")
    priors = torch.tensor([parameter.prior for parameter in PARAMETERS], dtype=torch.float64)
    probes = torch.tensor([parameter.probe for parameter in PARAMETERS], dtype=torch.float64)
    model = Model(nominal, recorded, parts, 1 + len(PARAMETERS))
    measured = torch.from_numpy(np.stack([recorded.rates[part] for part in parts], 1))[EVERY - 1 :: EVERY]  # (T, S, 3)
    kept = slice(round(BURN_IN / DT / EVERY), None)
    floor = FLOOR * measured.square().mean((0, 1)).sqrt().clamp(min=0.1)
    found, before = torch.zeros(len(PARAMETERS), dtype=torch.float64), dict[str, float]()
    change = torch.zeros_like(found)
    for number in range(STEPS):
        found = found + change
        found[-1] = found[-1].clamp(min=-nominal.command_delay)
        simulated = model.fly(found + torch.cat((torch.zeros(1, len(priors)), probes.diag())))
        error = (simulated.rates - measured.unsqueeze(1))[kept]  # (T, C, S, 3)
        rms = _rms(error[:, 0], recorded, parts)
        words = ", ".join(f"{axis} {each:.1%}" for axis, each in rms.items())
        logger.info("identification: step %d, errors %s", number, words)
        before = before or rms
        change, posterior, sandwich = _solve(error, floor, probes, priors, found)
        if (change / priors).abs().max() < CONVERGED:
            break
    names = [parameter.name for parameter in PARAMETERS]
    unknown = tuple(compress(names, posterior > UNKNOWN_SHARE * priors))
    values = {
        name: each if name == "delay" else math.exp(each) for name, each in zip(names, found.tolist(), strict=True)
    }
    thrust = _thrust(simulated.force[:, 0], recorded, parts)
    deviations = dict(zip(names, sandwich.tolist(), strict=True))
    return Fit(apply(nominal, values, thrust or 1.0), values, deviations, unknown, rms, before, thrust)


def _solve(
    error: Tensor,  # (T, C, S, 3) of the present parameters, and with each one probed
    floor: Tensor,  # (3,) rad/s, least assumed error: in a hover, errors are close to zero
    probes: Tensor,  # (P,) finite-difference steps
    priors: Tensor,  # (P,) standard deviations of the priors
    found: Tensor,  # (P,) present parameters
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the change of the parameters, and two standard deviations of them, (P,) each.

    The first deviation is that of the posterior, the second that of the estimate over stretches (sandwich), which also
    holds if errors are not independent.
    """
    present = error[:, 0]  # (T, S, 3)
    slopes = (error[:, 1:] - present.unsqueeze(1)) / probes.view(-1, 1, 1)  # (T, P, S, 3)
    scale = torch.maximum(1.4826 * present.abs().flatten(0, 1).median(0).values, floor)  # (3,) rad/s, robust
    weights = (OUTLIER * scale / present.abs().clamp(min=1e-9)).clamp(max=1.0) / scale.square()
    weights = weights * (EVERY * DT / CORRELATED)
    rows = slopes.movedim(1, -1)  # (T, S, 3, P)
    weighted = rows * weights.unsqueeze(-1)
    information = torch.einsum("tsap,tsaq->pq", rows, weighted) + priors.square().reciprocal().diag()
    scores = torch.einsum("tsap,tsa->sp", weighted, present)  # (S, P)
    covariance = torch.linalg.inv(information)
    change = -(covariance @ (scores.sum(0) + found / priors.square()))
    sandwich_deviation = covariance @ (scores - scores.mean(0)).T  # (P, S)
    return change.clamp(-priors, priors), covariance.diagonal().sqrt(), sandwich_deviation.square().sum(1).sqrt()


def _rms(error: Tensor, recorded: Recorded, parts: Sequence[slice]) -> dict[str, float]:
    """Return the RMS of errors (T, S, 3), without the largest, relative to that of the commanded rates, by axis."""
    asked = np.concatenate([recorded.command[part, 1:] for part in parts])
    squares = error.square().flatten(0, 1).sort(0).values  # (T · S, 3)
    kept = squares[: math.ceil((1.0 - TRIMMED_SHARE) * len(squares))].mean(0).sqrt()
    relative = kept / torch.from_numpy(asked).square().mean(0).sqrt().clamp(min=1e-6)
    return dict(zip(AXES, relative.tolist(), strict=False))


def _thrust(force: Tensor, recorded: Recorded, parts: Sequence[slice]) -> float | None:
    """Return the ratio of measured to modelled force (T, S), m/s²; None if too little was measured."""
    measured = np.stack([recorded.force[part] for part in parts], 1)
    size = round(BURN_IN / DT / EVERY)
    measured = measured[: EVERY * len(force)].reshape(len(force), EVERY, -1)[size:]
    seen = np.isfinite(measured).all(1)
    if seen.mean() < 0.5:
        return None
    modelled, mean = force[size:].numpy()[seen], measured.mean(1)[seen]
    return float(modelled @ mean / (modelled @ modelled))


def apply(nominal: QuadrotorParameters, values: dict[str, float], thrust: float = 1.0) -> QuadrotorParameters:
    """Return a drone with parameters relative to those of a nominal one.

    Args:
        nominal: The nominal drone, whose `betaflight` is set.
        values: Factors, by the names of `PARAMETERS`; the delay in s, added.
        thrust: Factor of rotor thrust; gains, which command it, are divided by it.
    """
    assert nominal.betaflight is not None, "checked"
    firmware: Any = nominal.betaflight
    gains = {
        gain: tuple(
            round(number * values.get(f"{gain[0]}_{axis}", 1.0) / thrust, 2)  # the factor of D is that of D max, too
            for axis, number in zip(AXES, getattr(firmware, gain), strict=False)
        )
        for gain in ("p", "i", "d", "d_max")
    }
    return replace(
        nominal,
        betaflight=replace(firmware, **gains),
        motor_time_constant=round(nominal.motor_time_constant * values["motor_lag"], 5),
        command_delay=round(max(nominal.command_delay + values["delay"], 0.0), 3),
        rotor_thrust_max=round(nominal.rotor_thrust_max * thrust, 4),
    )
