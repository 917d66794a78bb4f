"""Transforms that give a policy its inputs beside observations: the `is_init` flag and its recurrent state."""

from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv

from dreamer_racing.envs.torchrl_env import DroneRacingEnv


def with_memory(env: EnvBase, primer: Transform) -> TransformedEnv:
    """Add `is_init` and the policy's recurrent state to an environment.

    Args:
        env: any TorchRL environment.
        primer: the initial recurrent state of the policy, from ``policy.make_primer()``.

    Raises:
        TypeError: ``primer`` is not a transform, for example the policy itself.

    Example:
        >>> from torchrl.data import Unbounded
        >>> primer = TensorDictPrimer({"belief": Unbounded((8,))}, default_value=0.0, expand_specs=True)
        >>> with_memory(DroneRacingEnv("circle", 2, from_pixels=False), primer).reset()["belief"].shape
        torch.Size([2, 8])
    """
    if not isinstance(primer, Transform):
        raise TypeError(f"with_memory needs a transform, policy.make_primer(), not {type(primer).__name__}.")
    in_place = isinstance(env, DroneRacingEnv) and _begins_with_zeros(primer)
    return (RaceWithMemory if in_place else TransformedEnv)(env, Compose(InitTracker(), primer))


class RaceWithMemory(TransformedEnv):
    """A `DroneRacingEnv` with `InitTracker` and an all-zero primer, made by `with_memory`.

    Ended episodes are reset in place, and every key that the race does not write is zeroed. TorchRL's own reset
    observes all worlds again, transforms and merges both observations, and synchronises with a CUDA device twelve
    times; it is used here only if further transforms are appended.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reset in place the environments whose episode ended."""
        if len(self.transform) > 2 or not self.base_env.has_step_keys(tensordict):
            return super().maybe_reset(tensordict)
        ended = tensordict.get("done").clone()
        return self.base_env.maybe_reset(tensordict).set("is_init", ended)


def _begins_with_zeros(primer: Transform) -> bool:
    """Return whether a transform only writes zeros at the start of an episode."""
    if isinstance(primer, Compose):
        return all(_begins_with_zeros(part) for part in primer)
    if not isinstance(primer, TensorDictPrimer) or primer.random:
        return False
    given = primer.default_value
    values = given.values() if isinstance(given, dict) else [given]
    return all(isinstance(value, int | float) and value == 0 for value in values)
