"""DreamerV3 on the drone race: collect → replay → update in imagination → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dreamer_v3.py env=dmc task=cartpole_swingup
    torchrun --nproc-per-node=2 recipes/dreamer_v3.py track=kidney   # processes that share worlds, replay and batch

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

from typing import cast

from composing import building
from composing.entry import recipe
from composing.launching import launch
from composing.resolving import resolve_world_model as resolve
from composing.schema import DreamerV3RunConfig
from composing.workers import make_own_env, make_rollouts, share_of
from omegaconf import DictConfig

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.evaluation.held_out import measure
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.modules import Interface
from dreamer_racing.training.schedule import Schedule
from dreamer_racing.training.session import Session


@recipe("dreamer_v3", DreamerV3RunConfig, composed=True)
def main(config: DictConfig) -> None:
    """Compose the configuration, and train."""
    launch(config, resolve, train, remedy="model.learning_rate, or model.mixed_precision=false")


def train(config: DreamerV3RunConfig, session: Session) -> None:
    """Collect, replay, update, evaluate, save."""
    own = share_of(config)  # of this process
    env = make_own_env(own)
    learner = cast(DreamerV3, building.make_learner(own, Interface.of(env), own.device, config.seed))
    if config.init_from and not config.resume:
        print(building.load_initial_weights(learner, config, env))
    building.seed_generators(own.seed)
    curriculum = building.make_curriculum(config, env)
    rollouts = make_rollouts(own, env, learner)
    latents = learner.latent_format if config.replay.context else None
    replay = building.make_run_replay(own, env, curriculum, (own.model.batch_size, own.model.batch_length), latents)
    ratio = config.make_replay_ratio()
    schedule = Schedule(config.schedule, config.scheduled, config.total_env_steps, building.num_gates(env))
    session.track(
        learner=learner,
        env=env,
        rollouts=rollouts,
        evaluator=building.make_evaluator(config, session.directory.path, learner),
        tracker=building.make_tracker(config),
        replay=replay,
        ratio=ratio,
        schedule=schedule,
        curriculum=curriculum,
        best=("schedule",),
    )

    for rollout in session.rollouts():
        # Add the rollout to the replay; a resumed run first makes the updates that are due.
        if rollout is not None:
            replay.extend(rollout)
            episodes = session.log_episodes(rollout)
            session.log(curriculum.adapt(episodes))
            session.log(schedule.observe(episodes, session.env_steps))

        # Apply the schedules, which go by the run's length or by the gates passed.
        scheduled = schedule.at(session.env_steps)
        if "start_on_line" in scheduled:
            cast(DroneRacingEnv, env).worlds.start_on_line = scheduled.pop("start_on_line")
        learner.adjust(**scheduled)

        # Update world model, actor and critic on replayed windows; later windows begin with the latents stored here.
        for _ in session.updates(ratio.updates_due(session.env_steps, learner.updates)):
            with session.timed("sample"):
                batch = replay.sample()
            session.log(learner.update(batch, session.timed))
            if config.replay.context:
                replay.refresh(batch["index"], learner.latents["belief"], learner.latents["state"])

        # Evaluate, log and save.
        if session.due("evaluate"):
            session.evaluate()
        if session.due("log"):
            session.write_row(measure(session, learner, replay, scheduled) | schedule.hardest_gate())
        session.save_if_due()


if __name__ == "__main__":
    main()
