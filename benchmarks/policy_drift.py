"""How far the world model's learning moves a policy whose actor stands still, on a run's own replay.

    OMP_NUM_THREADS=1 python benchmarks/policy_drift.py runs/kidney --json policy_drift.json

Each record of the replay has the latents that the model had for the one before it when that was last trained on, or
flown. The divergence of the actor's policy at them from its policy at what the model makes of the same record now,
nats: mean and quantiles over records of batches drawn as the run draws them; apart for windows drawn from the newest
records (`replay.recent_share`) and for those drawn from all, which the model has mostly not seen for long. The trained
weights are measured. The checkpoint must hold a replay with context, so no best/.
"""

import argparse
from collections.abc import Iterator
from typing import Any

import torch
from measuring import print_table, write_json
from trained import restore, restore_replay

BATCHES = 12
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.99)
COLUMNS = ["run", "env_steps", "of", "records", "mean", *(f"q{100 * share:.0f}" for share in QUANTILES)]


def main() -> None:
    """Measure every checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = [record for path in arguments.checkpoints for record in measure(path)]
    print_table(records, COLUMNS)
    write_json(records, arguments.json)


@torch.no_grad()
def measure(path: str) -> Iterator[dict[str, Any]]:
    """Yield a record for windows of the newest records and one for those of all.

    Raises:
        SystemExit: The replay keeps no latents.
    """
    trained = restore(path)
    if not trained.config.replay.context:
        raise SystemExit(f"{trained.checkpoint}: its records keep no latents; those of replay.context=true do.")
    learner, replay = trained.learner, restore_replay(trained)
    torch.manual_seed(0)
    moved, recent = [], []
    for _ in range(BATCHES):
        batch = replay.sample()
        seen = learner.losses["world_model"](batch)["replay_context"]
        before, after, same = learner.then_and_now(seen, batch)
        divergence, same = learner.agent.actor(before).divergence(learner.agent.actor(after)), same.squeeze(-1)
        moved.append(divergence.squeeze(-1)[same])
        recent.append(batch["recent"].reshape(len(same), -1)[:, :1].expand_as(same)[same])
    of_all, newest = torch.cat(moved), torch.cat(recent)
    for name, chosen in (("newest", newest), ("all", ~newest)):
        values = of_all[chosen]
        if len(values):
            quantiles = values.quantile(torch.tensor(QUANTILES)).tolist()
            yield {
                "benchmark": "policy_drift", **trained.where, "of": name, "records": len(values),
                "mean": values.mean().item(), **dict(zip(COLUMNS[5:], quantiles, strict=True)),
            }  # fmt: skip


if __name__ == "__main__":
    main()
