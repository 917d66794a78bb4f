"""Forecast of training with workers: env_steps a second, what holds it back, how old weights are, what it costs.

    python benchmarks/pipeline.py --json results/pipeline.json
    python benchmarks/pipeline.py --learn 0.02 --worlds 32 --link 3.1e9      # a learner on a GPU, as fast as assumed
    python benchmarks/pipeline.py --check results/collection_on_ray.json --json results/pipeline_check.json

A model, not a measurement: it plays the rounds of `collector=ray`. In a round every worker flies one rollout with the
weights that it was sent, while the learner learns from the round before; rollouts come over one link, one after the
other, and are copied by the learner; the round is over when the slowest worker's has come. Times of flights scatter by
a log-normal factor, and a worker that dies costs its round a new start. Where processes are more than `--cores`, those
that work share them evenly. What one process needs for an env_step is taken from `results/cores.json` (`--fly`,
`--learn`); everything else is an argument with its default below.

`--check` forecasts what `collection_on_ray.py` measured with workers from what it measured without: the time of an
env_step in one process with one thread and as few worlds, and from two such processes side by side, how many cores'
worth the machine is, at most those that it has. Link, copying, overhead and scatter are the defaults.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import print_table, write_json

CORES = Path(__file__).parents[1] / "results" / "cores.json"
WORKERS = (1, 2, 4, 8, 64, 512)
COLUMNS = (
    "workers", "env_steps_per_s", "times", "held_back_by", "learner_busy", "worker_busy", "link_busy", "weights_age",
    "weights_age_s", "hours", "cost",
)  # fmt: skip
CHECKED = ("workers", "worlds", "rollout_steps", "cores", "forecast", "measured", "ratio")
BYTES_SENT = 16_400
"""Of a step: the image after it, and all the rest (`ray_arrays.py`)."""
BYTES_TAKEN = 29_100
"""Of a step, where the learner has unpacked it: the image before it, too."""


class Pipeline(NamedTuple):
    """What takes how long.

    Attributes:
        fly: ms for an env_step, of a worker that flies as many worlds as it has.
        learn: ms for an env_step, of the learner: the updates that it owes for one.
        worlds: Of a worker.
        steps: Control steps of a rollout.
        sent: Bytes of a step, on the link.
        taken: Bytes of a step that the learner takes in.
        weights: Bytes that are sent to each worker in each round.
        link: Bytes a second to and from the learner.
        copy: Bytes a second at which the learner takes records in.
        overhead: ms a round that the learner spends on asking and waiting, for each worker.
        scatter: Standard deviation of the logarithm of the time of a rollout.
        cores: Of the learner and all workers together; one for each if 0.
        deaths: Of a worker, an hour.
        restart: s until one that died has flown its rollout again.
    """

    fly: float
    learn: float
    worlds: int = 16
    steps: int = 8
    sent: int = BYTES_SENT
    taken: int = BYTES_TAKEN
    weights: float = 2.9e6
    link: float = 1.25e9
    copy: float = 1e9
    overhead: float = 1.0
    scatter: float = 0.1
    cores: float = 0.0
    deaths: float = 0.0
    restart: float = 20.0


def main() -> None:
    """Print the forecast for every number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="*", default=WORKERS)
    for name, value in {**one_process(), **Pipeline._field_defaults}.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    parser.add_argument("--rounds", type=int, default=2000)
    parser.add_argument("--env-steps", type=float, default=1.5e6, help="of the run whose hours and cost are said")
    parser.add_argument("--learner-price", type=float, default=0.0, help="$ an hour")
    parser.add_argument("--worker-price", type=float, default=0.0, help="$ an hour")
    parser.add_argument("--check", type=Path, metavar="FILE", help="of collection_on_ray.py --json")
    parser.add_argument("--json", help="file for the numbers")
    arguments = parser.parse_args()
    if min(arguments.workers) < 1 or not all(
        getattr(arguments, name) > 0 for name in ("link", "copy", "worlds", "steps", "fly", "rounds", "env_steps")
    ):
        parser.error("workers, and all that is flown, carried or copied, must be above 0.")
    if arguments.check:
        try:
            checked = check(json.loads(arguments.check.read_text()))
        except (OSError, ValueError, KeyError, TypeError) as error:
            parser.error(
                f"--check {arguments.check}: no result of collection_on_ray.py ({type(error).__name__}: {error})."
            )
        print_table(checked, CHECKED)
        write_json(checked, arguments.json)
        return
    pipeline = Pipeline(**{name: getattr(arguments, name) for name in Pipeline._fields})
    alone = 1e3 / (pipeline.fly + pipeline.learn)
    print(f"one process, in turns: {alone:,.0f} env_steps/s")
    records = []
    for workers in arguments.workers:
        found = play(pipeline, workers, arguments.rounds)
        hours = arguments.env_steps / found["env_steps_per_s"] / 3600
        price = arguments.learner_price + workers * arguments.worker_price
        records.append(
            {"benchmark": "pipeline", "workers": workers, **found, "times": found["env_steps_per_s"] / alone,
             "hours": hours, "cost": hours * price, **pipeline._asdict()}
        )  # fmt: skip
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def one_process() -> dict[str, float]:
    """Milliseconds for an env_step that one process spends on flying and on learning, as measured on one core."""
    record = next(each for each in json.loads(CORES.read_text()) if (each["cores"], each["threads"]) == (1, 1))
    of_a_step = 1e3 / record["env_steps_per_s"]
    return {"fly": round(record["collect"] * of_a_step, 3), "learn": round((1 - record["collect"]) * of_a_step, 3)}


def check(measured: list[dict[str, Any]], rounds: int = 2000) -> list[dict[str, Any]]:
    """Forecast what workers collect on a machine from what processes without anything in common collect there.

    Args:
        measured: records of `collection_on_ray.py`.
        rounds: to play.

    Returns:
        One record for each number of workers and length of rollouts.

    Raises:
        ValueError: two processes, or one with as few worlds as a worker, were not measured.
    """
    speeds = {
        (each["processes"], each["worlds"], each["rollout_steps"]): each["env_steps_per_s"]
        for each in measured
        if each["processes"]
    }
    workers = [each for each in measured if each["workers"]]
    pairs = [case for case in speeds if case[0] == 2]
    needed = {(1, each["worlds"], each["rollout_steps"]) for each in workers} | {(1, *pair[1:]) for pair in pairs}
    if not pairs or not needed <= speeds.keys():
        raise ValueError("--check needs one and two processes with as many worlds as a worker has: --workers 2.")
    gain = float(np.mean([speeds[pair] / speeds[1, *pair[1:]] for pair in pairs]))
    cores = min(gain, float(measured[0]["cores"]))
    records = []
    for each in workers:
        worlds, steps = each["worlds"], each["rollout_steps"]
        pipeline = Pipeline(1e3 / speeds[1, worlds, steps], 0.0, worlds, steps, cores=cores)
        forecast = play(pipeline, each["workers"], rounds)["env_steps_per_s"]
        ratio = forecast / each["env_steps_per_s"]
        found = {"cores": pipeline.cores, "forecast": forecast, "measured": each["env_steps_per_s"], "ratio": ratio}
        records.append({"benchmark": "pipeline_check", **{name: each[name] for name in CHECKED[:3]}, **found})
    return records


def share(work: np.ndarray, cores: float) -> np.ndarray:
    """When jobs are done (K,) that begin together with so much work (K,), on cores that they share evenly.

    A job runs on one core at the most; 0 cores are one for each.
    """
    if not cores:
        return work
    order, jobs = np.argsort(work), len(work)
    pace = np.minimum(1.0, cores / np.arange(jobs, 0, -1))  # of those that still run, as one after the other is done
    done = np.empty(jobs)
    done[order] = np.cumsum(np.diff(work[order], prepend=0.0) / pace)
    return done


def play(pipeline: Pipeline, workers: int, rounds: int, seed: int = 0) -> dict[str, Any]:
    """Play rounds; return env_steps a second, shares of time that are spent working, and the age of weights."""
    draw = np.random.default_rng(seed)
    rollout = pipeline.worlds * pipeline.steps  # env_steps
    flight = 1e-3 * pipeline.fly * rollout
    transfer = rollout * pipeline.sent / pipeline.link
    sending = workers * pipeline.weights / pipeline.link
    taking = workers * (rollout * pipeline.taken / pipeline.copy + 1e-3 * pipeline.overhead)
    learning = 1e-3 * pipeline.learn * rollout * workers

    clock, asked, flown, round_age = 0.0, 0.0, 0.0, []
    owed, taken_at = 0.0, 0.0  # learning from the round before: none yet; when its weights were taken
    for _ in range(rounds):
        times = flight * draw.lognormal(-0.5 * pipeline.scatter**2, pipeline.scatter, workers)
        lost = draw.random(workers) < pipeline.deaths * flight / 3600
        *shared, learned = share(np.append(times, owed), pipeline.cores)
        done = asked + sending + np.sort(shared + lost * pipeline.restart)
        # each waits for the link until those before it are through
        arrived = np.max(done + transfer * np.arange(workers, 0, -1))
        round_age.append(asked + learned - taken_at)  # of the round before, once it is learned from
        clock, taken_at = max(asked + learned, arrived) + taking, asked
        asked, owed = clock, learning  # the next round is asked for before this one is learned from
        flown += times.sum()
    clock += owed

    busy = {
        "learner": rounds * (learning + taking) / clock,
        "worker": flown / workers / clock,
        "link": rounds * (workers * transfer + sending) / clock,
    }
    if pipeline.cores:
        busy["cores"] = (flown + rounds * (learning + taking)) / pipeline.cores / clock
    return {
        "env_steps_per_s": rounds * rollout * workers / clock,
        "held_back_by": max(busy, key=busy.__getitem__),
        **{f"{part}_busy": busy_share for part, busy_share in busy.items()},
        "weights_age": 2 * rollout * workers,
        "weights_age_s": float(np.mean(round_age[1:])),
    }


if __name__ == "__main__":
    main()
