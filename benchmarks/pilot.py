"""Benchmark of the scripted pilot's lap times, a reference for what is possible on each track.

    python benchmarks/pilot.py --json results/pilot.json
    python benchmarks/pilot.py --speed 0.95 --num-envs 64

Every run is three laps from the start pose, at rest; with preset `faithful`, each run draws its own randomisation.
Columns: `clean` is the number of runs of N with all laps and no crash; `line` the planned lap time; `lap_first`,
`lap_mean` and `lap_best` in s, with mean and best over the flying laps (the second and third); speeds in m/s; `offset`
the largest distance from a gate's centre in m; `view` the share of time in which the nose camera sees the centre of
the target gate.
"""

from collections import Counter
from typing import Any

import torch
from measuring import make_parser, report

from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.pilot import ScriptedPilot
from dreamer_racing.envs.race.pilot_evaluation import PilotStatistics, evaluate_pilot
from dreamer_racing.envs.race.racing_line import LineLimits
from dreamer_racing.envs.tracks import PLAIN_TRACKS

COLUMNS = ("clean", "line", "lap_first", "lap_mean", "lap_best", "speed_mean", "speed_max", "offset", "view")


def main() -> None:
    """Fly every track in every preset."""
    parser = make_parser(__doc__)
    parser.add_argument("--tracks", nargs="*", default=PLAIN_TRACKS)
    parser.add_argument("--presets", nargs="*", default=("easy", "faithful"))
    parser.add_argument("--speed", type=float, default=LineLimits().speed, help="fraction of the thrust limit")
    parser.add_argument("--num-envs", type=int, default=32, help="runs of a randomised preset")
    parser.add_argument("--random-starts", action="store_true", help="start like training episodes")
    arguments = parser.parse_args()
    records = []
    for track in arguments.tracks:
        for preset in arguments.presets:
            pilot = ScriptedPilot(track, preset, LineLimits(speed=arguments.speed), dtype=torch.float64)
            randomised = arguments.random_starts or pilot.parameters.randomisation is not None
            flight = evaluate_pilot(
                track,
                preset,
                arguments.num_envs if randomised else 1,
                pilot=pilot,
                random_starts=arguments.random_starts,
            )
            record = {"track": track, "preset": preset, "speed": arguments.speed, "line": pilot.line.lap_time}
            records.append({**record, "random_starts": arguments.random_starts, **summary(flight)})
    report(records, ("track", "preset", "speed", *COLUMNS), arguments.json)


def summary(flight: PilotStatistics) -> dict[str, Any]:
    """Return the statistics of some runs."""
    flying_laps = flight.lap_times[:, 1:]
    flying_laps = flying_laps[flying_laps.isfinite()]
    crashes = Counter(CrashCause(int(cause)).name.lower() for cause in flight.crash if cause)
    return {
        "clean": f"{int(flight.finished.sum())} of {len(flight.finished)}",
        "runs": len(flight.finished),
        "runs_clean": int(flight.finished.sum()),
        "lap_first": float(flight.lap_times[:, 0].nanmean()),
        "lap_mean": float(flying_laps.mean()) if len(flying_laps) else None,
        "lap_best": float(flying_laps.min()) if len(flying_laps) else None,
        "speed_mean": float(flight.speed_mean.mean()),
        "speed_max": float(flight.speed_max.max()),
        "offset": float(flight.gate_offset_max.max()),
        "view": float(flight.gate_in_view.mean()),
        **{f"crashes_{cause}": count for cause, count in crashes.items()},
    }


if __name__ == "__main__":
    main()
