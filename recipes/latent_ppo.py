"""Recurrent PPO in a world model's latents: collect → replay → update the model → update the actor → evaluate.

    python recipes/latent_ppo.py track=kidney
    python recipes/latent_ppo.py track=circle tuned=images           # no network sees the simulator's state in training
    python recipes/latent_ppo.py track=figure8 env=faithful loss.critic=latent
    python recipes/latent_ppo.py resume=runs/latent_ppo_kidney_20260101-120000
    torchrun --nproc-per-node=2 recipes/latent_ppo.py track=kidney   # processes that share worlds, replay and batch

Everything of a run lands in its run directory, as with recipes/dreamer_v3.py.
"""

from typing import Any, cast

from composing import building
from composing.entry import recipe
from composing.launching import launch
from composing.resolving import resolve_world_model as resolve
from composing.schema import LatentPPORunConfig
from composing.workers import make_own_env, make_rollouts, share_of
from omegaconf import DictConfig

from dreamer_racing import parallel
from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.evaluation.held_out import measure, measure_lag
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.modules import Interface
from dreamer_racing.training.schedule import ModelLag, Schedule
from dreamer_racing.training.session import Session

REMEDY = "model.learning_rate (of an actor's update loss.ppo.learning_rate), or model.mixed_precision=false"


@recipe("latent_ppo", LatentPPORunConfig, composed=True)
def main(config: DictConfig) -> None:
    """Compose the configuration, and train."""
    launch(config, resolve, train, remedy=REMEDY)


def train(config: LatentPPORunConfig, session: Session) -> None:
    """Collect, replay, update, evaluate, save."""
    own = share_of(config)  # of this process
    env = make_own_env(own)
    learner = cast(LatentPPO, building.make_learner(own, Interface.of(env), own.device, config.seed))
    if config.init_from and not config.resume:
        print(building.load_initial_weights(learner, config, env))
    building.seed_generators(own.seed)
    curriculum = building.make_curriculum(config, env)
    rollouts = make_rollouts(own, env, learner)
    latents = learner.latent_format if config.replay.context else None
    replay = building.make_run_replay(own, env, curriculum, (own.model.batch_size, own.model.batch_length), latents)
    ratio = config.make_replay_ratio()
    schedule = Schedule(config.schedule, config.scheduled, config.total_env_steps, building.num_gates(env))
    lag = ModelLag(config.schedule.wait_for_model, config.schedule.wait_every)
    own_parts: dict[str, Any] = {} if parallel.is_first() else {"storage": learner.storage}  # rank 0: by the learner
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
        lag=lag,
        best=("schedule",),
        **own_parts,
    )

    for rollout in session.rollouts():
        # Add the rollout to the replay and to the actor's storage; a resumed run first makes the updates that are due.
        if rollout is not None:
            replay.extend(rollout)
            learner.collect(rollout)
            episodes = session.log_episodes(rollout)
            session.log(curriculum.adapt(episodes))
            session.log(schedule.observe(episodes, session.env_steps))

        # Apply the schedules; the actor waits while the model's error on the newest records is too large.
        if lag.due(session.env_steps) and session.counters["updates"]:
            session.log(measure_lag(session, learner, replay, lag, config.newest_records))
        scheduled = schedule.at(session.env_steps)
        if "start_on_line" in scheduled:
            cast(DroneRacingEnv, env).worlds.start_on_line = scheduled.pop("start_on_line")
        learner.adjust(**scheduled)
        learner.actor_waits = lag.waits

        # Update the world model on replayed windows, and actor and critic once enough is collected.
        for _ in session.updates(ratio.updates_due(session.env_steps, learner.updates)):
            with session.timed("sample"):
                batch = replay.sample()
            metrics = learner.update(batch, session.timed)
            session.log(metrics)
            lag.add_training_error(metrics)
            if config.replay.context:  # later windows begin with these latents
                replay.refresh(batch["index"], learner.latents["belief"], learner.latents["state"])

        # Evaluate, log and save.
        if session.due("evaluate"):
            session.evaluate()
        if session.due("log"):
            session.write_row(measure(session, learner, replay, scheduled) | schedule.hardest_gate())
        session.save_if_due()


if __name__ == "__main__":
    main()
