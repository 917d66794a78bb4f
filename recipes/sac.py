"""SAC on the drone race, the paper's second baseline: collect → replay → update.

    python recipes/sac.py track=kidney
    python recipes/sac.py track=circle env.from_pixels=false
    python recipes/sac.py resume=runs/sac_kidney_20260101-120000

Everything of a run lands in its run directory, as with recipes/dreamer_v3.py.
"""

from functools import partial
from typing import cast

from composing import building
from composing.entry import recipe
from composing.launching import launch
from composing.resolving import resolve_baseline
from composing.schema import SACRunConfig
from omegaconf import DictConfig

from dreamer_racing.experience.rollouts import Rollouts
from dreamer_racing.learners import SACLearner
from dreamer_racing.modules import Interface
from dreamer_racing.training.session import Session

resolve = partial(resolve_baseline, num_envs={"pixels": 64, "state": 256})
TRANSITION = 2  # records of a window: before and after an action


@recipe("sac", SACRunConfig, composed=True)
def main(config: DictConfig) -> None:
    """Compose the configuration, and train."""
    launch(config, resolve, train, remedy="sac.learning_rate")


def train(config: SACRunConfig, session: Session) -> None:
    """Collect, replay, update, evaluate, save."""
    env = building.make_env(config)
    learner = cast(SACLearner, building.make_learner(config, Interface.of(env), config.device))
    building.seed_generators(config.seed)
    rollouts = Rollouts(building.make_collector(config, env, learner.policy()))
    curriculum = building.make_curriculum(config, env)
    replay = building.make_run_replay(config, env, curriculum, (config.sac.batch_size, TRANSITION))
    ratio = config.make_replay_ratio()
    session.track(
        learner=learner,
        env=env,
        rollouts=rollouts,
        evaluator=building.make_evaluator(config, session.directory.path, learner),
        tracker=building.make_tracker(config),
        replay=replay,
        ratio=ratio,
        curriculum=curriculum,
    )

    for rollout in session.rollouts():
        if rollout is not None:
            replay.extend(rollout)
            session.log(curriculum.adapt(session.log_episodes(rollout)))
        for _ in session.updates(ratio.updates_due(session.env_steps, learner.updates)):
            with session.timed("sample"):
                batch = replay.sample()
            session.log(learner.update(batch, session.timed))
        if session.due("evaluate"):
            session.evaluate()
        if session.due("log"):
            session.write_row()
        session.save_if_due()


if __name__ == "__main__":
    main()
