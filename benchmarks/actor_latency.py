"""Benchmark of the latency of exported actors in onnxruntime: included agents, and sizes with initial weights.

    python benchmarks/actor_latency.py --actors circle kidney figure8 --sizes paper_large --json actor_latency.json
    python benchmarks/actor_latency.py --sizes paper_large --keep exports
    python recipes/hil.py actor=exports/paper_large arm=false patience=60     # beside recipes/plant.py track=circle

Sizes are exported like in recipes/export.py, with the parity check, from networks with initial weights. Images are
noise. Neither weights nor images affect the latency. Sizes are also exported in two parts: `act` is the latency from
image to action if the recurrent state was advanced before the image arrived. With --keep, exports stay in folders named
after their sizes and can be used like any other: with arm=false, the loop runs without arming.
"""

import logging
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measuring import make_parser, report

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import hash_track, load_track
from dreamer_racing.export.actor_step import export_actor, make_step
from dreamer_racing.export.contract import make_contract
from dreamer_racing.export.onnx_actor import PARTS, OnnxActor, measure_latency
from dreamer_racing.export.parity import MIN_STEPS, episode_steps, record_flight
from dreamer_racing.modules import SIZES, Interface, get_size
from dreamer_racing.modules.agent import Agent

AGENTS = Path(__file__).parents[1] / "agents"
ACTOR, PRESET = "actor.onnx", "easy"
COLUMNS = (
    "actor", "parameters", "threads", "steps", "p50_ms", "p99_ms", "max_ms", "act_p50_ms", "act_p99_ms", "file_mb",
)  # fmt: skip


def main() -> None:
    """Measure every requested actor, one after another."""
    parser = make_parser(__doc__)
    parser.add_argument("--actors", nargs="*", default=[], help="names of included agents, or .onnx files")
    parser.add_argument("--sizes", nargs="*", default=[], choices=SIZES, metavar="SIZE", help=f"of {', '.join(SIZES)}")
    parser.add_argument("--track", default="circle", help="track in the contracts of sizes")
    parser.add_argument("--rate", type=float, default=50.0, help="control rate in the contracts of sizes, Hz")
    parser.add_argument("--steps", type=int, default=2000, help="number of timed steps")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--keep", help="folder in which to keep the exports of sizes")
    arguments = parser.parse_args()
    if not arguments.actors and not arguments.sizes:
        parser.error("nothing to measure: give --actors or --sizes")
    torch.set_num_threads(1)
    # The exporter warns four times that torchvision is not installed, which is not needed here.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    paths = {name: AGENTS / name / ACTOR if (AGENTS / name).is_dir() else Path(name) for name in arguments.actors}
    with tempfile.TemporaryDirectory() as folder:
        for size in arguments.sizes:
            paths[size] = export_initial(size, arguments.track, arguments.rate, Path(arguments.keep or folder) / size)
        records = [measure(name, path, arguments.steps, arguments.threads) for name, path in paths.items()]
    report(records, COLUMNS, arguments.json)


def export_initial(size: str, track: str, rate: float, folder: Path) -> Path:
    """Export an actor with initial weights; return its .onnx file."""
    torch.manual_seed(0)
    env = DroneRacingEnv(
        track, 1, seed=0, preset=PRESET, control_rate=rate, episode_steps=episode_steps(MIN_STEPS), num_threads=1
    )
    try:
        agent = Agent(get_size(size), Interface.of(env), decode=False).requires_grad_(False)
        step, flight = make_step(agent, "mode"), record_flight(env, agent, MIN_STEPS)
    finally:
        env.close()
    source: dict[str, Any] = {"checkpoint": "initial weights", "env_steps": 0, "weights": "initial"}
    source |= {"track": track, "preset": PRESET, "track_sha256": hash_track(load_track(track))}
    contract = make_contract(step, env.worlds.parameters, env.worlds.camera, **source)
    folder.mkdir(parents=True, exist_ok=True)
    export_actor(step, contract, flight, folder / ACTOR, parts=True)
    return folder / ACTOR


def measure(name: str, path: Path, steps: int, threads: int) -> dict[str, Any]:
    """Time single steps of an actor; return its record."""
    actor = OnnxActor(path, threads=threads, whole=True)
    entry = actor.contract["inputs"][0]
    seen = np.random.default_rng(0).integers(0, 256, (steps, *entry["shape"][1:])).astype(entry["type"])
    latency, act = measure_latency(actor.step, seen), None
    if PARTS.keys() <= actor.contract["files"].keys():
        actor = OnnxActor(path, threads=threads)
        act = measure_latency(actor.step, seen, actor.prepare)
    return {
        "benchmark": "actor_latency", "actor": name, "size": actor.contract["model"]["name"],
        "parameters": actor.contract["model"]["parameters"], "runtime": "onnxruntime", "threads": threads,
        "steps": steps, "p50_ms": latency.p50, "p99_ms": latency.p99, "max_ms": latency.max,
        "act_p50_ms": act and act.p50, "act_p99_ms": act and act.p99,
        "file_mb": sum(file.stat().st_size for file in weights_of(path)) / 1e6,
    }  # fmt: skip


def weights_of(path: Path) -> list[Path]:
    """Return the .onnx file and, if there is one, its separate file of weights."""
    return [path, *path.parent.glob("*.safetensors")]


if __name__ == "__main__":
    main()
