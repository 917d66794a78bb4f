"""What an agent sees in the first seconds of an episode, and how many end there: from the records of a run's replay.

    OMP_NUM_THREADS=1 python benchmarks/first_seconds.py runs/circle --json first_seconds.json

Of the flights in the replay that began at the track's start, at rest, `crashed` is the share that ended within 40
records. By record since the start, and apart for flights that went on and those that did not: root mean square over
flights of the error, as a vector, of the decoded `velocity` (m/s) and of the decoded way `to_gate` (m) to the target
gate's centre; memory is empty at the start, as it was when they were flown. The trained weights are measured, not the
averaged ones. The checkpoint must hold a replay, so no best/, and the loss must decode the state.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import torch
from learning_signal import restore, restore_replay
from measuring import print_table, write_json
from tensordict import TensorDictBase
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.saved import trained_config
from composing.schema import DreamerConfig

from dreamer_racing.envs.race.race_vector import DISTANCE, VELOCITY
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.heads import symexp
from dreamer_racing.modules.world_model import WorldModel, join_features
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

LENGTH, RECORDS = 40, (0, 1, 2, 4, 8, 12, 16, 24, 32)  # records looked at, and those reported
AT_REST = 0.1  # m/s: episodes that begin elsewhere begin in flight, at 0.2 m/s or more
FLIGHTS = 50  # observed at a time
COLUMNS = ["record", "crashed", "went_on", "velocity", "to_gate", "crashed_velocity", "crashed_to_gate"]


def main() -> None:
    """Measure every run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = []
    for path in arguments.checkpoints:
        found = list(measure(latest_checkpoint(path)))
        print_table(found, COLUMNS)
        records += found
    write_json(records, arguments.json)


@torch.no_grad()
def measure(checkpoint: Path) -> Iterator[dict[str, Any]]:
    """Yield a record for each of `RECORDS`.

    Raises:
        ValueError: the checkpoint's losses do not decode the state, or no flight in its replay began at the start.
    """
    config = trained_config(RunDirectory.of(checkpoint).path)
    if not isinstance(config, DreamerConfig):
        raise ValueError(f"{checkpoint} was trained by {config.algorithm}, which has no world model.")
    config.device, config.replay.device = "cpu", "auto"  # wherever it was trained
    learner, counters = restore(config, checkpoint)
    decoder = getattr(learner.losses["world_model"], "privileged_decoder", None)
    if decoder is None:
        raise ValueError(f"{checkpoint}: loss={config.loss.world_model} decodes no state; loss=privileged does.")
    replay = restore_replay(config, checkpoint, learner, config.model.batch_size, config.model.batch_length)
    flights = first_records(replay)
    if not len(flights):
        raise ValueError(f"{checkpoint}: no flight in the replay began at the start, at rest.")
    velocity, to_gate = errors(learner.agent.world_model, decoder, flights)
    again = flights["is_init"][:, 1:, 0].int().cumsum(1) > 0  # (M, LENGTH - 1): another episode has begun
    crashed, ended = again.any(1), torch.cat((again.new_zeros(len(again), 1), again), 1)
    for record in RECORDS:
        went_on, fell = ~crashed, crashed & ~ended[:, record]
        yield {
            "benchmark": "first_seconds", "track": config.track, **counters, "record": record,
            "flights": len(flights), "crashed": crashed.float().mean().item(), "went_on": int(went_on.sum()),
            "velocity": _root_mean_square(velocity[went_on, record]),
            "to_gate": _root_mean_square(to_gate[went_on, record]),
            "crashed_velocity": _root_mean_square(velocity[fell, record]),
            "crashed_to_gate": _root_mean_square(to_gate[fell, record]),
        }  # fmt: skip


def first_records(replay: StreamReplay) -> TensorDictBase:
    """Return the first records of all flights that began at the start, ``[M, LENGTH]``, by streams."""
    found = []
    for stream in range(replay.num_streams):
        records = replay.records(stream)
        begins = records["is_init"].squeeze(-1)
        at_rest = VELOCITY * records["privileged", "vector"][:, :3].norm(dim=-1) < AT_REST
        first = (begins & at_rest).nonzero().squeeze(-1)
        found += [records[start : start + LENGTH] for start in first.tolist() if start + LENGTH <= len(begins)]
    return cast(TensorDictBase, torch.stack(cast(Any, found))) if found else records[:0]


def errors(model: WorldModel, decoder: VectorDecoder, flights: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return by how much the decoded velocity (m/s) and way to the gate (m) are wrong, both ``(M, LENGTH)``."""
    seen = []
    for part in flights.split(FLIGHTS):
        posterior = model.observe(part, part["previous_action"], part["is_init"].squeeze(-1))
        seen.append(symexp(decoder.mlp(join_features(posterior.belief, posterior.state))))
    wrong = torch.cat(seen) - flights["privileged", "vector"]
    return VELOCITY * wrong[..., :3].norm(dim=-1), DISTANCE * wrong[..., 9:12].norm(dim=-1)


def _root_mean_square(values: Tensor) -> float | None:
    """Of one number a flight; None where there is none."""
    return values.square().mean().sqrt().item() if len(values) else None


if __name__ == "__main__":
    main()
