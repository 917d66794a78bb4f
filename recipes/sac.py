"""SAC on the drone race, the paper's second baseline: collect → replay → update.

    python recipes/sac.py track=kidney
    python recipes/sac.py track=circle env.from_pixels=false
    python recipes/sac.py resume=runs/sac_kidney_20260101-120000

Everything of a run lands in its run directory, as with recipes/dreamer_v3.py.
"""

from dataclasses import dataclass
from typing import ClassVar

from composing.arena import make_env
from composing.building import (
    assemble,
    claimed,
    make_collector,
    make_curriculum,
    make_run_replay,
    resolve_baseline,
    seed_generators,
)
from composing.checks import check_sac
from composing.entry import recipe
from composing.launching import launch
from composing.learners import make_learner
from composing.schema import SACRunConfig, register
from omegaconf import DictConfig

from dreamer_racing.learners import SACLearner
from dreamer_racing.modules import Interface
from dreamer_racing.training.replay_ratio import UpdatesOwed
from dreamer_racing.training.run import ReplayRun

NUM_ENVS = {"pixels": 64, "state": 256}
TRANSITION = 2  # records of a window: what was seen before an action, and after it

register()


@dataclass(kw_only=True)
class SACRun(ReplayRun):
    """A run with a replay of transitions."""

    config: SACRunConfig
    learner: SACLearner

    remedy: ClassVar[str] = "sac.learning_rate"


@recipe("sac")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    launch(config, resolve, build)


def resolve(config: DictConfig) -> DictConfig:
    """Replace every `auto` and missing number by what it stands for, and say what was chosen."""
    return resolve_baseline(config, NUM_ENVS)


def build(config: SACRunConfig, overrides: list[str]) -> SACRun:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    check_sac(config)
    with claimed(config) as lock:
        env = make_env(config)
        learner = make_learner(config, Interface.of(env), config.device)
        seed_generators(config.seed)
        collector = make_collector(config, env, learner.policy())
        curriculum = make_curriculum(config)
        replay = make_run_replay(config, env, curriculum, config.sac.batch_size, TRANSITION)
        return assemble(
            SACRun,
            config,
            overrides,
            lock,
            env,
            learner,
            collector,
            curriculum,
            replay=replay,
            owed=UpdatesOwed(config.replay_ratio),
        )


if __name__ == "__main__":
    main()
