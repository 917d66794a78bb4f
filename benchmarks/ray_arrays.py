"""Milliseconds to pack and unpack a rollout and weights for Ray's object store: tensor by tensor, as arrays, each once.

    python benchmarks/ray_arrays.py --json results/ray_arrays.json

The rollout is one of `recipes/dreamer_v3.py track=circle tuned=race`, of 16 worlds; the weights are its policy's.
`pack` and `unpack` are the least of `--times`, without the way through the store. `once`: what is observed before a
step and was after the last one is sent once, as workers do.
"""

import argparse
import pickle
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from measuring import print_table, write_json
from tensordict import TensorDict, TensorDictBase

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from collection_on_ray import composed
from composing.arena import make_env
from composing.building import make_collector
from composing.learners import make_learner

from dreamer_racing.experience.ray_arrays import as_arrays, as_tensors, pack_rollout, unpack_rollout
from dreamer_racing.modules import Interface

COLUMNS = ("what", "how", "megabytes", "pack", "unpack")


def main() -> None:
    """Measure both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    config = composed(["env.num_envs=16"])
    env = make_env(config, num_threads=1)
    policy = make_learner(config, Interface.of(env), torch.device("cpu")).policy()
    rollout = next(iter(make_collector(config, env, policy)))
    weights = TensorDict.from_module(policy).data
    jobs: list[tuple[str, str, TensorDictBase, Callable[[Any], Any], Callable[[Any], Any]]] = [
        ("rollout", "tensors", rollout, unchanged, unchanged),
        ("rollout", "arrays", rollout, as_arrays, as_tensors),
        ("rollout", "once", rollout, pack_rollout, unpack_rollout),
        ("weights", "tensors", weights, unchanged, unchanged),
        ("weights", "arrays", weights, as_arrays, as_tensors),
    ]
    records: list[dict[str, Any]] = []
    for what, how, data, to_send, to_use in jobs:
        packed = pack(to_send, data)
        size = (len(packed[0]) + sum(buffer.nbytes for buffer in packed[1])) / 1e6
        times = {
            "pack": least(partial(pack, to_send, data), arguments.times),
            "unpack": least(partial(unpack, to_use, packed), arguments.times),
        }
        records.append({"benchmark": "ray_arrays", "what": what, "how": how, "megabytes": size, **times})
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


def unchanged(data: Any) -> Any:
    """Hand on what is given."""
    return data


def pack(to_send: Callable[[Any], Any], data: Any) -> tuple[bytes, list[memoryview]]:
    """Pickle as Ray does: memory of arrays stays outside."""
    buffers: list[pickle.PickleBuffer] = []
    packed = pickle.dumps(to_send(data), protocol=5, buffer_callback=buffers.append)
    return packed, [each.raw() for each in buffers]


def unpack(to_use: Callable[[Any], Any], packed: tuple[bytes, list[memoryview]]) -> Any:
    """Make of it what it was."""
    data, buffers = packed
    return to_use(pickle.loads(data, buffers=buffers))


def least(job: Callable[[], Any], times: int) -> float:
    """Milliseconds."""
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        job()
        taken.append(time.perf_counter() - start)
    return 1e3 * min(taken)


if __name__ == "__main__":
    main()
