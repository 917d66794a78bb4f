"""Benchmark of an actor's learning signal: accuracy of imagined returns, noise of gradients, drift of the policy.

    python benchmarks/learning_signal.py runs/circle --json learning_signal.json

* `returns`: the stochastic policy flies N worlds of its training environment for K steps, at a body-rate weight b₂ of
  0. From the latents at every eighth step it also imagines H steps. For real and imagined steps, `reward` is the sum
  until a crash, `crash` the share of crashes, `value_end` the critic's value after H steps (0 after a crash) and
  `return` the λ-return; `return_correlation` correlates the two returns over all starts. `value` is the critic's mean
  on the first half of the flights, `monte_carlo` the mean discounted reward sum until the end of the episode or flight;
  rewards cut off at the end of the flight would be discounted by at least γ to the power of K / 2.
* `gradient`: noise of the actor's gradient for each of the two objectives of imagined steps, from `starts` latents of
  the run's replay, as many as in an update and eight times as many: `cosine` between gradients from independent draws,
  `signal` power over noise power, and CPU `seconds` per gradient; `agreement` is the cosine between the mean gradients
  of the two objectives.
* `drift`: change of a fixed actor's policy by updates of the world model, for records with stored latents
  (`replay.context=true`): divergence, nats, of the policy at a record's stored latents, which are from its last update
  or its collection, from the policy at its current latents; mean and quantiles `of` windows of the newest records
  (`replay.recent_share`) and of all records, most of which the model was not trained on recently.

H is the learner's horizon, or ``--horizon``. The trained weights are measured, not the averaged ones. If the checkpoint
holds no replay (`best/`), use ``--only returns``.
"""

import time
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from measuring import make_parser, print_table, write_json
from tensordict import TensorDict
from torch import Tensor
from trained import Trained, fly, make_env, restore, restore_replay

from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.held_out import correlation
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import OBJECTIVES, choose_starts, gradient_of_actions, imagine, lambda_return
from dreamer_racing.modules.rssm import join_features

PARTS = ("returns", "gradient", "drift")
OF_IMAGINED_STEPS = ("reinforce", "dynamics")
EVERY = 8  # steps between two starts of imagination
GRADIENTS, TIMES = 8, (1, 8)  # number of independent gradients, and multiples of an update's starts
BATCHES, QUANTILES = 12, (0.1, 0.25, 0.5, 0.75, 0.9, 0.99)  # for the drift


def main() -> None:
    """Measure every checkpoint."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--num-envs", type=int, default=64, help="N")
    parser.add_argument("--steps", type=int, default=320, help="K")
    parser.add_argument("--horizon", type=int, help="H; default: the learner's")
    arguments = parser.parse_args()
    records = []
    for path in arguments.checkpoints:
        trained = restore(path)
        if arguments.horizon:
            trained.learner.adjust(imagination_horizon=arguments.horizon)
        torch.manual_seed(0)
        for record in measure(trained, arguments.only, arguments.num_envs, arguments.steps):
            where = trained.where | {"horizon": trained.learner.horizon}
            records.append({"benchmark": "learning_signal", **where, **record})
            print_table([{"name": name, "value": value} for name, value in records[-1].items()], ("name", "value"))
            write_json(records, arguments.json)


def measure(trained: Trained, parts: tuple[str, ...], num_envs: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield the records of the chosen parts."""
    learner, model = trained.learner, trained.config.model
    if "returns" in parts:
        env = make_env(trained.config, num_envs)
        longest = cast(DroneRacingEnv, env).worlds.race.episode_steps - 1
        if steps > longest:
            raise SystemExit(f"--steps {steps}: must be at most {longest}, so that no episode reaches its time limit.")
        flight = fly(learner, env, steps)
        yield {"measured": "returns", "num_envs": num_envs, "steps": steps, **compare_returns(learner, flight)}
    if "gradient" in parts or "drift" in parts:
        replay = restore_replay(trained)
    if "gradient" in parts:
        starts = model.imagination_starts or model.batch_size * model.batch_length
        for times in TIMES:
            drawn = [draw_starts(learner, replay, starts * times) for _ in range(GRADIENTS)]
            means: list[Tensor] = []
            for objective in OF_IMAGINED_STEPS:
                began = time.process_time()
                gradients = torch.stack([gradient(learner, some, objective) for some in drawn])
                seconds = (time.process_time() - began) / GRADIENTS
                means.append(gradients.mean(0))
                row = {"measured": "gradient", "objective": objective, "starts": starts * times, "seconds": seconds}
                yield row | noise_of(gradients)
            agreement = F.cosine_similarity(means[0], means[1], dim=0).item()
            yield {"measured": "agreement", "starts": starts * times, "cosine": agreement}
    if "drift" in parts and trained.config.replay.context:
        yield from drift(learner, replay)


class Rollout(NamedTuple):
    """H steps from each of N starts; all fields ``(H, N, 1)`` but the value, ``(H + 1, N, 1)``."""

    reward: Tensor
    continuation: Tensor
    value: Tensor

    def returns(self, learner: WorldModelLearner) -> Tensor:
        """Return the λ-returns, ``(H, N, 1)``."""
        discount = learner.discount * self.continuation
        return lambda_return(self.reward, self.value[1:], discount, learner.loss_config.lambda_)

    def reached(self) -> Tensor:
        """Return the probability of reaching each step and the end, ``(H + 1, N, 1)``."""
        return torch.cat((torch.ones_like(self.value[:1]), self.continuation)).cumprod(0)


def imagined(learner: WorldModelLearner, belief: Tensor, state: Tensor) -> tuple[Rollout, Tensor, Tensor]:
    """Imagine from latents ``(N, ...)``; return rollout, features ``(H + 1, N, F)`` and actions ``(H, N, A)``.

    Gradients are recorded as the caller's context allows.
    """
    model, actor, critic = learner.agent.world_model, learner.agent.actor, learner.agent.critic
    features, action = imagine(model.rssm, actor, belief, state, learner.horizon)
    reward, continuation = model.reward_head.mean(features[1:]), model.continue_head.probability(features[1:])
    return Rollout(reward, continuation, critic.value(features)), features, action


@torch.no_grad()
def compare_returns(learner: WorldModelLearner, flight: TensorDict) -> dict[str, float]:
    """Return the means and correlations of `returns` (see the module's docstring) of a flight ``[K, N]``."""
    horizon, rows = learner.horizon, []
    value = learner.agent.critic.value(join_features(flight["belief"], flight["state"]))  # (K, N, 1)
    for k in range(0, len(flight) - horizon, EVERY):
        part = flight[k : k + horizon]
        world = Rollout(part["reward"], (~part["done"]).float(), value[k : k + horizon + 1])
        both = {"world": world, "imagined": imagined(learner, flight["belief"][k], flight["state"][k])[0]}
        row: dict[str, Tensor] = {}
        for name, rollout in both.items():
            reached = rollout.reached()
            row |= {
                f"reward_{name}": (rollout.reward * reached[:-1]).sum(0),
                f"crash_{name}": 1 - reached[-1],
                f"value_end_{name}": rollout.value[-1] * reached[-1],
                f"return_{name}": rollout.returns(learner)[0],
            }
        rows.append(row)
    found = {name: torch.cat([row[name] for row in rows]) for name in rows[0]}
    half, paid = len(flight) // 2, monte_carlo(flight, float(learner.discount))
    return {name: numbers.mean().item() for name, numbers in found.items()} | {
        "return_correlation": correlation(found["return_imagined"].flatten(), found["return_world"].flatten()).item(),
        "value": value[:half].mean().item(),
        "monte_carlo": paid[:half].mean().item(),
        "value_correlation": correlation(value[:half].flatten(), paid[:half].flatten()).item(),
    }


def monte_carlo(flight: TensorDict, discount: float) -> Tensor:
    """Return the discounted sum of rewards until each episode's end or the last step, ``(K, N, 1)``."""
    paid, sums = torch.zeros_like(flight["reward"][0]), []
    for step in reversed(flight.unbind(0)):
        paid = step["reward"] + discount * paid * (~step["done"]).float()
        sums.append(paid)
    return torch.stack(sums[::-1])


@torch.no_grad()
def draw_starts(learner: WorldModelLearner, replay: StreamReplay, number: int) -> TensorDict:
    """Draw starts of imagination as updates do: belief, state, terminated, batch ``[number]``."""
    parts: list[TensorDict] = []
    while sum(map(len, parts)) < number:
        batch = replay.sample()
        _, latents = learner.world_model_loss(batch)
        number_of_each = learner.config.imagination_starts
        belief, state = latents
        starts = choose_starts(belief, state, batch["terminated"], batch["previous_action"], number_of_each)
        parts.append(TensorDict(starts._asdict(), [len(starts.belief)]))
    return cast(TensorDict, torch.cat(cast(Any, parts)))[:number]


def gradient(learner: WorldModelLearner, starts: TensorDict, objective: str) -> Tensor:
    """Return the actor's gradient ``(P,)`` of an objective, without entropy and return scale, from starts ``[N]``."""
    agent, through_dynamics = learner.agent, hasattr(OBJECTIVES[objective], "through_dynamics")
    with gradient_of_actions(OBJECTIVES[objective], agent.world_model, agent.critic):
        rollout, features, action = imagined(learner, starts["belief"], starts["state"])
        returns = rollout.returns(learner)
    discounts = learner.discount ** torch.arange(learner.horizon).view(-1, 1, 1)
    weight = (1.0 - starts["terminated"].float()) * discounts * rollout.reached()[:-1].detach()
    score = None if through_dynamics else agent.actor(features[:-1]).log_prob(action)
    gain = returns if score is None else score * (returns - rollout.value[:-1])
    gradients = torch.autograd.grad(-(weight * gain).mean(), list(agent.actor.parameters()))
    return torch.cat([part.flatten() for part in gradients])


def noise_of(rows: Tensor) -> dict[str, float]:
    """Return mean cosine and signal-to-noise ratio of independent gradients ``(G, P)``."""
    mean, count = rows.mean(0), len(rows)
    noise = (rows - mean).square().sum() / (count - 1)
    signal = mean.square().sum() - noise / count
    unit = F.normalize(rows, dim=1)
    cosine = ((unit @ unit.T).sum() - count) / (count * (count - 1))
    return {"cosine": cosine.item(), "signal": (signal / noise).item()}


@torch.no_grad()
def drift(learner: WorldModelLearner, replay: StreamReplay) -> Iterator[dict[str, Any]]:
    """Yield a record of the policy's drift for windows of the newest records, and one for windows of all records."""
    moved, recent = [], []
    for _ in range(BATCHES):
        batch = replay.sample()
        _, seen = learner.world_model_loss(batch)
        before, after, same = learner.stored_and_current_features(seen, batch)
        divergence, same = learner.agent.actor(before).divergence(learner.agent.actor(after)), same.squeeze(-1)
        moved.append(divergence.squeeze(-1)[same])
        recent.append(batch["recent"].reshape(len(same), -1)[:, :1].expand_as(same)[same])
    of_all, newest = torch.cat(moved), torch.cat(recent)
    for name, values in (("newest", of_all[newest]), ("all", of_all[~newest])):
        if len(values):
            quantiles = zip(QUANTILES, values.quantile(torch.tensor(QUANTILES)).tolist(), strict=True)
            found = {f"q{100 * share:.0f}": value for share, value in quantiles}
            yield {"measured": "drift", "of": name, "records": len(values), "mean": values.mean().item(), **found}


if __name__ == "__main__":
    main()
