"""From what a collector yields to replay records, one an observation.

Shapes: N environments, T steps a rollout, M records of one rollout. The record layout is the table of
``docs/api/training.md``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from dreamer_racing.modules.rssm import CONTEXT, LatentFormat

RACE_REWARD_KEYS = ("reward", "reward_base", "body_rate_norm")
"""The reward of a race and the terms of which `RelabelReward` recomputes it."""
END_KEYS = ("terminated", "truncated")
"""How an episode may end."""


def records_from_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey] = ("pixels",),
    reward_keys: Sequence[str] = RACE_REWARD_KEYS,
    latents: LatentFormat | None = None,
) -> TensorDictBase:
    """Converts what a TorchRL collector yields into replay records.

    Every transition gives one record, of the observation it arrived at; every root with ``is_init`` gives one more,
    of the first observation of its episode. An episode of K steps therefore leaves K + 1 records.

    Args:
        rollout: batch ``[N, T]`` (further leading dimensions, as of a multi-process collector, are flattened into N)
            with root keys ``action``, ``is_init`` and the observations, and ``("next", ...)`` keys of the
            observations, the rewards, ``terminated``, ``truncated``.
        observation_keys: what of an observation is kept.
        reward_keys: which rewards are kept.
        latents: how the policy's latents are kept as each record's ``context``: what it had in mind before it saw the
            record's observation. None: they are not.

    Returns:
        Records, batch ``[M]`` with M = N·T + number of first observations, first all arrivals, then all first
        observations. Beside the record's own keys: ``stream`` int64 ``(M,)``, the environment, and ``order`` int64
        ``(M,)``, how many of these records precede it in its stream. Stored records carry neither.

    Raises:
        KeyError: if the rollout lacks a key.
        ValueError: if the rollout has no time dimension.
    """
    _check_rollout(rollout, observation_keys, reward_keys, latents)
    steps = rollout.shape[-1]
    flat = rollout.reshape(-1)  # [N·T], environment by environment
    is_init = flat["is_init"].reshape(-1)
    first = is_init.nonzero().squeeze(-1)  # (K,)
    stream = torch.arange(len(flat), device=is_init.device) // steps  # (N·T,)
    # Records up to and including each arrival, over all streams, less those of the streams before.
    count = (1 + is_init.long()).cumsum(0)
    before = torch.nn.functional.pad(count[steps - 1 :: steps], (1, 0))[stream]  # (N·T,)
    order = count - before - 1

    arrival = flat["next"].select(*observation_keys, *reward_keys, *END_KEYS)
    arrival.update({"previous_action": flat["action"], "is_init": torch.zeros_like(flat["is_init"])})
    arrival.update({"stream": stream, "order": order})
    if latents is not None:
        arrival.set(CONTEXT, latents.pack(flat["next", "belief"], flat["next", "state"]))
    initial = flat.select(*observation_keys)[first]
    zeros = arrival.select("previous_action", *reward_keys, *END_KEYS, CONTEXT, strict=False)[: len(first)]
    initial.update(zeros.apply(torch.zeros_like))
    initial.update({"is_init": flat["is_init"][first], "stream": stream[first], "order": order[first] - 1})
    return torch.cat([arrival, initial])


def _check_rollout(
    rollout: TensorDictBase,
    observation_keys: Sequence[NestedKey],
    reward_keys: Sequence[str],
    latents: LatentFormat | None,
) -> None:
    if rollout.ndim < 2:
        raise ValueError(f"Expected a rollout of batch [environments, time], got batch {list(rollout.shape)}.")
    root = [*observation_keys, "action", "is_init"]
    arrived = [*observation_keys, *reward_keys, *END_KEYS, *(("belief", "state") if latents is not None else ())]
    missing = [key for key in root if rollout.get(key, None) is None]
    missing += [("next", key) for key in arrived if rollout["next"].get(key, None) is None]
    if missing:
        raise KeyError(
            f"The rollout lacks {missing}. The replay needs {root} at the root and {arrived} under 'next'; "
            "'is_init' comes from torchrl's InitTracker, the reward terms from DroneRacingEnv."
        )
