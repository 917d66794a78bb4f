"""Environments with what a policy reads beside observations: where episodes begin, and what it remembers."""

from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, InitTracker, Transform, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv


def with_memory(env: EnvBase, primer: Transform) -> TransformedEnv:
    """Give an environment `is_init` and the keys of a policy's memory.

    Args:
        env: any.
        primer: of the policy, ``policy.make_primer()``: what it remembers is zero where an episode begins.
    """
    kind = RaceWithMemory if isinstance(env, DroneRacingEnv) else TransformedEnv
    return kind(env, Compose(InitTracker(), primer))


class RaceWithMemory(TransformedEnv):
    """A `DroneRacingEnv` with `InitTracker` and `TensorDictPrimer`, as `with_memory` makes it.

    Between two steps the race begins episodes in place, with zeros for all that is not its own. TorchRL would make
    another observation of all worlds, transform it, choose between the two, and wait for a CUDA device twelve times.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin episodes where one ended, in place."""
        if not self.base_env.is_of_a_step(tensordict):
            return super().maybe_reset(tensordict)
        ended = tensordict.get("done").clone()
        return self.base_env.maybe_reset(tensordict).set("is_init", ended)
