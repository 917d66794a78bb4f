"""Benchmark of how well the simulator's state can be predicted from the latents of an agent or a new world model.

    OMP_NUM_THREADS=1 python benchmarks/state_estimation.py runs/circle runs/kidney --json state_estimation.json
    OMP_NUM_THREADS=1 python benchmarks/state_estimation.py runs/kidney --variant "" size.cnn_depth=32 \
        model.learning_rate=2e-3 "loss.world_model=reconstruction loss.image_scale=0.003"

By default, the agent flies with sampled actions in 64 worlds, half of which begin on a line. A probe predicts the state
from the latents with which it acts; it trains on 52 worlds and is tested on 12. This works for any run.

With --variant, new world models are trained on the run's replay, without an actor. Each variant is a list of overrides
of the run's settings, or of the networks' size as `size.<field>`. Windows are sampled as in the run, but begin without
stored latents. The probe is tested on held-out windows, the same for all variants. The checkpoint must hold a replay
(`best/` does not), and the run must have recorded the state (`loss=privileged` or `informed`, or an actor whose critic
reads it). `error`, `image_error`, `reward_error` and `kl` are from the model's own loss on held-out windows, `seconds`
is the CPU time of updates.

`probe` is the mean squared error of symlogs of a small network, trained for `SETTLE` updates to predict the state from
fixed latents; `share` is this error over the variance; `linear` is the unexplained share of variance of the best linear
map.
"""

import gc
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any, cast

import torch
import torch.nn.functional as F
from measuring import make_parser, print_table, write_json
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from trained import Trained, WorldModelRunConfig, fly, restore, restore_replay, shared_env_arguments, size_of

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.losses import DreamerV3Losses, Latents, LossConfig, WorldModelLoss
from dreamer_racing.modules import ModelSize, join_features, symlog
from dreamer_racing.modules.autoencoder import VectorDecoder
from dreamer_racing.modules.interface import PRIVILEGED, Interface
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.rssm import CONTEXT

HELD_OUT, LENGTH, RECENT = 128, 32, 4_000  # held-out windows, their length, and newest records per world they are from
WORLDS, MEASURED, STEPS = 64, 12, 704  # of flights: worlds, test worlds among them, steps
SETTLE, BATCHES, MINIBATCH, RIDGE = 2_000, 200, 512, 1e-2  # probe's updates, replay batches, minibatch; ridge penalty
COLUMNS = ["variant", "updates", "seconds", "probe", "share", "linear", "error", "image_error", "reward_error", "kl"]


def main() -> None:
    """Measure every checkpoint, or every variant on it."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--variant", nargs="+", help="overrides of a fresh model, each in quotes")
    parser.add_argument("--updates", type=int, default=600, help="of a fresh model")
    parser.add_argument("--every", type=int, default=150, help="updates between two measurements")
    arguments = parser.parse_args()
    records = []
    for path in arguments.checkpoints:
        trained = restore(path)
        for variant in arguments.variant or [None]:
            torch.manual_seed(0)
            found = (
                [as_flown(trained)]
                if variant is None
                else learning(trained, variant, arguments.updates, arguments.every)
            )
            rows = [{"benchmark": "state_estimation", **trained.where, **record} for record in found]
            print_table(rows, COLUMNS)
            records += rows
            write_json(records, arguments.json)  # in case a later variant runs out of memory
            gc.collect()  # replay and learner take gigabytes and are in reference cycles


Shown = tuple[Tensor, Tensor]
"""Latents `(M, F)` and the state at them `(M, P)`."""


def as_flown(trained: Trained) -> dict[str, Any]:
    """Return how well the state can be predicted from the latents with which a run's agent flies."""
    env = trained.config.env
    worlds = DroneRacingEnv(
        num_envs=WORLDS,
        episode_steps=env.episode_steps,
        start_on_line=0.5,
        miss_radius=env.miss_radius,
        looks=env.looks,
        seed=trained.config.seed,
        **shared_env_arguments(trained.config),
    )
    flight = fly(trained.learner, worlds, STEPS)
    shown = join_features(flight["belief"], flight["state"]).float(), flight["vector"]
    learned, measured = (
        cast(Shown, tuple(part[:, chosen].flatten(0, 1) for part in shown))
        for chosen in (slice(MEASURED, None), slice(MEASURED))
    )
    return {"variant": "as it flies", **told(learned, measured)}


def learning(trained: Trained, variant: str, updates: int, every: int) -> Iterator[dict[str, Any]]:
    """Train a new model on the run's replay; yield a record for each measurement."""
    config, size = varied(trained.config, variant)
    replay = restore_replay(trained, config)
    held_out = replay.held_out(HELD_OUT, LENGTH, RECENT)  # the same windows for every variant
    if held_out is None or PRIVILEGED not in held_out.keys(True):
        missing = "holds out no worlds (replay.held_out=0)" if held_out is None else "has no state in its replay"
        raise SystemExit(f"{trained.checkpoint}: the run {missing}: leave --variant out.")
    loss, optimizer = fresh(config, size, trained.learner.agent.interface)
    context, seconds = autocast(torch.device("cpu"), bool(config.model.mixed_precision)), 0.0

    def observed(batch: TensorDictBase) -> tuple[dict[str, Tensor], Latents]:
        batch.pop(CONTEXT, None)  # stored latents of the trained model are meaningless to a new one
        with context:
            return loss(batch)

    for number in range(1, updates + 1):
        batch = replay.sample()
        begun = time.process_time()
        metrics, _ = observed(batch)
        torch.stack([value for name, value in metrics.items() if name.startswith("loss_")]).sum().backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        seconds += time.process_time() - begun
        if number % every and number != updates:
            continue
        with torch.no_grad():
            (seen, latents), batches = observed(held_out), [replay.sample() for _ in range(BATCHES)]
            parts = [(flat(observed(each)[1]), each[PRIVILEGED].flatten(0, 1)) for each in batches]
        learned = cast(Shown, tuple(torch.cat(part) for part in zip(*parts, strict=True)))
        yield {
            "variant": variant, "updates": number, "seconds": seconds, "kl": seen["kl"].item(), **errors(seen),
            **told(learned, (flat(latents), held_out[PRIVILEGED].flatten(0, 1))),
        }  # fmt: skip


def told(learned: Shown, measured: Shown) -> dict[str, float]:
    """Fit a probe and a linear map on ``learned``; return their errors on ``measured``."""
    probe = Probe(learned[0].shape[-1], learned[1].shape[-1])
    return settle(probe, learned, measured, SETTLE) | {"linear": linear_share(learned, measured)}


class Probe:
    """A separate decoder from latents (F features) to the state (P privileged numbers)."""

    def __init__(self, features: int, privileged: int) -> None:
        self.decoder = VectorDecoder(features, privileged, layers=2, units=256)
        self.optimizer = torch.optim.Adam(self.decoder.parameters(), 1e-3)

    def error(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the mean squared error of symlogs for latents `(..., F)` and states `(..., P)`, a scalar."""
        return self.decoder.squared_error(features, state) / state.shape[-1]

    def learn(self, features: Tensor, state: Tensor) -> None:
        """Make one gradient step."""
        self.optimizer.zero_grad()
        self.error(features, state).backward()
        self.optimizer.step()


def settle(probe: Probe, learned: Shown, measured: Shown, updates: int) -> dict[str, float]:
    """Train the probe on fixed latents; return its error on ``measured``, and the error over the variance there."""
    for _ in range(updates):
        drawn = torch.randint(len(learned[0]), (MINIBATCH,))
        probe.learn(*(part[drawn] for part in learned))
    with torch.no_grad():
        error = probe.error(*measured).item()
    return {"probe": error, "share": error / symlog(measured[1]).var(0).mean().item()}


@torch.no_grad()
def linear_share(learned: Shown, measured: Shown) -> float:
    """Return the share of variance of the state's symlogs that the best linear map of the latents does not explain."""
    # In float64 and with a ridge, because the classes of a latent sum to 1, like the constant: the system is singular.
    latents, others = (F.pad(part[0].double(), (0, 1), value=1.0) for part in (learned, measured))
    state, truth = (symlog(part[1]).double() for part in (learned, measured))
    normal = latents.T @ latents + RIDGE * torch.eye(latents.shape[-1], dtype=torch.float64)
    error = (others @ torch.linalg.solve(normal, latents.T @ state) - truth).square().mean()
    return (error / truth.var(0).mean()).item()


def fresh(
    config: WorldModelRunConfig, size: ModelSize, interface: Interface
) -> tuple[WorldModelLoss, torch.optim.Optimizer]:
    """Make a world-model loss with initial weights, and its optimiser."""
    losses = DreamerV3Losses(**{field.name: getattr(config.loss, field.name) for field in fields(LossConfig)})
    learner = DreamerV3.make(size, interface, losses, config.model, seed=0)
    return learner.world_model_loss, learner.optimizer


def errors(metrics: dict[str, Tensor]) -> dict[str, float]:
    """Return the errors of the loss's own decoders, by column."""
    names = {"privileged_error": "error", "image_error": "image_error", "reward_error": "reward_error"}
    return {column: metrics[name].item() for name, column in names.items() if name in metrics}


def flat(latents: Latents) -> Tensor:
    """Return features `(M, F)` of the latents from a world-model loss, without gradient."""
    return latents.features.detach().float().flatten(0, 1)


def varied(config: WorldModelRunConfig, variant: str) -> tuple[WorldModelRunConfig, ModelSize]:
    """Return the settings of a variant, and the size of its networks."""
    overrides = variant.split()
    of_size = [override.removeprefix("size.") for override in overrides if override.startswith("size.")]
    others = [override for override in overrides if not override.startswith("size.")]
    merged = OmegaConf.merge(OmegaConf.structured(config), OmegaConf.from_dotlist(others))
    changed = cast(WorldModelRunConfig, OmegaConf.to_object(merged))
    numbers = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.from_dotlist(of_size)))
    return changed, replace(size_of(changed), **numbers)


if __name__ == "__main__":
    main()
