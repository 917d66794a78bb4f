"""Environments with what a policy reads beside observations: where episodes begin, and what it remembers."""

from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv


def with_memory(env: EnvBase, primer: Transform) -> TransformedEnv:
    """Give an environment `is_init` and the keys of a policy's memory.

    Args:
        env: any.
        primer: of the policy, ``policy.make_primer()``: what it remembers where an episode begins.

    Raises:
        TypeError: something else than a transform, such as the policy itself.

    Example:
        >>> from torchrl.data import Unbounded
        >>> primer = TensorDictPrimer({"belief": Unbounded((8,))}, default_value=0.0, expand_specs=True)
        >>> with_memory(DroneRacingEnv("circle", 2, from_pixels=False), primer).reset()["belief"].shape
        torch.Size([2, 8])
    """
    if not isinstance(primer, Transform):
        raise TypeError(f"with_memory takes policy.make_primer(), a transform, and no {type(primer).__name__}.")
    in_place = isinstance(env, DroneRacingEnv) and _begins_with_zeros(primer)
    return (RaceWithMemory if in_place else TransformedEnv)(env, Compose(InitTracker(), primer))


class RaceWithMemory(TransformedEnv):
    """A `DroneRacingEnv` with `InitTracker` and a primer of zeros, as `with_memory` makes it.

    Between two steps the race begins episodes in place, with zeros for all that is not its own. TorchRL would make
    another observation of all worlds, transform it, choose between the two, and wait for a CUDA device twelve times;
    it does so here, too, once further transforms are appended.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin episodes where one ended, in place."""
        if len(self.transform) > 2 or not self.base_env.is_of_a_step(tensordict):
            return super().maybe_reset(tensordict)
        ended = tensordict.get("done").clone()
        return self.base_env.maybe_reset(tensordict).set("is_init", ended)


def _begins_with_zeros(primer: Transform) -> bool:
    """Whether a transform does nothing but give zeros where an episode begins."""
    if isinstance(primer, Compose):
        return all(_begins_with_zeros(part) for part in primer)
    if not isinstance(primer, TensorDictPrimer) or primer.random:
        return False
    given = primer.default_value
    values = given.values() if isinstance(given, dict) else [given]
    return all(isinstance(value, int | float) and value == 0 for value in values)
