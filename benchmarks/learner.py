"""Benchmark of learner updates by size, loss and backend: time, FLOPs, calls, memory, share of the hardware's limit.

    python benchmarks/learner.py --sizes cpu_small --batch 8 32 --horizon 15 --json results/learner.json
    python benchmarks/learner.py --sizes size12m paper_large --backends eager graph --mixed-precision
    python benchmarks/learner.py --losses reconstruction privileged decoder_free --actor-losses reinforce dynamics
    python benchmarks/learner.py --peers torchrl_small      # and TorchRL's own assembly, see stock_dreamer.py
    python benchmarks/learner.py --launches --sizes paper_large size12m --batch 64 16 --horizon 16
    python benchmarks/learner.py --table docs/sizes.md      # parameters, FLOPs and memory of every size; no update runs

Columns: `s` is the median of one whole update (losses, gradients, optimiser, slow critic) on a synthetic batch;
`calls` are ATen calls; `GFLOP` is the work of matrix products and convolutions, forward and backward, counted by torch;
`share` is GFLOP / s over the speed of a large matrix product measured in the same run at the same precision;
`sample_share` is the time of sampling and moving a replay batch over that of the update; `memory` is the peak of the
process on a CPU (resident) or of the device, GiB.

With `--launches` nothing is timed: the kernels that an update would launch on a CUDA device under bfloat16 are counted
on a CPU (`tests/launches.py`), with and without `few_kernels`, for windows that begin with stored latents. Their
number depends on T, H and the size's layers, not on B and widths, so that narrow networks are used; an RMS norm, which
is several operations on a CPU, counts once as on CUDA. `casts` is the number of type conversions among them.
"""

import argparse
import resource
import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from measuring import make_parser, matmul_speed, print_table, report, seconds, write_json
from tensordict import TensorDict
from torch import Tensor
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from dreamer_racing.experience.replay import make_replay
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.latent_ppo import CRITICS, LatentPPO
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses
from dreamer_racing.machine import keep_freed_memory
from dreamer_racing.modules import SIZES, Interface, ModelSize, get_size, layers

PRIVILEGED_DIM = 21
WARM_UP = 3  # updates that are not counted
BACKENDS = ("eager", "graph")
PEERS = ("torchrl_small", "torchrl_large")
COLUMNS = ("size", "loss", "actor", "backend", "batch", "horizon", "parameters", "s", "calls", "GFLOP", "share",
           "sample_share", "memory")  # fmt: skip
LAUNCHES = ("size", "loss", "actor", "batch", "horizon", "few_kernels", "launches", "casts")
NARROW: dict[str, Any] = {"belief": 32, "hidden": 16, "latents": 4, "classes": 4, "units": 16}


def main() -> None:
    """Measure every requested combination, each in a separate process."""
    parser = make_parser(__doc__)
    parser.add_argument("--sizes", nargs="*", default=["cpu_small"], help=f"any of {', '.join(SIZES)}")
    parser.add_argument("--losses", nargs="*", default=["reconstruction"])
    parser.add_argument("--actor-losses", nargs="*", default=["reinforce"])
    parser.add_argument("--backends", nargs="*", default=["eager"], choices=BACKENDS)
    parser.add_argument("--batch", nargs=2, type=int, default=(8, 32), metavar=("B", "T"))
    parser.add_argument("--horizon", type=int, default=15)
    parser.add_argument("--starts", type=int, help="latents of a batch at which imagination starts; default: all")
    parser.add_argument("--image-size", type=int, default=64, help="pixels; peers always use 64")
    parser.add_argument("--mixed-precision", action="store_true", help="bfloat16 autocast")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--updates", type=int, default=20, help="timed updates, after the warm-up")
    parser.add_argument("--peers", nargs="*", default=[], choices=PEERS, help="each timed as it is, and tuned")
    parser.add_argument("--return-freed-memory", action="store_true", help="do not call keep_freed_memory()")
    parser.add_argument("--few-kernels", action="store_true", help="few kernels, the default on CUDA")
    parser.add_argument("--launches", action="store_true", help="count kernel launches of a CUDA device, time nothing")
    parser.add_argument("--table", help="write the table of sizes to this Markdown file instead")
    arguments = parser.parse_args()
    if arguments.table:
        write_size_table(Path(arguments.table))
        return
    if arguments.launches:
        print_launches(parser, arguments)
        return
    shared = (tuple(arguments.batch), arguments.horizon, arguments.device, arguments.threads, arguments.updates)
    few_kernels = True if arguments.few_kernels else None
    settings = [
        Setting(loss, actor, arguments.mixed_precision, arguments.image_size, *shared, few_kernels, arguments.starts)
        for loss in arguments.losses
        for actor in arguments.actor_losses
    ]
    prepare = None if arguments.return_freed_memory else keep_freed_memory
    jobs: list[tuple[Callable[..., dict[str, Any]], tuple, Callable[[], Any] | None]] = [
        (measure, (size, backend, setting), prepare)
        for size in arguments.sizes
        for setting in settings
        for backend in arguments.backends
    ]
    if arguments.peers:
        from stock_dreamer import measure_stock

        shapes = [peer.removeprefix("torchrl_") for peer in arguments.peers]
        jobs += [(measure_stock, (*shared, shape, False), None) for shape in shapes]
        jobs += [(measure_stock, (*shared, shape, True), prepare) for shape in shapes]
    records = []
    for function, values, initializer in jobs:
        with ProcessPoolExecutor(1, get_context("spawn"), initializer) as process:
            how = {"threads": arguments.threads, "keeps_freed_memory": initializer is not None}
            records.append(process.submit(function, *values).result() | how)
            print_table(records[-1:], COLUMNS)
    write_json(records, arguments.json)


def print_launches(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """Print the number of kernels that a CUDA device would launch, with and without ``few_kernels``."""
    of_times = ("backends", "peers", "device", "updates", "threads")
    unused = (*of_times, "mixed_precision", "few_kernels", "image_size", "starts")
    if given := [name for name in unused if getattr(arguments, name) != parser.get_default(name)]:
        parser.error(f"--launches counts kernels on a CPU: do not add --{given[0].replace('_', '-')}.")
    counted = [
        count_launches(size, loss, actor, arguments.batch, arguments.horizon, few)
        for size, loss, actor, few in product(arguments.sizes, arguments.losses, arguments.actor_losses, (False, True))
    ]
    report(counted, LAUNCHES, arguments.json)


@dataclass(frozen=True)
class Setting:
    """Settings of a measurement that are the same for all sizes."""

    loss: str  # of the world model
    actor: str
    mixed_precision: bool
    image_size: int  # pixels
    batch: tuple[int, int]  # B, T
    horizon: int  # imagined steps
    device: str
    threads: int
    updates: int  # timed, after WARM_UP
    few_kernels: bool | None = None  # None: only on a CUDA device
    starts: int | None = None  # number of imagination's starts; None: all latents of the batch

    def learner(self, size: str, backend: str = "eager") -> WorldModelLearner:
        """Make the learner of a size."""
        torch.set_num_threads(self.threads)
        torch.set_float32_matmul_precision("high")
        graph, mixed, few = "graph" in backend, self.mixed_precision, self.few_kernels
        config = replace(self.config(), cuda_graph=graph, mixed_precision=mixed, few_kernels=few)
        return make_learner(size, self.loss, self.actor, config, self.image_size, self.device)

    def config(self) -> LearnerConfig:
        """Return the settings of an update, which are also used to count its FLOPs."""
        return LearnerConfig(imagination_horizon=self.horizon, imagination_starts=self.starts)


def make_learner(
    size: ModelSize | str, loss: str, actor: str, config: LearnerConfig, image_size: int = 64, device: str = "cpu"
) -> WorldModelLearner:
    """Make a DreamerV3 learner with the objective ``actor``, or a latent-PPO learner with the critic ``actor``."""
    interface = interface_of(image_size)
    if actor in CRITICS:
        of_ppo = LatentPPOLosses(world_model=loss, critic=actor)
        return LatentPPO.make(size, interface, of_ppo, config, device=device, seed=0)
    losses = DreamerV3Losses(world_model=loss, actor=actor)
    return DreamerV3.make(size, interface, losses, config, device=device, seed=0)


def measure(size: str, backend: str, setting: Setting) -> dict[str, Any]:
    """Time updates of one configuration; return one record."""
    device = setting.device
    learner = setting.learner(size, backend)
    replay = filled_replay(setting.batch, device, setting.image_size)
    samples = [seconds(replay.sample, device) for _ in range(5)]
    data = replay.sample()
    timed = time_updates(
        lambda: learner.update(data),
        setting.updates,
        device,
        setting.mixed_precision,
        lambda: dry_update(size, setting.loss, setting.actor, setting.batch, setting.config(), setting.image_size)[0],
        count=backend == "eager",
    )
    return {
        "benchmark": "learner", "size": size, "loss": setting.loss, "actor": setting.actor,
        "backend": backend + ("+bf16" if setting.mixed_precision else ""), "batch": "x".join(map(str, setting.batch)),
        "horizon": setting.horizon, "image_size": setting.image_size, "parameters": parameters(learner),
        **timed, "sample_share": statistics.median(samples) / timed["s"],
    }  # fmt: skip


def time_updates(
    update: Callable[[], Any],
    number: int,
    device: str,
    mixed_precision: bool,
    count_flops: Callable[[], int],
    count: bool,
    first: Callable[[], Any] | None = None,
) -> dict[str, Any]:
    """Time updates of our learner or of a peer; return the columns of a record about speed and memory.

    Args:
        update: function that makes an update.
        number: number of timed updates, after `WARM_UP`.
        device: device of the learner.
        mixed_precision: whether the update computes in bfloat16.
        count_flops: function that counts the FLOPs of an update; called after the timing.
        count: whether to count ATen calls.
        first: function for the first update, if it differs.
    """
    s_first = seconds(first or update, device)
    for _ in range(WARM_UP - 1):
        update()
    times = [seconds(update, device) for _ in range(number)]
    median, memory = statistics.median(times), peak_memory(device)
    limit, flops = matmul_speed(device, torch.bfloat16 if mixed_precision else torch.float32), count_flops()
    return {
        "s": median, "s_min": min(times), "s_first": s_first, "calls": count_calls(update) if count else None,
        "GFLOP": flops / 1e9, "GFLOP/s": flops / 1e9 / median, "limit GFLOP/s": limit / 1e9,
        "share": flops / median / limit, "memory": memory,
    }  # fmt: skip


def interface_of(image_size: int) -> Interface:
    """Return an interface with images and privileged state."""
    return Interface(image_size=image_size, privileged_dim=PRIVILEGED_DIM)


def filled_replay(batch: tuple[int, int], device: str, image_size: int = 64, streams: int = 8) -> Any:
    """Return a replay buffer of random records that samples batches [B, T] on a device."""
    replay = make_replay(
        streams * batch[1] * 2, streams, *batch, device, observation_keys=["pixels", ("privileged", "vector")]
    )
    replay.extend(random_rollout(streams, batch[1] * 2, image_size))
    return replay


def random_rollout(streams: int, steps: int, image_size: int = 64) -> TensorDict:
    """Return random records as a collector would yield them, [streams, steps]; episodes take about 50 steps."""
    generator = torch.Generator().manual_seed(0)
    shape = (streams, steps)

    def normal(*sizes: int) -> Tensor:
        return torch.randn(*shape, *sizes, generator=generator)

    def image() -> Tensor:
        return torch.randint(0, 256, (*shape, image_size, image_size, 3), dtype=torch.uint8, generator=generator)

    done = torch.rand(*shape, 1, generator=generator) < 0.02
    arrived = TensorDict(
        {"pixels": image(), ("privileged", "vector"): normal(PRIVILEGED_DIM), "reward": normal(1),
         "reward_base": normal(1), "body_rate_norm": normal(1), "terminated": done,
         "truncated": torch.zeros_like(done)}, shape,
    )  # fmt: skip
    root = {"pixels": image(), ("privileged", "vector"): normal(PRIVILEGED_DIM), "action": normal(4).clamp(-1, 1)}
    return TensorDict({**root, "is_init": done.roll(1, 1), "next": arrived}, shape)


def peak_memory(device: str) -> float:
    """Return the peak memory in GiB: of the device, or of this process on a CPU."""
    if device.startswith("cuda"):
        return torch.cuda.max_memory_allocated() / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def parameters(trained: Any) -> int:
    """Count the parameters in the optimiser of a learner, or of TorchRL's stepper."""
    return sum(parameter.numel() for group in trained.optimizer.param_groups for parameter in group["params"])


def count_calls(update: Callable[[], Any]) -> int:
    """Count the ATen calls of an update."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        update()
    return sum(event.count for event in profiler.key_averages() if event.key.startswith("aten::"))


def count_launches(size: str, loss: str, actor: str, batch: tuple[int, int], horizon: int, few: bool) -> dict[str, Any]:
    """Count the kernels of an update on a CUDA device; return one record."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests.launches import launches

    full = get_size(size)
    narrow = replace(full, **NARROW, cnn_depth=full.blocks, name=size)  # divisible by the blocks
    config = LearnerConfig(mixed_precision=True, few_kernels=few, imagination_horizon=horizon)
    learner = make_learner(narrow, loss, actor, config)
    data = filled_replay((2, batch[1]), "cpu").sample()
    before = (torch.zeros(*data.batch_size, width) for width in (narrow.belief, narrow.state))
    data["context"] = learner.latent_format.pack(*before)  # windows begin with stored latents
    with patch.object(layers.F, "rms_norm", lambda x, shape, weight, eps: fused_rms_norm(x, weight, eps)):
        learner.update(data)  # creates the optimiser's moments
        learner.update(data)
        seen = launches(lambda: learner.update(data))
    return {
        "benchmark": "learner_launches", "size": size, "loss": loss, "actor": actor,
        "batch": "x".join(map(str, batch)), "horizon": horizon, "few_kernels": few,
        "launches": seen.count, "casts": seen.kernels["_to_copy"], "waits": len(seen.waits),
    }  # fmt: skip


@torch.library.custom_op("dreamer_racing::fused_rms_norm", mutates_args=())
def fused_rms_norm(inputs: Tensor, weight: Tensor, eps: float) -> Tensor:
    """Compute an RMS norm as one operation, so that it counts as one kernel, as on CUDA."""
    normed = inputs.float() * torch.rsqrt(inputs.float().square().mean(-1, keepdim=True) + eps)
    return (normed * weight.float()).to(inputs.dtype)


@torch.library.custom_op("dreamer_racing::fused_rms_norm_backward", mutates_args=())
def fused_rms_norm_backward(gradient: Tensor, inputs: Tensor, weight: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Compute the gradients of an RMS norm as one operation."""
    values, passed = inputs.float(), gradient.float()
    scale = torch.rsqrt(values.square().mean(-1, keepdim=True) + eps)
    normed, weighted = values * scale, passed * weight.float()
    of_inputs = scale * (weighted - normed * (weighted * normed).mean(-1, keepdim=True))
    return of_inputs.to(inputs.dtype), (passed * normed).flatten(0, -2).sum(0).to(weight.dtype)


def _keep_for_backward(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:2])
    ctx.eps = inputs[2]


fused_rms_norm.register_autograd(
    lambda ctx, gradient: (*fused_rms_norm_backward(gradient, *ctx.saved_tensors, ctx.eps), None),
    setup_context=_keep_for_backward,
)


def dry_update(
    size: str, loss: str, actor: str, batch: tuple[int, int], config: LearnerConfig, image_size: int = 64
) -> tuple[int, int, int]:
    """Trace losses and gradients on the meta device; return FLOPs, number of parameters, bytes saved for backward."""
    with torch.device("meta"):
        learner = make_learner(size, loss, actor, config, image_size, "meta")
        records: dict[Any, Tensor] = {
            "pixels": torch.empty(*batch, image_size, image_size, 3, dtype=torch.uint8),
            ("privileged", "vector"): torch.empty(*batch, PRIVILEGED_DIM),
            "previous_action": torch.empty(*batch, 4),
            "reward": torch.empty(*batch, 1),
        }
        for key in ("is_init", "terminated", "truncated"):
            records[key] = torch.empty(*batch, 1, dtype=torch.bool)
        data = TensorDict(records, batch)
        saved: dict[int, int] = {}

        def keep(tensor: Tensor) -> Tensor:
            if not isinstance(tensor, torch.nn.Parameter):
                storage = tensor.untyped_storage()
                saved[storage._cdata] = storage.nbytes()
                kept.append(storage)
            return tensor

        kept: list[Any] = []  # keeps storages alive, so that addresses stay unique
        with (
            FlopCounterMode(display=False) as counter,
            torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor),
        ):
            metrics = learner.compute_losses(data)
            torch.stack([value for key, value in metrics.items() if key.startswith("loss_")]).sum().backward()
    return counter.get_total_flops(), parameters(learner), sum(saved.values())


def write_size_table(path: Path, batch: tuple[int, int] = (16, 64), horizon: int = 16) -> None:
    """Write a Markdown table of parameters, FLOPs and memory of every size."""
    lines = [
        "# Sizes of the agent",
        "",
        "Made by `python benchmarks/learner.py --table docs/sizes.md`; nothing here is timed.",
        f"One update of B {batch[0]}, T {batch[1]}, H {horizon}, losses `reconstruction` and `reinforce`, float32:",
        "FLOPs of matrix products and convolutions, forward and backward, counted by torch. Memory is an estimate:",
        "weights, gradients and two moments (16 bytes a parameter) plus the tensors kept for the backward pass.",
        "",
        "| size | recurrence | belief | latents | units | CNN depth | parameters | GFLOP | state, GiB | kept, GiB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, size in SIZES.items():
        config = LearnerConfig(imagination_horizon=horizon)
        flops, count, kept = dry_update(name, "reconstruction", "reinforce", batch, config)
        lines.append(
            f"| `{name}` | {size.recurrence} | {size.belief} | {size.latents}×{size.classes} | {size.units} | "
            f"{size.cnn_depth} | {count / 1e6:.2f} M | {flops / 1e9:,.0f} | {count * 16 / 2**30:.2f} | "
            f"{kept / 2**30:.2f} |"
        )
        print(lines[-1], flush=True)
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
