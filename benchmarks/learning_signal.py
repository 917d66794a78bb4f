"""Benchmark of an actor's learning signal: accuracy of imagined returns, noise and accuracy of gradients.

    python benchmarks/learning_signal.py runs/circle --json learning_signal.json

* `returns`: the stochastic policy flies N worlds of its training environment for K steps, at a body-rate weight b₂ of
  0. From the latents at every eighth step it also imagines H steps. For real and imagined steps, `reward` is the sum
  until a crash, `crash` the share of crashes, `value_end` the critic's value after H steps (0 after a crash) and
  `return` the λ-return; `return_correlation` correlates the two returns over all starts. `value` is the critic's mean
  on the first half of the flights, `monte_carlo` the mean discounted reward sum until the end of the episode or flight.
* `gradient`: noise of the actor's gradient for each of the two objectives of imagined steps, from `starts` latents of
  the run's replay, as many as in an update and eight times as many: `cosine` of independent draws, `signal` over noise.
* `collected`: whether imagination improves the real return: `cosine` between the gradient of REINFORCE on the steps of
  the flight, with their λ-returns, and the gradient through the dynamics on H steps imagined from every eighth of their
  latents: 1 is the same direction, below 0 imagination makes the policy worse. Both are without entropy. Noise is
  corrected for, by four groups of worlds, whose mutual `cosine_collected` should be above 0.1: else raise N.

H is the learner's horizon, or ``--horizon``. The trained weights are measured, not the averaged ones. `gradient` needs
the replay in the checkpoint.
"""

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
from dreamer_racing.losses.returns import rollout_return
from dreamer_racing.modules.rssm import join_features

PARTS = ("returns", "gradient", "collected")
OF_IMAGINED_STEPS = ("reinforce", "dynamics")
EVERY = 8  # steps between two starts of imagination
GRADIENTS, TIMES = 8, (1, 8)  # number of independent gradients, and multiples of an update's starts
GROUPS = 4  # of worlds, for the noise of their gradients


def main() -> None:
    """Measure every checkpoint."""
    parser = make_parser(__doc__)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints of dreamer_v3 races")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--num-envs", type=int, default=64, help="N")
    parser.add_argument("--steps", type=int, default=320, help="K")
    parser.add_argument("--start-on-line", type=float, help="share of flights from a racing line; default: the run's")
    parser.add_argument("--horizon", type=int, help="H; default: the learner's")
    arguments = parser.parse_args()
    records = []
    for path in arguments.checkpoints:
        trained = restore(path)
        if arguments.start_on_line is not None:
            trained.config.env.start_on_line = arguments.start_on_line
        if arguments.horizon:
            trained.learner.adjust(imagination_horizon=arguments.horizon)
        torch.manual_seed(0)
        for record in measure(trained, arguments.only, arguments.num_envs, arguments.steps):
            own = {"horizon": trained.learner.horizon, "start_on_line": trained.config.env.start_on_line}
            records.append({"benchmark": "learning_signal", **trained.where, **own, **record})
            print_table([{"name": name, "value": value} for name, value in records[-1].items()], ("name", "value"))
            write_json(records, arguments.json)


def measure(trained: Trained, parts: tuple[str, ...], num_envs: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield the records of the chosen parts."""
    learner, model = trained.learner, trained.config.model
    if "returns" in parts or "collected" in parts:
        env = make_env(trained.config, num_envs)
        longest = cast(DroneRacingEnv, env).worlds.race.episode_steps - 1
        if steps > longest:
            raise SystemExit(f"--steps {steps}: must be at most {longest}, so that no episode reaches its time limit.")
        flight = fly(learner, env, steps)
        for part, compare in (("returns", compare_returns), ("collected", compare_gradients)):
            if part in parts:
                yield {"measured": part, "num_envs": num_envs, "steps": steps, **compare(learner, flight)}
    if "gradient" in parts:
        replay = restore_replay(trained)
        starts = model.imagination_starts or model.batch_size * model.batch_length
        for times in TIMES:
            drawn = [draw_starts(learner, replay, starts * times) for _ in range(GRADIENTS)]
            for objective in OF_IMAGINED_STEPS:
                gradients = torch.stack([gradient(learner, some, objective) for some in drawn])
                yield {"measured": "gradient", "objective": objective, "starts": starts * times, **noise_of(gradients)}


class Rollout(NamedTuple):
    """H steps from each of N starts; all fields ``(H, N, 1)`` but the value, ``(H + 1, N, 1)``."""

    reward: Tensor
    continuation: Tensor
    value: Tensor

    def returns(self, learner: WorldModelLearner) -> Tensor:
        """Return the λ-returns, ``(H, N, 1)``."""
        discount = learner.discount * self.continuation ** getattr(learner, "crash_weight", 1.0)
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
        number_of_each = learner.config.imagination_starts
        belief, state = learner.world_model_loss(batch)[1]
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
    reached = rollout.reached()[:-1].detach() ** getattr(learner, "crash_weight", 1.0)
    weight = (1.0 - starts["terminated"].float()) * discounts * reached
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


def compare_gradients(learner: WorldModelLearner, flight: TensorDict) -> dict[str, float]:
    """Return the numbers of `collected` (see the module's docstring) of a flight ``[K, N]``."""
    flight["terminated"] = torch.zeros_like(flight["done"])  # that a step ends the episode is seen after it
    parts = flight.tensor_split(GROUPS, 1)
    real = torch.stack([collected_gradient(learner, part) for part in parts])
    imagined = torch.stack([gradient(learner, part[::EVERY].flatten(), "dynamics") for part in parts])
    return {"cosine": common_cosine(real, imagined), "cosine_collected": noise_of(real)["cosine"]}


def collected_gradient(learner: WorldModelLearner, flight: TensorDict) -> Tensor:
    """Return the actor's gradient ``(P,)`` of REINFORCE on the steps of a flight ``[K, N]``, without entropy."""
    actor, features = learner.agent.actor, join_features(flight["belief"], flight["state"])
    with torch.no_grad():
        value, done = learner.agent.critic.value(features), flight["done"]
        returns = rollout_return(flight["reward"], value, done, done, learner.discount, learner.loss_config.lambda_)
    score, advantage = actor(features).log_prob_clipped(flight["action"]), returns - value
    gradients = torch.autograd.grad(-(score * (advantage - advantage.mean())).mean(), list(actor.parameters()))
    return torch.cat([part.flatten() for part in gradients])


def common_cosine(rows: Tensor, others: Tensor) -> float:
    """Return the cosine between the means of two sets of independent gradients ``(G, P)``, corrected for noise.

    Only products of different groups are used, since those of the same group share noise. NaN if a set is mostly noise.
    """
    products = (a @ b.T for a, b in ((rows, others), (rows, rows), (others, others)))
    common, own, their = (product.sum() - product.diagonal().sum() for product in products)
    return (common / (own.sqrt() * their.sqrt())).item()


if __name__ == "__main__":
    main()
