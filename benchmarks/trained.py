"""Restoring of trained world-model agents and their replay on a CPU, for benchmarks."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.building import Environment, make_curriculum, make_env, make_run_replay, shared_env_arguments, size_of
from composing.restoring import restore_learner
from composing.saved import trained_config
from composing.schema import WorldModelRunConfig

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.training.checkpoint import load_components
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

__all__ = [
    "Trained", "WorldModelRunConfig", "fly", "make_env", "restore", "restore_replay", "shared_env_arguments", "size_of",
]  # fmt: skip


class Trained(NamedTuple):
    """A run's settings for a CPU, its learner with trained (not averaged) weights, its checkpoint and its origin."""

    config: WorldModelRunConfig
    learner: WorldModelLearner
    checkpoint: Path
    where: dict[str, Any]


def restore(path: str) -> Trained:
    """Restore a checkpoint, or the latest checkpoint of a run directory.

    Raises:
        SystemExit: The algorithm has no world model.
    """
    checkpoint = latest_checkpoint(path)
    run = RunDirectory.of(checkpoint)
    config = trained_config(run.path)
    if not isinstance(config, WorldModelRunConfig):
        raise SystemExit(f"{checkpoint} was trained by {config.algorithm}, which has no world model.")
    config.device, config.env.device, config.replay.device = "cpu", "cpu", "auto"
    learner, counters = restore_learner(config, checkpoint, torch.device("cpu"), "trained")
    where = {
        "run": run.path.name,
        "track": config.track,
        "actor": cast(Any, config.loss).actor,
        "seed": config.seed,
        **counters,
    }
    return Trained(config, cast(WorldModelLearner, learner), checkpoint, where)


def restore_replay(trained: Trained, config: WorldModelRunConfig | None = None) -> StreamReplay:
    """Restore the replay of a checkpoint (`best/` has none), sampled as configured by the run or by ``config``."""
    config = config or trained.config
    env = make_env(replace(config, env=replace(config.env, start_on_line=0.0)), num_envs=1)  # for its specs
    curriculum = make_curriculum(config, env)
    latents = trained.learner.latent_format if config.replay.context else None
    replay = make_run_replay(config, env, curriculum, (config.model.batch_size, config.model.batch_length), latents)
    env.close()
    load_components(trained.checkpoint, {"replay": replay, "curriculum": curriculum})
    return replay


@torch.no_grad()
def fly(learner: WorldModelLearner, env: Environment, steps: int) -> TensorDict:
    """Fly the stochastic policy for K steps in N worlds; return the records, batch ``[K, N]``.

    ``belief`` and ``state`` are the latents with which the policy acted, ``action`` its clipped action, ``reward`` and
    ``done`` the results of the step, and ``vector`` the simulator's state before it, if the worlds provide it.
    """
    policy, records = learner.policy(), []
    remembering = with_memory(env, policy.make_primer())
    step = remembering.reset()
    for _ in range(steps):
        step, following = remembering.step_and_maybe_reset(policy(step))
        record = step["next"].select("belief", "state", "reward", "done").set("action", step["action"])
        if PRIVILEGED in step.keys(True):
            record["vector"] = step[PRIVILEGED]
        records.append(record.clone())
        step = following
    env.close()
    return cast(TensorDict, torch.stack(records))
