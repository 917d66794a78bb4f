"""Measures how much a vehicle may differ from a flyer's training model: flights with one parameter changed each."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

from dreamer_racing.envs.tracks import Track
from dreamer_racing.hil.chain import ChainConfig, FlightChain
from dreamer_racing.hil.flyer import Flyer
from dreamer_racing.hil.safety_limits import SafetyLimits
from dreamer_racing.plant.delivery import Delivery
from dreamer_racing.plant.lock_step import LockStep
from dreamer_racing.plant.vehicle import Mismatch, PlantVehicle

SWEEPS: dict[str, tuple[float, ...]] = {
    "delay": (0.0, 0.02, 0.04, 0.06, 0.08, 0.1),  # s, of commands
    "latency": (0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1),  # s, of poses, not known to the loop
    "mass": (0.8, 0.9, 1.0, 1.1, 1.2),  # relative
    "thrust": (0.8, 0.9, 1.0, 1.1, 1.2),  # relative
    "position_noise": (0.0, 0.01, 0.02, 0.05, 0.1),  # m, standard deviation
    "rate": (50.0, 100.0, 200.0, 400.0),  # Hz, of poses
}
"""Values of each changed parameter, by its field name in `Mismatch` or `Delivery`."""

DEFAULT_DELIVERY = Delivery(rate=200.0, jitter=0.002, packet_loss=0.01, position_noise=0.001, attitude_noise=0.003)
"""Poses as a motion-capture system gives them [choice]; without noise every flight would be the same."""

LONGEST = 60.0  # s after which a flight is ended

LIMITS = {"speed_max": 25.0, "velocity_tolerance": 20.0}
"""m/s, safety limits that differ from the defaults: the pilot is faster than a first flight should be, and the study
measures how much noise a flyer tolerates, not safety."""


class StudyFlight(NamedTuple):
    """The result of a flight."""

    sweep: str  # the changed parameter
    value: float
    seed: int  # seed of the poses' noise
    gates: int  # passed in order, as counted by the plant
    finished: bool  # whether all laps were flown
    lap_time: float | None  # mean lap time, s; None without a lap
    speed_max: float  # m/s
    ended: str  # why it ended, in words


def study(
    make_flyer: Callable[[], Flyer],
    track: Track,
    preset: str,
    flights: int,
    sweeps: Sequence[str] = tuple(SWEEPS),
    processes: int = 1,
) -> Iterator[StudyFlight]:
    """Fly every value of every sweep ``flights`` times, and yield the results, in order.

    Args:
        make_flyer: Makes the flyer; called once in each process, so it must be picklable.
        track: Of all flights.
        preset: Physics of the vehicle before it is changed.
        flights: Of each value, with different noise.
        sweeps: Names in `SWEEPS`.
        processes: That fly in parallel.
    """
    jobs = [(sweep, value, seed) for sweep in sweeps for value in SWEEPS[sweep] for seed in range(flights)]
    with ProcessPoolExecutor(
        processes, get_context("spawn"), initializer=_prepare, initargs=(make_flyer, track, preset)
    ) as pool:
        yield from pool.map(_fly, *zip(*jobs, strict=True))


_prepared: dict[str, Any] = {}  # flyer, track and preset of this process, kept because a flyer takes seconds to make


def _prepare(make_flyer: Callable[[], Flyer], track: Track, preset: str) -> None:
    _prepared.update(flyer=make_flyer(), track=track, preset=preset)


def _fly(sweep: str, value: float, seed: int) -> StudyFlight:
    return fly(_prepared["flyer"], _prepared["track"], _prepared["preset"], sweep, value, seed)


def fly(flyer: Flyer, track: Track, preset: str, sweep: str, value: float, seed: int) -> StudyFlight:
    """Fly once with one parameter changed."""
    mismatch, delivery = Mismatch(), dataclasses.replace(DEFAULT_DELIVERY, seed=seed)
    for changed in (mismatch, delivery):
        if hasattr(changed, sweep):
            setattr(changed, sweep, value)
    vehicle = PlantVehicle(track, preset, mismatch)
    laps = vehicle.track.laps
    limits = SafetyLimits.of_track(vehicle.track, **LIMITS)
    chain = FlightChain(flyer, vehicle.track, ChainConfig(limits, laps=laps, arm=True))
    plant = LockStep(vehicle, delivery)
    try:
        ended = plant.fly(chain, flyer.rate, LONGEST)
    finally:
        chain.close()
    times = vehicle.lap_times
    return StudyFlight(
        sweep=sweep,
        value=value,
        seed=seed,
        gates=vehicle.gates_passed,
        finished=len(times) >= laps,
        lap_time=sum(times) / len(times) if times else None,
        speed_max=plant.speed_max,
        ended=ended,
    )
