"""What a learner learns from, on a run's own replay: cold windows, noise of the actor's gradient, drift of the policy.

    python benchmarks/learning_signal.py runs/circle --json learning_signal.json

* Windows: the newest records of the streams that are trained on, in windows of T = 16 behind which 64 more records lie.
  By record of the window, `error` of the decoded state (mean square, symlogged), and how far the mean `action` and the
  `value` are from those of `warm`, which has seen the 64 records: `stored` begins with the context in the replay,
  `cold` from nothing. Only windows of a single flight are counted: in another, a record would soon be as warm as any.
* Gradient: of the actor's loss at the present actor, from N starts of imagination, `cosine` between two drawn
  independently and `signal` power over noise power; N as one update has it, and as an improvement of `loss.actor=ppo`
  has it. An actor that learns from what it flies flies on here, as the run would: N (`starts`) steps, as a minibatch
  and as an improvement has them, 10 s of flight at 25 Hz between them.
* Drift: two copies of the learner after `drift_updates` updates on batches of their own, none of which wait for the
  model, or, from what was flown, after one improvement, which comes once in as many updates; root mean square over
  states and dimensions of the mean actions' difference (`apart`) and of the way each went (`moved`), beside the
  policy's mean deviation `std`. Mean over `--pairs`, and the least and most `apart`.

The trained weights are measured, not the averaged ones. The checkpoint must hold a replay, so no best/.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
import torch.nn.functional as F
from measuring import print_table, write_json
from tensordict import TensorDictBase
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.arena import make_env
from composing.building import make_collector, make_curriculum, make_run_replay
from composing.learners import clock_times
from composing.restoring import restore_learner
from composing.saved import trained_config
from composing.schema import DreamerConfig

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.experience.collector_state import CollectorState
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import FlownPPOActorLoss, PPOActorLoss, imagine
from dreamer_racing.losses.clipped_actor import Minibatch, clipped_objective, normalised
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.stored_latents import CONTEXT
from dreamer_racing.modules.world_model import join_features
from dreamer_racing.training.checkpoint import load_components
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint
from dreamer_racing.training.pass_share import PassShare

BEHIND, LENGTH, RECORDS = 64, 16, (0, 1, 3, 8, 12)
WINDOWS, RECENT = 128, 20_000  # windows compared, and the newest records they are drawn from
GRADIENTS = 8
BETWEEN = 256  # steps of each world between flights that are compared
COLUMNS = {
    "windows": [
        "record", "windows", "error_warm", "error_stored", "error_cold", "action_stored", "action_cold",
        "value_stored", "value_cold",
    ],
    "gradient": ["starts", "cosine", "signal"],
    "drift": ["drift_updates", "std", "apart", "least", "most", "moved"],
}  # fmt: skip


def main() -> None:
    """Measure every checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--updates", type=int, default=32, help="of the drifting copies")
    parser.add_argument("--pairs", type=int, default=3, help="of drifting copies")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = []
    for path in arguments.checkpoints:
        found = list(measure(latest_checkpoint(path), arguments.updates, arguments.pairs))
        for part, columns in COLUMNS.items():
            print_table([record for record in found if record["measured"] == part], columns)
            print()
        records += found
    write_json(records, arguments.json)


def measure(checkpoint: Path, updates: int, pairs: int) -> Iterator[dict[str, Any]]:
    """Yield the records of one checkpoint.

    Raises:
        ValueError: it is of another algorithm.
    """
    config = trained_config(RunDirectory.of(checkpoint).path)
    if not isinstance(config, DreamerConfig):
        raise ValueError(f"{checkpoint} was trained by {config.algorithm}, which has no world model.")
    config.device, config.replay.device = "cpu", "auto"  # wherever it was trained
    learner, counters = restore(config, checkpoint)
    where = {"benchmark": "learning_signal", "track": config.track, "actor": config.loss.actor, **counters}
    long = restore_replay(config, checkpoint, learner, WINDOWS, BEHIND + LENGTH, share=1.0, records=RECENT)
    torch.manual_seed(0)
    for record in compare_windows(learner, long.sample()):
        yield {**where, "measured": "windows", **record}
    del long
    if isinstance(learner.actor_loss, FlownPPOActorLoss):
        for record in of_what_is_flown(config, checkpoint, learner, learner.actor_loss, pairs):
            yield {**where, **record}
        return
    replay = restore_replay(config, checkpoint, learner, config.model.batch_size, config.model.batch_length)
    starts = config.model.imagination_starts or config.model.batch_size * config.model.batch_length
    for number in (starts, starts * config.loss.ppo.updates):
        yield {**where, "measured": "gradient", **gradient_noise(learner, replay, number)}
    yield {**where, "measured": "drift", **drift(config, checkpoint, replay, updates, pairs)}


def restore(config: DreamerConfig, checkpoint: Path) -> tuple[DreamerLearner, dict[str, int]]:
    """Bring back the trained weights."""
    learner, counters = restore_learner(config, checkpoint, torch.device("cpu"), "trained")
    return cast(DreamerLearner, learner), counters


def restore_replay(
    config: DreamerConfig,
    checkpoint: Path,
    learner: DreamerLearner,
    windows: int,
    length: int,
    share: float | None = None,
    records: int | None = None,
) -> StreamReplay:
    """Bring back the replay, to be sampled in other windows or as the run does."""
    env = make_env(replace(config, env=replace(config.env, start_on_line=0.0)), num_envs=1)  # for what it shows
    settings, curriculum = config.replay, make_curriculum(config)
    replay = make_run_replay(
        config,
        env,
        curriculum,
        windows,
        length,
        latents=learner.latent_format if settings.context else None,
        recent_share=settings.recent_share if share is None else share,
        recent_records=settings.recent_records if records is None else records,
        held_out=settings.held_out,
    )
    env.close()
    load_components(checkpoint, {"replay": replay} | ({"curriculum": curriculum} if curriculum else {}))
    return replay


@torch.no_grad()
def compare_windows(learner: DreamerLearner, batch: TensorDictBase) -> Iterator[dict[str, float]]:
    """Yield by record what its place in a window costs; batch ``[B, BEHIND + LENGTH]``."""
    model, actor, critic = learner.agent.world_model, learner.agent.actor, learner.agent.critic
    decoder = getattr(learner.losses["world_model"], "privileged_decoder", None)
    embedded, action, begins = model.encoder(batch), batch["previous_action"], batch["is_init"].squeeze(-1)
    last = slice(BEHIND, None)
    inputs = (embedded[:, last], action[:, last], begins[:, last])
    posteriors = {"warm": model.rssm.observe(embedded, action, begins), "cold": model.rssm.observe(*inputs)}
    if CONTEXT in batch:
        stored = model.rssm.latent_format.unpack(batch[CONTEXT][:, BEHIND])
        posteriors["stored"] = model.rssm.observe(*inputs, initial=stored)
    judged = {}
    for name, posterior in posteriors.items():
        features = join_features(posterior.belief, posterior.state)[:, -LENGTH:]
        judged[name] = {"action": actor(features).mean, "value": critic.value(features)}
        if decoder is not None:
            truth = symlog(batch["privileged", "vector"][:, last])
            judged[name]["error"] = (decoder.mlp(features) - truth).square()
    chosen = ~begins[:, last][:, : max(RECORDS) + 1].any(1)  # (B,)
    for record in RECORDS:
        result: dict[str, float] = {"record": record, "windows": int(chosen.sum())}
        for name, values in judged.items():
            if "error" in values:
                result[f"error_{name}"] = values["error"][chosen, record].mean().item()
            if name != "warm":
                for quantity in ("action", "value"):
                    difference = values[quantity] - judged["warm"][quantity]
                    result[f"{quantity}_{name}"] = difference[chosen, record].abs().mean().item()
        yield result


def starts_of(learner: DreamerLearner, replay: StreamReplay, number: int) -> tuple[Tensor, Tensor, Tensor]:
    """Draw starts of imagination as updates do: belief, state, terminated ``(number, ...)``."""
    parts: list[TensorDictBase] = []
    while sum(map(len, parts)) < number:
        batch = replay.sample()
        with torch.no_grad():
            context = learner.losses["world_model"](batch).pop("replay_context")
        parts.append(learner.starts(context, batch))
    starts = cast(TensorDictBase, torch.cat(cast(Any, parts)))[:number]
    return starts["belief"], starts["state"], starts["terminated"]


def gradient_noise(learner: DreamerLearner, replay: StreamReplay, number: int) -> dict[str, float]:
    """Compare gradients from independent starts."""
    loss, actor = learner.actor_loss.eval(), learner.agent.actor
    parameters = list(actor.parameters())
    gradients = []
    for _ in range(GRADIENTS):
        belief, state, terminated = starts_of(learner, replay, number)
        with torch.no_grad():
            features, action = imagine(learner.agent.world_model.rssm, actor, belief, state, loss.horizon)
            judged = loss._judge(features, terminated)
        gain = actor(features[:-1]).log_prob(action) * (judged.lambda_return - judged.value)
        objective = -(judged.weight * gain).mean()
        gradients.append(torch.cat([part.flatten() for part in torch.autograd.grad(objective, parameters)]))
    return {"starts": number, **noise_of(torch.stack(gradients))}


def noise_of(rows: Tensor) -> dict[str, float]:
    """Compare independent gradients ``(G, P)``."""
    mean, count = rows.mean(0), len(rows)
    noise = (rows - mean).square().sum() / (count - 1)
    signal = mean.square().sum() - noise / count
    unit = F.normalize(rows, dim=1)
    cosine = ((unit @ unit.T).sum() - count) / (count * (count - 1))
    return {"cosine": cosine.item(), "signal": (signal / noise).item()}


def of_what_is_flown(
    config: DreamerConfig, checkpoint: Path, learner: DreamerLearner, loss: FlownPPOActorLoss, pairs: int
) -> Iterator[dict[str, Any]]:
    """Fly on as the resumed run would, and yield the records of gradient and drift."""
    flights = fly(config, checkpoint, learner, loss, max(GRADIENTS, 2 * pairs) + 1)
    improvements = [kept_as_minibatch(loss, flight) for flight in flights]
    features = improvements.pop().features  # that no copy learns from
    size = min(loss.ppo.minibatch, len(features))
    order = torch.randperm(len(features))[:size]
    parts = [Minibatch(*(value[order] for value in each)) for each in improvements]
    for records in (parts, improvements):
        rows = torch.stack([gradient_of(loss, each) for each in records[:GRADIENTS]])
        yield {"measured": "gradient", "starts": len(records[0].features), **noise_of(rows)}
    means = []
    for seed, flight in enumerate(flights[: 2 * pairs]):
        copy, _ = restore(config, checkpoint)
        copy.actor_loss.load_state_dict(flight, strict=False)
        torch.manual_seed(seed)
        copy.actor_loss.improve(0)
        with torch.no_grad():
            means.append(copy.agent.actor(features).mean)
    between = len(features) * config.model.replay_ratio / (config.model.batch_size * config.model.batch_length)
    yield {"measured": "drift", "drift_updates": round(between), **apart(learner, features, means, pairs)}


def fly(
    config: DreamerConfig, checkpoint: Path, learner: DreamerLearner, loss: FlownPPOActorLoss, number: int
) -> list[dict[str, Tensor]]:
    """Fly a few times as much as an improvement takes, with some time between; return what the loss has kept."""
    env = cast(DroneRacingEnv, make_env(config))
    collector = make_collector(config, env, learner.policy())
    passes = PassShare(env.track.num_gates)
    parts = {"env": env, "collector": CollectorState(collector), "passes": passes}
    env_steps = load_components(checkpoint, parts)["env_steps"]
    times = clock_times(config, env_steps, passes)
    env.worlds.start_on_line = config.schedule.start_on_line.at(config.env.start_on_line, times)
    rollouts, flights = iter(collector), []
    for _ in range(number):
        for _ in range(BETWEEN // config.rollout_steps):
            next(rollouts)
        loss._count(0)
        while not loss._flown or loss._flown < len(loss.reward):
            loss.watch(next(rollouts))
        kept = loss.named_buffers(recurse=False)
        flights.append({name: value.clone() for name, value in kept if name in (*loss.kept, "flown")})
    collector.shutdown()
    return flights


def kept_as_minibatch(loss: FlownPPOActorLoss, flight: dict[str, Tensor]) -> Minibatch:
    """All that was kept, as an improvement takes it."""
    loss.load_state_dict(flight, strict=False)
    value = loss._value()
    advantage = loss._return(value) - value
    weight = torch.ones_like(advantage)
    advantage = normalised(advantage, weight).clamp(-loss.ppo.advantage_clip, loss.ppo.advantage_clip)
    steps = (loss.features, loss.action, loss.old, advantage, weight)
    return Minibatch(*(part.flatten(0, 1).clone() for part in steps))


def gradient_of(loss: FlownPPOActorLoss, records: Minibatch) -> Tensor:
    """Of the clipped objective without its entropy, at the actor that flew, ``(P,)``."""
    policy = loss.actor(records.features)
    objective, _ = clipped_objective(policy, records, loss.ppo.clip_epsilon, 0.0, loss.log_prob)
    gradients = torch.autograd.grad(objective, list(loss.actor.parameters()))
    return torch.cat([part.flatten() for part in gradients])


def drift(config: DreamerConfig, checkpoint: Path, replay: StreamReplay, updates: int, pairs: int) -> dict[str, float]:
    """Train pairs of copies on batches of their own, and see how far apart they are."""
    base, _ = restore(config, checkpoint)
    belief, state, _ = starts_of(base, replay, 512)
    features = join_features(belief, state)
    means = []
    for seed in range(2 * pairs):
        copy, _ = restore(config, checkpoint)
        if isinstance(loss := copy.losses["actor"], PPOActorLoss):
            loss.kept.zero_()  # rollouts that the copies would have in common
        torch.manual_seed(seed)
        for _ in range(updates):
            copy.update(replay.sample())
        with torch.no_grad():
            means.append(copy.agent.actor(features).mean)
    return {"drift_updates": updates, **apart(base, features, means, pairs)}


@torch.no_grad()
def apart(base: DreamerLearner, features: Tensor, means: list[Tensor], pairs: int) -> dict[str, float]:
    """How far the mean actions ``(N, A)`` of pairs of copies are apart, and from those of the learner they were."""
    policy = base.agent.actor(features)
    after = torch.stack(means).unflatten(0, (pairs, 2))  # (pairs, 2, N, A)
    distance = (after[:, 0] - after[:, 1]).square().mean((1, 2)).sqrt()
    return {
        "std": policy.std.mean().item(),
        "apart": distance.mean().item(),
        "least": distance.min().item(),
        "most": distance.max().item(),
        "moved": (after - policy.mean).square().mean().sqrt().item(),
    }


if __name__ == "__main__":
    main()
