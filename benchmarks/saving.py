"""What a checkpoint with a full replay of a race costs: bytes, and seconds to save and to load.

    OMP_NUM_THREADS=1 python benchmarks/saving.py --json results/saving.json

32 drones fly Kidney at random with images until the replay is full; random numbers, which do not compress, stand for
the latents beside the records. Saving (`RunCheckpoints.save`, twice) includes checksums and waiting for the disk.
"""

import argparse
import tempfile
import time
from pathlib import Path

import torch
from measuring import print_table, write_json
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, TransformedEnv

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.experience.replay import StreamReplay, make_replay
from dreamer_racing.modules.stored_latents import LatentFormat
from dreamer_racing.training.checkpoint import RunCheckpoints

NUM_ENVS = 32
LATENTS = LatentFormat(belief=256, latents=16, classes=16, sampled=False)  # of cpu_small


def fill(capacity: int) -> StreamReplay:
    """Fly until the replay is full."""
    env = TransformedEnv(DroneRacingEnv("kidney", num_envs=NUM_ENVS, control_rate=25, seed=0), InitTracker())
    replay = make_replay(capacity, NUM_ENVS, 32, 16, latents=LATENTS)
    for rollout in Collector(env, None, frames_per_batch=64 * NUM_ENVS, total_frames=-1):
        shape = rollout.batch_size
        rollout["next", "belief"] = torch.rand(*shape, LATENTS.belief)
        rollout["next", "state"] = torch.rand(*shape, LATENTS.latents * LATENTS.classes)
        replay.extend(rollout)
        if len(replay) == capacity // NUM_ENVS * NUM_ENVS:
            return replay
    raise AssertionError("a collector without an end ended")


def main() -> None:
    """Fill, save twice, load."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=250_000)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    replay = fill(arguments.records)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        checkpoints = RunCheckpoints(folder, {"replay": replay})
        seconds = []
        for env_steps in (1, 2):
            start = time.perf_counter()
            saved = checkpoints.save(env_steps)
            seconds.append(time.perf_counter() - start)
        size = sum(file.stat().st_size for file in saved.rglob("*") if file.is_file())
        start = time.perf_counter()
        checkpoints.load(Path(folder))
        loading = time.perf_counter() - start
    raw = sum(stored.nbytes for _, stored in replay.storage.fields())
    record = {"records": len(replay), "in_memory_mb": raw / 1e6, "saved_mb": size / 1e6, "smaller_by": raw / size}
    record |= {"save_s": seconds[0], "save_again_s": seconds[1], "load_s": loading}
    print_table([record], list(record))
    write_json([record], arguments.json)


if __name__ == "__main__":
    main()
