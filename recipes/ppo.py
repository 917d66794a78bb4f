"""PPO on the drone race, the paper's first baseline: collect a rollout → advantages → epochs of gradient steps.

    python recipes/ppo.py track=kidney
    python recipes/ppo.py track=circle env.from_pixels=false
    python recipes/ppo.py resume=runs/ppo_kidney_20260101-120000

Everything of a run lands in its run directory, as with recipes/dreamer_v3.py.
"""

from dataclasses import dataclass
from typing import ClassVar

from composing.arena import make_env
from composing.building import assemble, claimed, make_collector, make_curriculum, resolve_baseline, seed_generators
from composing.checks import check_ppo
from composing.entry import recipe
from composing.launching import launch
from composing.learners import make_learner
from composing.schema import PPORunConfig, register
from omegaconf import DictConfig
from tensordict import TensorDictBase

from dreamer_racing.learners import PPOLearner
from dreamer_racing.modules import Interface
from dreamer_racing.training.run import Run
from dreamer_racing.training.signals import GracefulExit

NUM_ENVS = {"pixels": 64, "state": 1024}

register()


@dataclass(kw_only=True)
class PPORun(Run):
    """A run that learns from every rollout once, and forgets it."""

    config: PPORunConfig
    learner: PPOLearner

    remedy: ClassVar[str] = "ppo.learning_rate"

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Make the epochs of a rollout."""
        if rollout is None:
            return
        self.metrics.push(self.learner.update(rollout, self.clock.timed))
        self.counters["updates"] = self.learner.updates


@recipe("ppo")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    launch(config, resolve, build)


def resolve(config: DictConfig) -> DictConfig:
    """Replace every `auto` and missing number by what it stands for, and say what was chosen."""
    return resolve_baseline(config, NUM_ENVS)


def build(config: PPORunConfig, overrides: list[str]) -> PPORun:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    check_ppo(config)
    with claimed(config) as lock:
        env = make_env(config)
        learner = make_learner(config, Interface.of(env), config.device)
        seed_generators(config.seed)
        collector = make_collector(config, env, learner.policy())
        return assemble(PPORun, config, overrides, lock, env, learner, collector, make_curriculum(config))


if __name__ == "__main__":
    main()
