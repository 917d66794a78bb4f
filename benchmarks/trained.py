"""Trained dreamer_v3 agents and their replay, brought back on a CPU for what is measured of them."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from composing.building import Environment, make_curriculum, make_env, make_run_replay, size_of, worlds_of
from composing.restoring import restore_learner
from composing.saved import trained_config
from composing.schema import WorldModelRunConfig

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.experience.replay import StreamReplay
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.modules.interface import PRIVILEGED
from dreamer_racing.training.checkpoint import load_components
from dreamer_racing.training.directory import RunDirectory, latest_checkpoint

__all__ = ["Trained", "WorldModelRunConfig", "fly", "make_env", "restore", "restore_replay", "size_of", "worlds_of"]


class Trained(NamedTuple):
    """A run's settings for a CPU, its learner with the trained weights (not the averaged ones), and where it was."""

    config: WorldModelRunConfig
    learner: WorldModelLearner
    checkpoint: Path
    where: dict[str, Any]


def restore(path: str) -> Trained:
    """Bring back the latest checkpoint of a run directory, or a checkpoint.

    Raises:
        SystemExit: It is of another algorithm.
    """
    checkpoint = latest_checkpoint(path)
    run = RunDirectory.of(checkpoint)
    config = trained_config(run.path)
    if not isinstance(config, WorldModelRunConfig):
        raise SystemExit(f"{checkpoint} was trained by {config.algorithm}, which has no world model.")
    config.device, config.replay.device = "cpu", "auto"
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
    """Bring back the replay of a checkpoint that holds one (not `best/`), sampled as the run, or `config`, does."""
    config = config or trained.config
    env = make_env(replace(config, env=replace(config.env, start_on_line=0.0)), num_envs=1)  # for what it shows
    curriculum = make_curriculum(config, env)
    latents = trained.learner.latent_format if config.replay.context else None
    replay = make_run_replay(config, env, curriculum, (config.model.batch_size, config.model.batch_length), latents)
    env.close()
    load_components(trained.checkpoint, {"replay": replay, "curriculum": curriculum})
    return replay


@torch.no_grad()
def fly(learner: WorldModelLearner, env: Environment, steps: int) -> TensorDict:
    """Fly the stochastic policy for K steps of N worlds; return what came of it, batch ``[K, N]``.

    ``belief`` and ``state`` are the latents with which it acted, ``reward`` and ``done`` what the step led to, and
    ``vector``, if the worlds tell it, the simulator's state that it acted in.
    """
    policy, records = learner.policy(), []
    remembering = with_memory(env, policy.make_primer())
    step = remembering.reset()
    for _ in range(steps):
        step, following = remembering.step_and_maybe_reset(policy(step))
        record = step["next"].select("belief", "state", "reward", "done")
        if PRIVILEGED in step.keys(True):
            record["vector"] = step[PRIVILEGED]
        records.append(record.clone())
        step = following
    env.close()
    return cast(TensorDict, torch.stack(records))
