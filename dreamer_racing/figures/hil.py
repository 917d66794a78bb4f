"""Report of a hardware-in-the-loop flight: metrics and figures, written to the folder of its recording."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from dreamer_racing.evaluation.trajectory import Trajectory, read_trajectory
from dreamer_racing.figures.drawing import CRASH_COLOR, INK, MUTED, dress, save
from dreamer_racing.figures.flights import NamedFlight, plot_flights
from dreamer_racing.figures.hil_numbers import (
    CHANNELS,
    FlownFlight,
    Response,
    gate_passes,
    lap_times,
    latencies,
    read_flown,
    responses,
    tracking_error,
)
from dreamer_racing.hil.progress import GatePass

REPORT, LATENCY, TRAJECTORY, TRACKING = "report.json", "report_latency.png", "report_flight.png", "report_tracking.png"
SHORTEST = 0.01  # ms; shorter latencies are drawn at this value, because the axis is logarithmic [choice]
ASKED_COLOR, MEASURED_COLOR = INK, "#f2711c"
LABELS = {
    "collective_thrust": "thrust (m/s²)",
    "body_rate_x": "roll rate, x (rad/s)",
    "body_rate_y": "pitch rate, y (rad/s)",
    "body_rate_z": "yaw rate, z (rad/s)",
}


def write_report(flight_path: Path, against: Path | None = None) -> list[str]:
    """Write ``report.json`` and figures into the folder of a recorded flight; return lines of a summary.

    Reference: paper, Fig. "real world": trajectories with the camera's direction, and speed profiles.

    Args:
        flight_path: The recording, or its folder.
        against: Flight to compare with: another recording, or the trajectory (CSV) of an evaluation.

    Raises:
        FileNotFoundError: A flight does not exist.
        ValueError: A file is damaged or empty, or holds no flight.
    """
    flight = read_flown(flight_path)
    other = None if against is None else _read_other(against)
    folder = flight_path if flight_path.is_dir() else flight_path.parent
    passes, response = gate_passes(flight), responses(flight)
    report = _make_report(flight, passes, response)
    own = trajectory_of(flight)
    report["problems"] += [] if own else ["it was armed for less than two ticks: there is no trajectory to draw"]
    for name in (LATENCY, TRAJECTORY, TRACKING, REPORT):
        (folder / name).unlink(missing_ok=True)  # of an earlier report
    _draw_latencies(report["latency"], flight.about.get("rate"), folder / LATENCY)
    if own is not None:
        report["flown"] = _summary(own)
        shown = [NamedFlight("flown", flight.track, own)] + ([other] if other else [])
        plot_flights(shown, folder / TRAJECTORY, problems=report["problems"])
    if other is not None:
        report["against"] = {"path": str(against), "title": other.title, **_summary(other.trajectory)}
    if any(report["tracking"].values()):
        _draw_tracking(response, report["tracking"], float(flight.time[flight.flown][0]), folder / TRACKING)
    report["figures"] = [name for name in (LATENCY, TRAJECTORY, TRACKING) if (folder / name).exists()]
    text = json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / REPORT).write_text(text + "\n", encoding="utf-8")
    return [*_lines(report), f"written to {folder}: {', '.join([REPORT, *report['figures']])}"]


def trajectory_of(flight: FlownFlight) -> Trajectory | None:
    """Return the armed part of the flight as a trajectory; None if it is shorter than one step.

    Rows are the poses that the flyer used, actions the commands in SI units.
    """
    ticks = np.arange(len(flight.time))[flight.flown]
    ticks = ticks[np.isfinite(flight.seen[ticks]).all(axis=1)]
    duration = float(flight.time[ticks[-1]] - flight.time[ticks[0]]) if len(ticks) else 0.0
    if not duration > 0.0:
        return None
    seen = torch.from_numpy(flight.seen[ticks]).float()
    camera = (flight.about.get("contract") or {}).get("camera") or {}  # no contract in manual flight
    return Trajectory(
        position=seen[:, :3],
        attitude=seen[:, 3:7],
        linear_velocity=seen[:, 7:10],
        target_gate=torch.from_numpy(flight.target_gate[ticks]),
        action=torch.from_numpy(flight.command[ticks[:-1]]).float(),
        pixels=None,
        control_dt=duration / (len(ticks) - 1),  # the mean
        outcome=flight.ended,
        camera_tilt=camera.get("tilt_up_deg"),
    )


def _read_other(path: Path) -> NamedFlight:
    if path.suffix == ".csv":
        if not path.is_file():
            raise FileNotFoundError(f"against={path}: there is no such file.")
        simulated, track = read_trajectory(path)
        return NamedFlight(f"simulated ({path.stem})", track, simulated)
    flight = read_flown(path)
    flown = trajectory_of(flight)
    if flown is None:
        raise ValueError(f"against={path}: this flight was never armed, or for one tick only: nothing to compare.")
    name = path.name if path.is_dir() else path.parent.name
    return NamedFlight(f"other flight ({name})", flight.track, flown)


def _make_report(flight: FlownFlight, passes: list[GatePass], response: dict[str, Response]) -> dict[str, Any]:
    config, ticks = flight.about.get("config") or {}, flight.time[flight.flown]
    began = float(ticks[0]) if len(ticks) else 0.0
    problems = [] if flight.whole else ["the file is incomplete: the loop was killed, or is still running"]
    counted = int(flight.passes.max())
    if counted != len(passes):
        problems.append(f"the loop counted {counted} gates, but the recorded poses give {len(passes)}")
    return {
        "flight": str(flight.path),
        "track": flight.track.name,
        **{name: config.get(name) for name in ("actor", "link", "pose", "stamping", "operator")},
        "rate_hz": flight.about.get("rate"),
        "ticks": len(flight.time),
        "duration_s": float(flight.time[-1] - flight.time[0]),
        "armed_s": float(ticks[-1] - ticks[0]) if len(ticks) else 0.0,
        "ended": flight.ended or ("recording stopped" if len(ticks) else "never armed"),
        "poses": {"taken": len(flight.poses), "out_of_order": flight.out_of_order},
        "latency": latencies(flight),
        "gates": [
            {"number": passed.gate + 1, "time_s": float(passed.time - began), "offset_m": float(passed.offset)}
            for passed in passes
        ],
        "laps_s": lap_times(flight, passes),
        "tracking": {name: tracking_error(response[name]) if response else None for name in CHANNELS},
        "problems": problems,
    }


def _summary(trajectory: Trajectory) -> dict[str, float]:
    """Return summary statistics of a flight; non-finite rows are left out."""
    speed = trajectory.speed.numpy().astype(float)
    speed = speed[np.isfinite(speed)]
    steps = np.linalg.norm(np.diff(trajectory.position.numpy().astype(float), axis=0), axis=1)
    return {
        "gates": trajectory.gates_passed,
        "duration_s": trajectory.duration,
        "distance_m": float(steps[np.isfinite(steps)].sum()),
        "speed_max": float(speed.max(initial=0.0)),
        "speed_mean": float(speed.mean()) if len(speed) else 0.0,
    }


def _draw_latencies(latency: dict[str, Any], rate: float | None, path: Path) -> None:
    stages = {name: row for name, row in latency["stages"].items() if row is not None}
    figure = Figure(figsize=(7.0, 1.2 + 0.34 * max(len(stages), 1)), layout="constrained")
    axes = figure.subplots()
    style: dict[str, Any] = {"linestyle": "", "markersize": 7, "zorder": 3}
    marks = (("p50_ms", "o", INK, "median"), ("p99_ms", "D", "#2f5fb3", "p99"), ("max_ms", "|", CRASH_COLOR, "largest"))
    rows = range(len(stages))
    values = {key: [max(row[key], SHORTEST) for row in stages.values()] for key, *_ in marks}
    axes.hlines(rows, values["p50_ms"], values["max_ms"], color=MUTED, linewidth=1.0, zorder=2)
    for key, marker, color, label in marks:
        axes.plot(values[key], rows, marker=marker, color=color, label=label, markeredgewidth=2, **style)
    if rate:
        axes.axvline(1e3 / rate, color=MUTED, linestyle=(0, (4, 3)), linewidth=1.0, label=f"period, {1e3 / rate:g} ms")
    axes.set_yticks(rows, [name.replace("_", " ") for name in stages])
    axes.set(xscale="log", xlabel=f"ms, of {latency['of']} (n = {latency['ticks']:,})", ylim=(len(stages) - 0.4, -0.6))
    axes.set_xlim(*_decades([value for column in values.values() for value in column] + ([1e3 / rate] if rate else [])))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_title(f"latencies; deadlines missed: {latency['missed_deadlines']}", loc="left", fontsize=10, color=INK)
    dress(axes)
    axes.tick_params(which="minor", length=0)
    figure.legend(loc="outside lower left", ncols=4, frameon=False, fontsize=8)
    save(figure, path)


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Return powers of ten around positive values, with a margin; one decade around 1 if there are none."""
    low, high = min(values, default=1.0), max(values, default=1.0)
    return 10.0 ** math.floor(math.log10(0.8 * low)), 10.0 ** math.ceil(math.log10(1.25 * high))


def _draw_tracking(
    response: dict[str, Response], errors: dict[str, dict[str, float | None] | None], began: float, path: Path
) -> None:
    figure = Figure(figsize=(9.0, 1.75 * len(response) + 0.5), layout="constrained")
    panels = figure.subplots(len(response), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, (asked_time, asked, time, measured)) in zip(panels, response.items(), strict=True):
        axes.step(asked_time - began, asked, where="post", color=ASKED_COLOR, linewidth=0.9, label="commanded")
        axes.plot(time - began, measured, color=MEASURED_COLOR, linewidth=1.2, alpha=0.85, label="measured")
        axes.set_ylabel(LABELS[name], fontsize=8)
        axes.set_title(_error_text(name, errors[name]), loc="left", fontsize=8, color=MUTED)
        dress(axes)
    figure.align_ylabels(panels)
    panels[-1].set_xlabel("time since arming (s); thrust is measured from velocities and includes drag")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=2, frameon=False, fontsize=8)
    save(figure, path)


def _error_text(name: str, error: dict[str, float | None] | None) -> str:
    if error is None:
        return "too few measurements for an error"
    lag = "no lag, as the command is constant" if error["lag_ms"] is None else f"at a lag of {error['lag_ms']:.0f} ms"
    return f"RMS error {error['rms']:.3g} {CHANNELS[name]}, {lag} ({error['rms_without_lag']:.3g} without lag)"


def _lines(report: dict[str, Any]) -> list[str]:
    lines = [
        f"{report['actor'] or 'flight'} on {report['track']}: armed for {report['armed_s']:.2f} s of "
        f"{report['duration_s']:.2f} s, ended: {report['ended']}",
        f"latencies of {report['latency']['of']} (ms); deadlines missed: {report['latency']['missed_deadlines']}",
    ]
    lines += [
        f"  {name:<11} p50 {row['p50_ms']:7.2f}   p99 {row['p99_ms']:7.2f}   max {row['max_ms']:7.2f}"
        for name, row in report["latency"]["stages"].items()
        if row is not None
    ]
    offsets = [passed["offset_m"] for passed in report["gates"]]
    middle = f", {np.mean(offsets):.2f} m from the centre on average, {max(offsets):.2f} m at most" if offsets else ""
    lines.append(f"gates passed: {len(offsets)}{middle}")
    for name, laps in report["laps_s"].items():
        lines += [f"laps ({name}): {', '.join(f'{lap:.2f} s' for lap in laps)}"] if laps else []
    lines += [f"{name}: {_error_text(name, error)}" for name, error in report["tracking"].items() if error]
    lines += [
        f"{name}: up to {flight['speed_max']:.1f} m/s, {flight['speed_mean']:.1f} on average, "
        f"{flight['gates']} gates in {flight['duration_s']:.2f} s"
        for name, flight in (("flown", report.get("flown")), ("against", report.get("against")))
        if flight
    ]
    return lines + [f"note: {problem}" for problem in report["problems"]]
