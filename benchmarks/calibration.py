"""What an agent expects against what the world pays, on flights of its own policy.

    python benchmarks/calibration.py runs/dreamer_v3_circle_20260101-120000 --json results/calibration.json

The stochastic policy flies N worlds of its training environment for K steps. At every eighth step, over the learner's
horizon H: `reward` is the sum until a crash, in the world and imagined by the policy from the same latents; `crash` the
share that crashed; `value_end` the critic's value of where that led, 0 after a crash. `open_loop_error` is the squared
error of the decoded race vector (symlogs, summed over its 21 entries) predicted H steps ahead from the real actions,
beside that of the latents themselves (`filter_error`) and the vector's variance. `value` is the critic's mean on the
first half of the flights, `monte_carlo` the mean discounted sum of what they were really paid.
"""

import argparse
import sys
from pathlib import Path
from typing import Any, cast

import torch
from measuring import print_table, write_json
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from arena import make_env, restore_learner
from schema import DreamerConfig

from dreamer_racing.checkpoint import latest_checkpoint
from dreamer_racing.diagnostics import correlation
from dreamer_racing.learner import DreamerLearner
from dreamer_racing.losses import imagine
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.world_model import join_features


def main() -> None:
    """Fly, imagine from the same latents, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="run directory or checkpoint")
    parser.add_argument("--num-envs", type=int, default=64, help="N")
    parser.add_argument("--steps", type=int, default=320, help="K")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    checkpoint = latest_checkpoint(arguments.checkpoint)
    saved = OmegaConf.load(checkpoint.parent.parent / "config.yaml")
    config = cast(DreamerConfig, OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(DreamerConfig), saved)))
    torch.manual_seed(0)
    learner, counters = restore_learner(config, checkpoint, torch.device("cpu"))
    with torch.no_grad():
        flight = fly(learner, config, arguments.num_envs, arguments.steps)
        record = {"benchmark": "calibration", "track": config.track, **counters, **compare(learner, flight)}
    print_table([{"name": name, "value": value} for name, value in record.items()], ("name", "value"))
    write_json([record], arguments.json)


def fly(learner: DreamerLearner, config: DreamerConfig, num_envs: int, steps: int) -> TensorDict:
    """Fly the stochastic policy; return latents, actions, rewards, ends and race vectors ``[K, N]``."""
    env, policy, size = make_env(config, num_envs), learner.policy(), learner.size
    observation = env.reset()
    memory = {
        "belief": torch.zeros(num_envs, size.belief),
        "state": torch.zeros(num_envs, size.latents * size.classes),
        "previous_action": torch.zeros(num_envs, 4),
    }
    begins, records = torch.ones(num_envs, 1, dtype=torch.bool), []
    for _ in range(steps):
        acted = policy(observation.clone(recurse=False).update({**memory, "is_init": begins}))
        memory = {name: acted["next", name] for name in memory}
        after = env.step(acted.select("action"))["next"]
        paid = {key: after[key][:, 0] for key in ("reward", "done")}
        vector = observation["privileged", "vector"]
        records.append(TensorDict({**memory, **paid, "vector": vector}, [num_envs]).clone())
        begins, observation = after["done"].clone(), after.select(*env.observation_spec.keys()).clone()
        if begins.any():
            first = env.reset(TensorDict({"_reset": begins}, [num_envs]))
            observation = torch.where(begins[:, 0], first.select(*observation.keys()), observation)
    env.close()
    return cast(TensorDict, torch.stack(records))


def compare(learner: DreamerLearner, flight: TensorDict) -> dict[str, Any]:
    """Return the means that the module's docstring names."""
    model, critic, horizon = learner.agent.world_model, learner.agent.critic, learner.config.imagination_horizon
    value = critic.value(join_features(flight["belief"], flight["state"])).squeeze(-1)  # (K, N)
    rows = []
    for k in range(0, len(flight) - horizon, 8):
        part, start = flight[k : k + horizon], (flight["belief"][k], flight["state"][k])
        alive = torch.cat((torch.ones_like(value[:1]), (~part["done"]).float())).cumprod(0)  # (H + 1, N)
        features = imagine(model.rssm, learner.agent.actor, *start, horizon).features[1:]
        goes_on = model.continue_head.probability(features).squeeze(-1)
        reached = torch.cat((torch.ones_like(goes_on[:1]), goes_on[:-1])).cumprod(0)
        row = {
            "value": value[k],
            "reward_world": (part["reward"] * alive[:-1]).sum(0),
            "reward_imagined": (model.reward_head.mean(features).squeeze(-1) * reached).sum(0),
            "crash_world": 1 - alive[-1],
            "crash_imagined": 1 - goes_on.prod(0),
            "value_end_world": value[k + horizon] * alive[-1],
            "value_end_imagined": critic.value(features[-1]).squeeze(-1) * goes_on.prod(0),
        }
        if hasattr(learner.losses["world_model"], "privileged_decoder"):
            row |= decoded_errors(learner, flight, k, horizon, alive[-1] > 0)
        rows.append({name: numbers.mean().item() for name, numbers in row.items()})
    means = {
        f"mean_{name}" if name == "value" else name: sum(row[name] for row in rows) / len(rows) for name in rows[0]
    }
    paid, half = monte_carlo(flight, learner.config.discount), len(flight) // 2
    return means | {
        "value": value[:half].mean().item(),
        "monte_carlo": paid[:half].mean().item(),
        "value_correlation": correlation(value[:half].flatten(), paid[:half].flatten()).item(),
    }


def decoded_errors(
    learner: DreamerLearner, flight: TensorDict, k: int, horizon: int, alive: Tensor
) -> dict[str, Tensor]:
    """Return errors of the decoded race vector at step k and, open loop, ``horizon`` later (drones alive then)."""
    model = learner.agent.world_model
    decoder = cast(VectorDecoder, learner.losses["world_model"].privileged_decoder)
    belief, state = flight["belief"][k], flight["state"][k]
    now = decoder(join_features(belief, state))
    for action in flight["previous_action"][k : k + horizon]:
        belief, state = model.rssm.imagine_step(belief, state, action)
    then, real = decoder(join_features(belief, state)), symlog(flight["vector"][[k, k + horizon]])
    return {
        "filter_error": (symlog(now) - real[0]).square().sum(-1),
        "open_loop_error": (symlog(then) - real[1])[alive].square().sum(-1),
        "variance": real[1][alive].var(0).sum(),
    }


def monte_carlo(flight: TensorDict, discount: float) -> Tensor:
    """Return the discounted sum of rewards until each episode's end or the last step, ``(K, N)``."""
    paid, sums = torch.zeros_like(flight["reward"][0]), []
    for step in reversed(flight.unbind(0)):
        paid = step["reward"] + discount * paid * (~step["done"]).float()
        sums.append(paid)
    return torch.stack(sums[::-1])


if __name__ == "__main__":
    main()
