"""How fast a fresh world model learns to see, on the replay of a run: what can be told of the state, by updates.

    OMP_NUM_THREADS=1 python benchmarks/seeing.py runs/kidney --variant "" "model.learning_rate=2e-3" size.cnn_depth=32
    OMP_NUM_THREADS=1 python benchmarks/seeing.py runs/kidney --updates 600 --variant loss.world_model=privileged \
        loss.world_model=reconstruction "loss.world_model=reconstruction loss.image_scale=0.003"
    OMP_NUM_THREADS=1 python benchmarks/seeing.py runs/kidney --as-trained
    OMP_NUM_THREADS=1 python benchmarks/seeing.py runs/circle runs/circle_from_images_alone --flown

A variant is a list of overrides of the run's settings, or `size.<field>` of the networks' size. The loss of the world
model alone is trained, on windows as the run draws them, but without stored latents; no actor is there.
`probe` is the error of a small network that learns beside it to tell the state from the latents and teaches them
nothing, so that losses can be compared; `error` that of the loss's own decoder, if it has one; both mean squares of
symlogs on windows that the run never trains on, the same ones for all variants. With `--as-trained` the model is the
run's own, which stands still and goes on from the latents stored, and the probe alone learns.
With `--flown` it is probed in what the agent flies now, sampling, in 64 worlds of which half begin on a line: from the
latents with which it acts, 52 worlds for the probe and 12 to measure; so any run can be compared, whatever its replay.
`share` is `probe` by their variance, `trained` the error of the last batch, `seconds` the process's time in updates.
A probe that learns beside the model is late where the state is told in a tangled way: so in each last row the model
stands still, the probe learns on for 2,000 updates, and `linear` is the share that the best linear map does not tell.
The checkpoint must hold a replay, so no best/, and the run must have been given the state: `loss=privileged` or
`informed`, or `loss.actor=asymmetric_ppo`; but for `--flown`.
"""

import argparse
import gc
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from learning_signal import restore, restore_replay
from measuring import print_table, write_json
from omegaconf import OmegaConf
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.arena import make_env
from composing.building import make_collector
from composing.learners import size_of
from composing.saved import trained_config
from composing.schema import DreamerConfig

from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.learners.dreamer_optimizer import make_optimizer
from dreamer_racing.losses import ActorLoss, WorldModelLoss, find_loss, make_losses
from dreamer_racing.modules import Agent, ModelSize, join_features, symlog
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.interface import PRIVILEGED, Interface
from dreamer_racing.modules.layers import autocast
from dreamer_racing.modules.stored_latents import CONTEXT
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

HELD_OUT, LENGTH, RECENT = 128, 32, 4_000  # windows measured, their records, and from how many newest of each world
WORLDS, MEASURED, STEPS, MINIBATCH = 64, 12, 704, 512  # with --flown: worlds, those held out, steps, records an update
SETTLE, SETTLE_BATCHES, RIDGE = 2_000, 200, 1e-2  # updates of the probe on a model that stands still, on these batches
COLUMNS = ["variant", "updates", "seconds", "probe", "share", "linear", "error", "image_error", "reward_error", "kl"]


def main() -> None:
    """Measure every variant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--variant", nargs="+", default=[""], help="overrides of a fresh model, each in quotes")
    parser.add_argument("--updates", type=int, default=600, help="of the model, default 600; of the probe with --flown")
    parser.add_argument("--every", type=int, default=150, help="updates between two measurements")
    own = parser.add_mutually_exclusive_group()
    own.add_argument("--as-trained", action="store_true", help="probe the run's own model instead of fresh ones")
    own.add_argument("--flown", action="store_true", help="the same, in what its agent flies now")
    parser.add_argument("--json", help="file that all rows are written to")
    arguments = parser.parse_args()
    if (arguments.as_trained or arguments.flown) and arguments.variant != [""]:
        parser.error("--as-trained and --flown are of the run as it is: leave --variant out")
    records = []
    for path in arguments.checkpoints:
        checkpoint = latest_checkpoint(path)
        for variant in arguments.variant:
            updates, every = arguments.updates, arguments.every
            found = list(
                probe_flights(checkpoint, updates, every)
                if arguments.flown
                else measure(checkpoint, variant, updates, every, arguments.as_trained)
            )
            print_table(found, COLUMNS)
            records += found
            write_json(records, arguments.json)  # of all so far: a later variant may not fit
            gc.collect()  # replay and learner, gigabytes, are in cycles


def measure(checkpoint: Path, variant: str, updates: int, every: int, as_trained: bool) -> Iterator[dict[str, Any]]:
    """Yield a record for each measurement of a variant."""
    trained = config_of(checkpoint)
    readers = find_loss(WorldModelLoss, trained.loss.world_model), find_loss(ActorLoss, trained.loss.actor)
    if not any(reader.reads_privileged for reader in readers):
        chosen = f"loss.world_model={trained.loss.world_model} loss.actor={trained.loss.actor}"
        raise SystemExit(f"{checkpoint}: neither of {chosen} reads the state, so its replay has none: use --flown.")
    learner, counters = restore(trained, checkpoint)
    config, size = varied(trained, variant)
    replay = restore_replay(config, checkpoint, learner, config.model.batch_size, config.model.batch_length)
    test = replay.held_out(HELD_OUT, LENGTH, RECENT)  # the same windows for every variant
    if test is None:
        raise SystemExit(f"{checkpoint}: the run holds out no worlds (replay.held_out=0): use --flown.")
    if as_trained:
        loss, optimizer = learner.losses["world_model"].requires_grad_(False), None
    else:
        test.pop(CONTEXT, None)  # the latents of the model that was trained mean nothing to a fresh one
        loss, optimizer = fresh(config, size, learner.agent.interface)
    torch.manual_seed(0)
    probe = Probe(size.features, test[PRIVILEGED].shape[-1])
    variance = symlog(test[PRIVILEGED]).var((0, 1)).mean()
    name = "as trained" if as_trained else variant
    context, seconds = autocast(torch.device("cpu"), bool(config.model.mixed_precision)), 0.0
    for number in range(1, updates + 1):
        batch = replay.sample()
        if not as_trained:
            batch.pop(CONTEXT, None)
        begun = time.process_time()
        with context:
            metrics = loss(batch)
        if optimizer is not None:
            torch.stack([value for name, value in metrics.items() if name.startswith("loss_")]).sum().backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        seconds += time.process_time() - begun
        probe.learn(latents_of(metrics), batch[PRIVILEGED])
        if number % every == 0:
            with torch.no_grad(), context:
                seen = loss(test)
            probed = probe.error(latents_of(seen), test[PRIVILEGED]).item()
            yield {
                "benchmark": "seeing", "track": config.track, "env_steps": counters["env_steps"],
                "trained_updates": counters["updates"], "variant": name,
                "updates": number, "seconds": seconds, "probe": probed, "share": probed / variance.item(),
                "kl": seen["kl"].item(), **errors(seen), "trained": errors(metrics).get("error"),
            }  # fmt: skip
    with torch.no_grad(), context:
        settled = standing_still(probe, loss, replay, test, keeps_context=as_trained)
    yield {
        "benchmark": "seeing", "track": config.track, "env_steps": counters["env_steps"],
        "trained_updates": counters["updates"], "variant": f"{name}, standing still", "updates": updates, **settled,
    }  # fmt: skip


def standing_still(
    probe: "Probe", loss: LossModule, replay: StreamReplay, test: TensorDictBase, keeps_context: bool
) -> dict[str, float]:
    """Let the model stand still and the probe learn on; return what it and a linear map do not tell of other windows.

    Args:
        probe: To train.
        loss: Of the model.
        replay: To draw windows from.
        test: Windows held out.
        keeps_context: Whether windows begin with the latents stored.
    """
    batches = []
    for _ in range(SETTLE_BATCHES):
        batch = replay.sample()
        if not keeps_context:
            batch.pop(CONTEXT, None)
        batches.append((latents_of(loss(batch)).flatten(0, 1), batch[PRIVILEGED].flatten(0, 1)))
    learned = tuple(torch.cat(parts) for parts in zip(*batches, strict=True))
    measured = latents_of(loss(test)).flatten(0, 1), test[PRIVILEGED].flatten(0, 1)
    with torch.enable_grad(), torch.autocast("cpu", enabled=False):
        return settle(probe, learned, measured, SETTLE) | {"linear": linear_share(learned, measured)}


Shown = tuple[Tensor, ...]
"""Latents `(M, F)` and the state at them `(M, P)`."""


def settle(probe: "Probe", learned: Shown, measured: Shown, updates: int) -> dict[str, float]:
    """Let the probe learn of latents that stand still; return its error on others, and that by their variance."""
    for _ in range(updates):
        drawn = torch.randint(len(learned[0]), (MINIBATCH,))
        probe.learn(*(part[drawn] for part in learned))
    with torch.no_grad():
        error = probe.error(*measured).item()
    return {"probe": error, "share": error / symlog(measured[1]).var(0).mean().item()}


@torch.no_grad()
def linear_share(learned: Shown, measured: Shown) -> float:
    """Return the share of the variance of the state's symlogs that the best linear map of the latents does not tell."""
    # In float64: the probabilities of a latent sum to 1, as the constant does, so that the system is singular.
    latents, others = (F.pad(part[0].double(), (0, 1), value=1.0) for part in (learned, measured))
    state, told = (symlog(part[1]).double() for part in (learned, measured))
    normal = latents.T @ latents + RIDGE * torch.eye(latents.shape[-1], dtype=torch.float64)
    error = (others @ torch.linalg.solve(normal, latents.T @ state) - told).square().mean()
    return (error / told.var(0).mean()).item()


def probe_flights(checkpoint: Path, updates: int, every: int) -> Iterator[dict[str, Any]]:
    """Yield a record for each measurement of the latents with which a run's agent flies now."""
    config = config_of(checkpoint)
    learner, counters = restore(config, checkpoint)
    features, state = fly(config, learner)
    learned = features[MEASURED:].flatten(0, 1), state[MEASURED:].flatten(0, 1)
    measured = features[:MEASURED].flatten(0, 1), state[:MEASURED].flatten(0, 1)
    torch.manual_seed(0)
    probe, linear = Probe(features.shape[-1], state.shape[-1]), linear_share(learned, measured)
    for number in range(every, updates + 1, every):
        yield {
            "benchmark": "seeing", "track": config.track, "run": RunDirectory.of(checkpoint).path.name,
            "env_steps": counters["env_steps"], "trained_updates": counters["updates"], "variant": "as it flies",
            "updates": number, **settle(probe, learned, measured, every), "linear": linear,
        }  # fmt: skip


@torch.no_grad()
def fly(config: DreamerConfig, learner: DreamerLearner) -> tuple[Tensor, Tensor]:
    """Let the agent fly, and return its latents `(WORLDS, STEPS, F)` and the state `(WORLDS, STEPS, P)` that it saw."""
    config = replace(config, env=replace(config.env, num_envs=WORLDS, start_on_line=0.5, start_at_gate=0.0))
    shown = replace(config.loss, actor="asymmetric_ppo")  # that actor's critic reads the state, so the worlds tell it
    env = make_env(replace(config, loss=shown))
    collector = make_collector(config, env, learner.policy())
    rollouts = []
    for rollout in collector:
        latents = join_features(rollout["next", "belief"], rollout["next", "state"]).float()
        rollouts.append((latents, rollout[PRIVILEGED].clone()))
        if config.rollout_steps * len(rollouts) >= STEPS:
            break
    collector.shutdown()
    features, state = (torch.cat(parts, 1) for parts in zip(*rollouts, strict=True))
    return features, state


def config_of(checkpoint: Path) -> DreamerConfig:
    """Return the settings of the run that wrote a checkpoint, for a CPU."""
    trained = trained_config(RunDirectory.of(checkpoint).path)
    assert isinstance(trained, DreamerConfig), "a run of recipes/dreamer_v3.py"
    trained.device, trained.replay.device = "cpu", "auto"
    return trained


def fresh(config: DreamerConfig, size: ModelSize, interface: Interface) -> tuple[LossModule, torch.optim.Optimizer]:
    """Make a world-model loss of initial weights, and what trains it."""
    torch.manual_seed(0)
    decodes = find_loss(WorldModelLoss, config.loss.world_model).decodes
    agent = Agent(size, interface, decodes, config.loss.min_std, config.loss.max_std)
    losses = make_losses(agent, config.loss)
    return losses["world_model"], make_optimizer(agent, losses, config.model)


def errors(metrics: TensorDictBase) -> dict[str, float]:
    """Return what the loss's own decoders say, by column."""
    names = {"privileged_error": "error", "image_error": "image_error", "reward_error": "reward_error"}
    return {column: error.item() for name, column in names.items() if (error := metrics.get(name, None)) is not None}


class Probe:
    """A decoder of its own from latents to the state; F features, P privileged numbers."""

    def __init__(self, features: int, privileged: int) -> None:
        self.decoder = VectorDecoder(features, privileged, layers=2, units=256)
        self.optimizer = torch.optim.Adam(self.decoder.parameters(), 1e-3)

    def error(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the mean squared error of symlogs on latents `(..., F)` and the state `(..., P)`, a scalar."""
        return self.decoder.squared_error(features, state) / state.shape[-1]

    def learn(self, features: Tensor, state: Tensor) -> None:
        """Make one gradient step."""
        self.optimizer.zero_grad()
        self.error(features, state).backward()
        self.optimizer.step()


def latents_of(metrics: TensorDictBase) -> Tensor:
    """Return the latents that a world-model loss has found, `(..., F)`, without gradient."""
    latents = metrics["replay_context"].detach()
    return join_features(latents["belief"], latents["state"]).float()


def varied(config: DreamerConfig, variant: str) -> tuple[DreamerConfig, ModelSize]:
    """Return the settings of a variant, and the size of its networks."""
    overrides = variant.split()
    of_size = [override.removeprefix("size.") for override in overrides if override.startswith("size.")]
    others = [override for override in overrides if not override.startswith("size.")]
    merged = OmegaConf.merge(OmegaConf.structured(config), OmegaConf.from_dotlist(others))
    changed = cast(DreamerConfig, OmegaConf.to_object(merged))
    numbers = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.from_dotlist(of_size)))
    return changed, replace(size_of(changed), **numbers)


if __name__ == "__main__":
    main()
