"""How fast a fresh world model learns to see, on the replay of a run: its state error by updates and by time.

    OMP_NUM_THREADS=1 python benchmarks/seeing.py runs/kidney --json seeing.json model.learning_rate=1e-3 \
        "model.learning_rate=2e-3 loss.privileged_scale=10"

Each argument behind the run is a variant: overrides of its settings, with `size.<field>` for the networks' own. All
are trained by the loss of the world model alone, on the same windows, those that the run would draw; no actor is there.
`error` is that of the decoded state (mean square of symlogs) on records that the run never trains on. The checkpoint
must hold a replay, so no best/.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from measuring import print_table, write_json
from omegaconf import OmegaConf

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.learners import size_of
from composing.saved import trained_config
from learning_signal import restore, restore_replay

from dreamer_racing.learners.dreamer import make_optimizer
from dreamer_racing.losses import make_losses
from dreamer_racing.modules import Agent
from dreamer_racing.modules.layers import autocast
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

HELD_OUT, LENGTH = 128, 32


def main() -> None:
    """Measure every variant."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="run directory or checkpoint of a dreamer_v3 race")
    parser.add_argument("variants", nargs="*", default=[""])
    parser.add_argument("--updates", type=int, default=1500)
    parser.add_argument("--every", type=int, default=250)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = []
    for variant in arguments.variants:
        found = list(measure(latest_checkpoint(arguments.checkpoint), variant, arguments.updates, arguments.every))
        print_table(found, ["variant", "updates", "seconds", "error", "trained", "kl"])
        records += found
    write_json(records, arguments.json)


def measure(checkpoint: Path, variant: str, updates: int, every: int) -> Iterator[dict[str, Any]]:
    """Yield a record for each measurement of a variant."""
    config = trained_config(RunDirectory.of(checkpoint).path)
    config.device, config.replay.device = "cpu", "auto"
    learner, counters = restore(config, checkpoint)
    overrides = variant.split()
    of_size = [o.removeprefix("size.") for o in overrides if o.startswith("size.")]
    config = OmegaConf.to_object(
        OmegaConf.merge(
            OmegaConf.structured(config), OmegaConf.from_dotlist([o for o in overrides if not o.startswith("size.")])
        )
    )
    size = size_of(config)
    values = OmegaConf.to_container(OmegaConf.from_dotlist(of_size))
    size = dataclasses.replace(size, **{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    model = config.model
    config.replay.context = False
    replay = restore_replay(config, checkpoint, learner, model.batch_size, model.batch_length)
    test = replay.held_out(HELD_OUT, LENGTH, 4_000)
    torch.manual_seed(0)
    agent = Agent(size, learner.agent.interface, False, config.loss.min_std, config.loss.max_std)
    losses = make_losses(agent, config.loss)
    optimizer = make_optimizer(agent, losses, model)
    loss = losses["world_model"]
    decoder = loss.privileged_decoder
    seconds = 0.0
    for number in range(1, updates + 1):
        batch = replay.sample()
        begun = time.process_time()
        with autocast(torch.device("cpu"), bool(model.mixed_precision)):
            metrics = loss(batch)
        metrics.pop("replay_context")
        total = torch.stack([metrics[key] for key in metrics.keys() if key.startswith("loss_")]).sum()
        total.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        seconds += time.process_time() - begun
        if number % every == 0:
            with torch.no_grad(), autocast(torch.device("cpu"), bool(model.mixed_precision)):
                seen = loss(test)
            yield {
                "variant": variant,
                "updates": number,
                "seconds": seconds,
                "error": seen["privileged_error"].item(),
                "trained": metrics["privileged_error"].item(),
                "kl": seen["loss_dynamics"].item(),
            }


if __name__ == "__main__":
    main()
