"""What a fresh actor learns in a world model that stands still: by imagining in it, or by flying with its latents.

    python benchmarks/frozen_model.py runs/kidney --mode imagined flown --json frozen_model.json

The world model of the checkpoint, its trained weights, stands still. A fresh actor with one deviation for all states
and a fresh critic make PPO's improvements on 16,384 steps each, advantages by λ-returns of 16 imagined or of 256
flown steps, and 64 worlds: the same algorithm on the same features. What differs is whose rewards and whose next
latents they are, and that flown actions are kept as clipped and weighed as such. Imagination begins at the posterior
latents of the newest records of the replay. Every so many improvements the deterministic policy flies 60 noisy starts:
`gates` is their mean, beside `reward`, what a step paid where the actor learned, imagined or flown. The checkpoint
must hold a replay, so no best/.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from learning_signal import restore, restore_replay
from measuring import print_table, write_json
from torch import Tensor, nn

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.arena import make_env, worlds_of
from composing.building import make_collector
from composing.saved import trained_config
from composing.schema import DreamerConfig

from dreamer_racing.evaluation.course import Course
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses.clipped_actor import LogProb, Minibatch, clipped_objective, normalised
from dreamer_racing.losses.imagination import imagine, lambda_return
from dreamer_racing.modules.actor import ActionDistribution, Actor
from dreamer_racing.modules.heads import MLP
from dreamer_racing.modules.world_model import join_features
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

STEPS, HORIZON, WORLDS, EPISODES = 16_384, 16, 64, 60
RECENT, DISCOUNT, LAMBDA, RATE = 20_000, 0.98, 0.95, 5e-4
EPOCHS, MINIBATCHES, CLIP, REWARD_SCALE = 5, 8, 0.2, 0.1
COLUMNS = ["mode", "improvements", "gates", "success", "reward", "kl", "std"]

Experience = dict[str, Tensor]
"""``features`` (T, N, F), ``action`` (T, N, A), ``old`` (T, N, 2·A), ``reward``, ``continuation``, ``done``, ``weight``
(T, N, 1), and ``following`` (N, F): the features after the last step."""


def main() -> None:
    """Measure each mode on one checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="run directory or checkpoint of a dreamer_v3 race")
    parser.add_argument("--mode", nargs="+", choices=("imagined", "flown"), default=["imagined", "flown"])
    parser.add_argument("--improvements", type=int, default=60)
    parser.add_argument("--every", type=int, default=10, help="improvements between two evaluations")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = []
    for mode in arguments.mode:
        found = list(measure(latest_checkpoint(arguments.checkpoint), mode, arguments.improvements, arguments.every))
        print_table(found, COLUMNS)
        records += found
    write_json(records, arguments.json)


def measure(checkpoint: Path, mode: str, improvements: int, every: int) -> Iterator[dict[str, Any]]:
    """Yield a record for each evaluation."""
    config = trained_config(RunDirectory.of(checkpoint).path)
    assert isinstance(config, DreamerConfig), "a run of recipes/dreamer_v3.py"
    config.device, config.env.device, config.replay.device = "cpu", "cpu", "auto"
    learner, counters = restore(config, checkpoint)
    torch.manual_seed(0)
    size, interface = learner.size, learner.agent.interface
    actor = Actor(size.features, interface.action_dim, 2, 256, min_std=0.01, state_std=False)
    critic = MLP(size.features, 1, 2, 256, "rms")
    learner.agent.actor = actor
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=RATE, eps=1e-5)
    course = Course(learner.evaluation_policy(), {**worlds_of(config), "start_noise": 1.0}, EPISODES)
    gather = (imagining if mode == "imagined" else flying)(config, checkpoint, learner)
    log_prob = ActionDistribution.log_prob if mode == "imagined" else ActionDistribution.log_prob_clipped
    for number in range(improvements + 1):
        experience = gather()
        with torch.no_grad():
            old = actor(experience["features"])
        experience["old"] = torch.cat((old.mean, old.std), -1)
        kl = improve(actor, critic, optimizer, experience, log_prob) if number < improvements else math.nan
        if number % every == 0:
            flown = course.evaluate()
            yield {
                "benchmark": "frozen_model", "track": config.track, **counters, "mode": mode,
                "improvements": number + (number < improvements), "gates": flown.gates_per_episode,
                "success": flown.success_rate, "reward": experience["reward"].mean().item(), "kl": kl,
                "std": experience["old"].chunk(2, -1)[1].mean().item(),
            }  # fmt: skip
    course.close()


def imagining(config: DreamerConfig, checkpoint: Path, learner: DreamerLearner) -> Callable[[], Experience]:
    """Return what imagines experience from latents of the newest records."""
    replay = restore_replay(config, checkpoint, learner, 64, HORIZON, share=1.0, records=RECENT)
    model, contexts = learner.agent.world_model, []
    with torch.no_grad():
        for _ in range(2 * RECENT // (64 * HORIZON)):
            batch = replay.sample()
            context = learner.losses["world_model"](batch).pop("replay_context")
            contexts.append((context["belief"], context["state"], batch["terminated"]))
    belief, state, terminated = (
        torch.cat([part.flatten(0, 1) for part in parts]) for parts in zip(*contexts, strict=True)
    )

    @torch.no_grad()
    def gather() -> Experience:
        chosen = torch.randint(len(belief), (STEPS // HORIZON,))
        features, action = imagine(model.rssm, learner.agent.actor, belief[chosen], state[chosen], HORIZON)
        continuation = model.continue_head.probability(features[1:])
        start = 1.0 - terminated[chosen].float().unsqueeze(0)
        return {
            "features": features[:-1],
            "action": action,
            "reward": model.reward_head.mean(features[1:]),
            "continuation": continuation,
            "done": torch.zeros_like(continuation),
            "weight": torch.cat((start, DISCOUNT * continuation[:-1])).cumprod(0),
            "following": features[-1],
        }

    return gather


def flying(config: DreamerConfig, checkpoint: Path, learner: DreamerLearner) -> Callable[[], Experience]:
    """Return what flies experience in the run's worlds."""
    config.env.num_envs, config.rollout_steps = WORLDS, STEPS // WORLDS
    rollouts = iter(make_collector(config, make_env(config), learner.policy()))

    def gather() -> Experience:
        rollout = next(rollouts).transpose(0, 1)
        after = rollout["next"]
        features = join_features(after["belief"], after["state"])
        return {
            "features": features,
            "action": rollout["action"],
            "reward": after["reward"],
            "continuation": 1.0 - after["terminated"].float(),
            "done": after["done"].float(),
            "weight": torch.ones_like(after["reward"]),
            "following": features[-1],
        }

    return gather


def improve(
    actor: Actor, critic: MLP, optimizer: torch.optim.Optimizer, experience: Experience, log_prob: LogProb
) -> float:
    """Make PPO's epochs; return the divergence before the last step, nats."""
    features, done = experience["features"], experience["done"]
    with torch.no_grad():
        value = critic(features).float()
        following = torch.cat((value[1:], critic(experience["following"]).float().unsqueeze(0)))
        following = torch.where(done.bool(), value, following)
        target = lambda_return(
            REWARD_SCALE * experience["reward"], following, DISCOUNT * experience["continuation"], LAMBDA * (1 - done)
        )
    advantage = normalised(target - value, experience["weight"])
    parts = (features, experience["action"], experience["old"], advantage, experience["weight"], target)
    steps = [part.flatten(0, 1) for part in parts]
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(steps[0])).chunk(MINIBATCHES):
            *chosen, goal = (part[rows] for part in steps)
            batch = Minibatch(*chosen)
            loss, metrics = clipped_objective(actor(batch.features), batch, CLIP, 0.0, log_prob)
            loss = loss + 0.5 * (batch.weight * (critic(batch.features).float() - goal).square()).mean()
            optimizer.zero_grad()
            loss.backward()
            for network in (actor, critic):
                nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()
    return metrics["ppo/kl"].item()


if __name__ == "__main__":
    main()
