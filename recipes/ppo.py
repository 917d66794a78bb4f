"""PPO on the drone race, the paper's first baseline: collect a rollout → advantages → epochs of gradient steps.

    python recipes/ppo.py track=kidney
    python recipes/ppo.py track=circle env.from_pixels=false
    python recipes/ppo.py resume=runs/ppo_kidney_20260101-120000

Everything of a run lands in its run directory, as with recipes/dreamer_v3.py.
"""

from functools import partial
from typing import cast

from composing import building
from composing.entry import recipe
from composing.launching import launch
from composing.resolving import resolve_baseline
from composing.schema import PPORunConfig
from omegaconf import DictConfig

from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.learners import PPOLearner
from dreamer_racing.modules import Interface
from dreamer_racing.training.session import Session

resolve = partial(resolve_baseline, num_envs={"pixels": 64, "state": 1024})


@recipe("ppo", PPORunConfig, composed=True)
def main(config: DictConfig) -> None:
    """Compose the configuration, and train."""
    launch(config, resolve, train, remedy="ppo.learning_rate")


def train(config: PPORunConfig, session: Session) -> None:
    """Collect, update, evaluate, save."""
    env = building.make_env(config)
    learner = cast(PPOLearner, building.make_learner(config, Interface.of(env), config.device))
    building.seed_generators(config.seed)
    rollouts = Rollouts(building.make_collector(config, env, learner.policy()))
    curriculum = building.make_curriculum(config, env)
    session.track(
        learner=learner,
        env=env,
        rollouts=rollouts,
        evaluator=building.make_evaluator(config, session.directory.path, learner),
        tracker=building.make_tracker(config),
        curriculum=curriculum,
    )

    for rollout in session.rollouts():
        if rollout is not None:
            # Every rollout is trained on for some epochs, then discarded.
            session.log(curriculum.adapt(session.log_episodes(rollout)))
            session.log(learner.update(rollout, session.timed))
            session.counters["updates"] = learner.updates
        if session.due("evaluate"):
            session.evaluate()
        if session.due("log"):
            session.write_row()
        session.save_if_due()


if __name__ == "__main__":
    main()
