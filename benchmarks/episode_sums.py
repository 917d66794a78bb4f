"""`EpisodeTracker` beside TorchRL's `RewardSum` and `StepCounter`: cost of a step, and error of an episode's return.

    python benchmarks/episode_sums.py --json results/episode_sums.json

32 drones fly Kidney at random, without images. Costs are CPU time of `env.rollout` (and of the tracker's `update` of
what came of it), in alternation; the reference of a return is the sum of its rewards in float64.
"""

import argparse
import time

import torch
from measuring import print_table, write_json
from tensordict import TensorDictBase
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.transforms import Transform

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.training.episodes import EpisodeTracker

NUM_ENVS, STEPS = 32, 128


def make_env(*transforms: Transform) -> TransformedEnv:
    """Make the race, with what is to be measured."""
    env = DroneRacingEnv(track="kidney", num_envs=NUM_ENVS, from_pixels=False, preset="easy", seed=0)
    return TransformedEnv(env, Compose(InitTracker(), *transforms))


def exact_returns(rollout: TensorDictBase) -> torch.Tensor:
    """Return the sum up to every step (N, T) of its episode's rewards, in float64; episodes begin in the rollout."""
    reward, done = (rollout["next", key].squeeze(-1) for key in ("reward", "done"))
    sums, total = [], torch.zeros(len(reward), dtype=torch.float64)
    for step in range(reward.shape[1]):
        total = total + reward[:, step].double()
        sums.append(total)
        total = total.masked_fill(done[:, step], 0)
    return torch.stack(sums, dim=1)


def main() -> None:
    """Fly and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollouts", type=int, default=10)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    tracked, transformed = make_env(), make_env(RewardSum(), StepCounter())
    spent = {"EpisodeTracker": 0.0, "RewardSum and StepCounter": 0.0}
    worst = dict.fromkeys(spent, 0.0)
    for turn in range(arguments.rollouts + 1):
        rollouts = {}
        for name, env in zip(spent, (tracked, transformed), strict=True):
            torch.manual_seed(turn)
            start = time.process_time()
            rollouts[name] = env.rollout(STEPS, break_when_any_done=False)
            if env is tracked:
                episodes = EpisodeTracker(NUM_ENVS).update(rollouts[name])
            spent[name] += (time.process_time() - start) * (turn > 0)  # the first warms up
        step, world = rollouts["EpisodeTracker"]["next", "done"].squeeze(-1).T.nonzero(as_tuple=True)
        found = episodes["return"], rollouts["RewardSum and StepCounter"]["next", "episode_reward"].squeeze(-1)
        for name, values, rollout in zip(spent, (found[0], found[1][world, step]), rollouts.values(), strict=True):
            wrong = (values.double() - exact_returns(rollout)[world, step].float().double()).abs().max()
            worst[name] = max(worst[name], wrong.item())
    steps = arguments.rollouts * STEPS
    records = [
        {"sums": name, "ms_per_step": 1e3 * spent[name] / steps, "worst_return_error": worst[name]} for name in spent
    ]
    print_table(records, ("sums", "ms_per_step", "worst_return_error"))
    write_json(records, arguments.json)


if __name__ == "__main__":
    main()
