"""What an agent expects against what the world pays, on flights of its own policy.

    python benchmarks/calibration.py runs/circle/checkpoints/checkpoint-000000200192 runs/circle --json calibration.json

The stochastic policy flies N worlds of its training environment for K steps, at a body-rate weight b₂ of 0. At every
eighth step, over the learner's horizon H: `reward` is the sum until a crash, in the world and imagined by the policy
from the same latents; `crash` the share that crashed; `value_end` the critic's value of where that led, 0 after one.
For losses that decode privileged state, `open_loop_error` is the squared error of the decoded race vector (symlogs,
summed over its 21 entries) predicted H steps ahead from the real actions, beside that of the latents themselves
(`filter_error`) and the vector's variance; `in_view` is how often the target gate is less than 3 m away, ahead, and
within 40° to the sides; `wrong_gate` the share of that where its decoded centre is more than 2 m off, which is another
gate's, and `gate_error` how far it is off in the rest, m (root mean square). `value` is the critic's mean on the first
half of the flights, `monte_carlo` the mean discounted sum of what was paid until the episode's or the flight's end: γ
to the power of K / 2 or less of the value is cut off.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import Any, cast

import torch
from measuring import print_table, write_json
from tensordict import TensorDict
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.arena import make_env
from composing.restoring import restore_learner
from composing.saved import trained_config
from composing.schema import DreamerConfig

from dreamer_racing.envs.race.race_vector import DISTANCE
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.evaluation.held_out import correlation
from dreamer_racing.learners.dreamer import DreamerLearner
from dreamer_racing.losses import imagine
from dreamer_racing.modules.decoder import VectorDecoder
from dreamer_racing.modules.heads import symlog
from dreamer_racing.modules.world_model import join_features
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

NEAR, HALF_VIEW = 3.0, math.radians(40.0)  # m and rad to either side: where a gate counts as seen
WRONG_GATE = 2.0  # m: an error that means another gate
TO_GATE = slice(9, 12)  # of a race vector: from the drone to the centre of the target gate, see `RACE_VECTOR_ENTRIES`


def main() -> None:
    """Fly, imagine from the same latents, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", help="run directories or checkpoints, of races")
    parser.add_argument("--num-envs", type=int, default=64, help="N")
    parser.add_argument("--steps", type=int, default=320, help="K")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    records = [measure(latest_checkpoint(path), arguments.num_envs, arguments.steps) for path in arguments.checkpoints]
    for record in records:
        print_table([{"name": name, "value": value} for name, value in record.items()], ("name", "value"))
    write_json(records, arguments.json)


@torch.no_grad()
def measure(checkpoint: Path, num_envs: int, steps: int) -> dict[str, Any]:
    """Return one record.

    Raises:
        ValueError: the checkpoint is of another algorithm.
    """
    config = trained_config(RunDirectory.of(checkpoint).path)
    if not isinstance(config, DreamerConfig):
        raise ValueError(f"{checkpoint} was trained by {config.algorithm}, which imagines nothing.")
    torch.manual_seed(0)
    restored, counters = restore_learner(config, checkpoint, torch.device("cpu"))
    learner = cast(DreamerLearner, restored)
    return {
        "benchmark": "calibration", "track": config.track, "actor": config.loss.actor, **counters,
        "num_envs": num_envs, "steps": steps, "horizon": learner.horizon,
        "discount": learner.discount, **compare(learner, fly(learner, config, num_envs, steps)),
    }  # fmt: skip


def fly(learner: DreamerLearner, config: DreamerConfig, num_envs: int, steps: int) -> TensorDict:
    """Fly the stochastic policy; return latents, actions, rewards, ends and, if there, race vectors ``[K, N]``.

    Raises:
        ValueError: the flight would reach the time limit, which is no crash.
    """
    env, policy, size = make_env(config, num_envs), learner.policy(), learner.size
    longest = cast(DroneRacingEnv, env).worlds.race.episode_steps - 1
    if steps > longest:
        raise ValueError(f"--steps {steps}: at most {longest}, so that no time runs out.")
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
        record = {"belief": memory["belief"], "state": memory["state"], "action": acted["action"]}
        record |= {key: after[key][:, 0] for key in ("reward", "done")}
        if ("privileged", "vector") in observation.keys(True):
            record["vector"] = observation["privileged", "vector"]
        records.append(TensorDict(record, [num_envs]).clone())
        begins, observation = after["done"].clone(), after.select(*env.observation_spec.keys()).clone()
        if begins.any():
            first = env.reset(TensorDict({"_reset": begins}, [num_envs]))
            observation = torch.where(begins[:, 0], first.select(*observation.keys()), observation)
    env.close()
    return cast(TensorDict, torch.stack(records))


def compare(learner: DreamerLearner, flight: TensorDict) -> dict[str, Any]:
    """Return the means that the module's docstring names."""
    model, critic, horizon = learner.agent.world_model, learner.agent.critic, learner.horizon
    value = critic.value(join_features(flight["belief"], flight["state"])).squeeze(-1)  # (K, N)
    rows = []
    for k in range(0, len(flight) - horizon, 8):
        part, start = flight[k : k + horizon], (flight["belief"][k], flight["state"][k])
        alive = torch.cat((torch.ones_like(value[:1]), (~part["done"]).float())).cumprod(0)  # (H + 1, N)
        features = imagine(model.rssm, learner.agent.actor, *start, horizon).features[1:]
        goes_on = model.continue_head.probability(features).squeeze(-1)
        reached = torch.cat((torch.ones_like(goes_on[:1]), goes_on[:-1])).cumprod(0)
        row = {
            "reward_world": (part["reward"] * alive[:-1]).sum(0),
            "reward_imagined": (model.reward_head.mean(features).squeeze(-1) * reached).sum(0),
            "crash_world": 1 - alive[-1],
            "crash_imagined": 1 - goes_on.prod(0),
            "value_end_world": value[k + horizon] * alive[-1],
            "value_end_imagined": critic.value(features[-1]).squeeze(-1) * goes_on.prod(0),
        }
        if hasattr(learner.losses["world_model"], "privileged_decoder"):
            row |= decoded_errors(learner, flight, k, horizon, alive[-1] > 0)
        rows.append({name: numbers.mean() for name, numbers in row.items()})
    # Where no drone is left after H steps there is no error to take.
    means = {name: torch.stack([row[name] for row in rows]).nanmean().item() for name in rows[0]}
    if "gate_error" in means:
        means["gate_error"] = math.sqrt(means["gate_error"])
    paid, half = monte_carlo(flight, learner.discount), len(flight) // 2
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
    for action in flight["action"][k : k + horizon]:
        belief, state = model.rssm.imagine_step(belief, state, action)
    then, real = decoder(join_features(belief, state)), symlog(flight["vector"][[k, k + horizon]])
    gate = DISTANCE * flight["vector"][k][:, TO_GATE]  # (N, 3) m, in the body frame
    gate_error = (DISTANCE * now[:, TO_GATE] - gate).square().sum(-1)  # (N,) m²
    is_wrong = gate_error > WRONG_GATE**2
    forward, left, _ = gate.unbind(-1)
    in_view = (gate.norm(dim=-1) < NEAR) & (forward > 0.0) & (left.abs() < math.tan(HALF_VIEW) * forward)
    return {
        "filter_error": (symlog(now) - real[0]).square().sum(-1),
        "in_view": in_view.float(),
        "wrong_gate": is_wrong[in_view].float(),
        "gate_error": gate_error[in_view & ~is_wrong],
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
