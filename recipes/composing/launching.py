"""Launch a training recipe: compose its configuration, open a session, and start or resume the run."""

import filecmp
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from composing.entry import as_override, merge_overrides, override_key, override_value, plain_errors
from composing.options import command
from composing.resolving import tune
from composing.saved import (
    OBSERVATION_SETTINGS,
    changed_settings,
    format_value,
    read_yaml,
    restore_saved_settings,
    saved_config,
    settings_of,
)
from composing.schema import RunConfig, WorldModelRunConfig, is_race
from dreamer_racing import parallel
from dreamer_racing.commands import from_here
from dreamer_racing.envs.drone.parameters import SUFFIXES
from dreamer_racing.experience.rollouts import WorkerError
from dreamer_racing.export.agents import agent_path
from dreamer_racing.export.shipped_agent import is_agent
from dreamer_racing.figures.loggers import RunLogger, make_loggers
from dreamer_racing.learners.gradient_step import NonFiniteLossError
from dreamer_racing.losses import Barlow, Image, State, Target, find_targets
from dreamer_racing.machine import git_commit, is_out_of_memory, keep_freed_memory, out_of_memory_advice
from dreamer_racing.terminal import follow_quietly, start_logging
from dreamer_racing.training.checkpoint import RunCheckpointError, newest_sound
from dreamer_racing.training.directory import PREFIX, RunDirectory, env_steps_of, latest_checkpoint, replace_text
from dreamer_racing.training.session import Session

TRAINED_ON = ("env.suite", "env.from_pixels", "env.preset", "track", "task", "decoys", "init_from", "init_behavior")
"""Settings that a resumed run cannot change, besides `OBSERVATION_SETTINGS`."""


def launch(
    config: DictConfig,
    resolve: Callable[[DictConfig], DictConfig],
    train: Callable[[Any, Session], None],
    remedy: str,
) -> None:
    """Compose the configuration of a recipe, resolve the settings that it leaves open, and train in a session.

    The remedy is what to lower once a loss is not finite, e.g. "ppo.learning_rate".
    """
    start_logging()
    threading.excepthook = print_thread_error
    torch.set_float32_matmul_precision("high")  # TF32 on CUDA; on a CPU "medium" would be bfloat16 where it has AMX
    try:
        with plain_errors():
            parallel.init()
            if not parallel.is_first():
                follow_quietly()
            config, overrides = compose_run(config)
            # All processes look before the first tidies up.
            if config.resume and parallel.all_reduce_max(int(is_finished(config))):
                print(next_steps(cast(RunConfig, config), RunDirectory(Path(config.run_dir))))
                return
            config = resolve(config)
            if config.resume and (changed := changed_settings(config)):
                print(f"resumed with other settings: {', '.join(changed)}")
            run = cast(RunConfig, OmegaConf.to_object(config))
        with training_session(run, overrides, remedy) as session:
            train(run, session)
            print(next_steps(run, session.directory))
    finally:
        parallel.destroy()


def compose_run(config: DictConfig) -> tuple[DictConfig, list[str]]:
    """Return the configuration of a new or resumed run, and the overrides that it is composed from."""
    overrides = given = list(HydraConfig.get().overrides.task)
    if config.resume:
        config, overrides, known = resumed_config(config.algorithm, config.resume, overrides)
    if config.get("tuned") == "auto":
        overrides = merge_overrides(overrides, [f"tuned={tune(config)}"])
        config = hydra.compose(str(HydraConfig.get().job.config_name), overrides)  # --config-name=, if given
    if config.resume:
        keep_trained_on(config, known, given)
    check_overrides(config, given)
    if "loss" in config:
        check_read(config, given)
    return config, overrides


def check_overrides(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a task without `env=dmc`, and settings of races with it, which would be ignored."""
    given, suite = {override_key(override): override for override in overrides}, config.env.suite
    if suite == "race" and "task" in given:
        raise ValueError(f"task={config.task} is for the Control Suite: add env=dmc, or leave it out to race.")
    if "track_description" in given:
        raise ValueError("track_description= is set by the run from its track file: give track=my_track.yaml.")
    for name, override in given.items():
        if suite != "race" and name.partition(".")[0] in ("track", "decoys", "curriculum"):
            raise ValueError(f"{override} is for races, and env.suite={suite}: leave it out.")
    if "curriculum.relabel" in given and "replay" not in config:
        raise ValueError(f"{given['curriculum.relabel']} is for recipes with a replay: leave it out.")


def check_read(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse overrides, as the user wrote them, that the chosen losses and replay do not read.

    Losses of the user's own may read all; settings from the file of a group are not refused.
    """
    targets = find_targets(config.loss.world_model)

    def have(reader: type[Target]) -> bool:
        return any(issubclass(kind, reader) or not kind.__module__.startswith("dreamer_racing.") for kind in targets)

    imagines, numbers = config.algorithm == "dreamer_v3", config.loss
    images, replayed = have(Image) and config.env.from_pixels, numbers.replay_value_scale > 0
    critic = imagines or replayed  # whether the critic of latents learns
    drift = numbers.drift_scale == 0 or (config.replay.context and not config.model.sampled)
    flat = [key for key, ramp in config.schedule.items() if isinstance(ramp, DictConfig) and ramp.to is None]
    given = {override_key(override) for override in overrides}
    for names, read, reader in (
        ("init_behavior", config.init_from is not None, "init_from="),
        ("loss.image_scale loss.image_share", images, "loss=reconstruction or informed, from images"),
        ("loss.privileged_scale", have(State), "loss=privileged or informed"),
        ("loss.barlow_scale", have(Barlow), "loss=decoder_free"),
        ("model.imagination_starts model.imagination_every", imagines, "recipes/dreamer_v3.py, which imagines"),
        ("loss.crash_weight schedule.crash_weight.to", numbers.get("continuation", True), "loss.continuation=true"),
        ("loss.drift_scale", drift, "stored latents (replay.context=true) without sampling (model.sampled=false)"),
        ("loss.replay_value_gradient", replayed, "loss.replay_value_scale above 0"),
        ("loss.slow_critic_scale model.behavior_learning_rate", critic, "loss.replay_value_scale above 0"),
        ("model.slow_critic_rate", critic and numbers.slow_critic_scale > 0, "loss.slow_critic_scale above 0"),
        ("replay.recent_records", config.replay.recent_share > 0, "replay.recent_share above 0"),
        *((f"schedule.{key}.begin schedule.{key}.end schedule.{key}.by", False, f"schedule.{key}.to") for key in flat),
        ("schedule.wait_every", config.schedule.get("wait_for_model", 0) is not None, "schedule.wait_for_model"),
    ):
        for name in names.split() if not read else ():
            if name in given and (value := OmegaConf.select(config, name)) is not None:
                raise ValueError(f"{name}={value} is for {reader}, which is not chosen: choose that, or leave it out.")


@contextmanager
def training_session(config: RunConfig, overrides: list[str], remedy: str) -> Iterator[Session]:
    """Open a session for a recipe's loop, and turn errors that prevent or end it into plain messages."""
    with plain_errors():
        session = open_session(config, overrides)
    try:
        with plain_errors(lambda: not session.began):
            if config.device == "cpu" and not keep_freed_memory():
                print("memory: this C library cannot keep freed memory for reuse; updates are slower")
            yield session
    except KeyboardInterrupt as interrupt:
        if not session.began:
            raise
        print(f"abandoned: {session.last_good}", file=sys.stderr)
        raise SystemExit(128 + next(iter(interrupt.args), signal.SIGINT)) from interrupt
    except (RunCheckpointError, WorkerError) as error:
        raise SystemExit(f"error: {error} {session.last_good[0].upper()}{session.last_good[1:]}.") from error
    except NonFiniteLossError as error:
        kept = session.directory.nonfinite_batch.with_suffix(f".{parallel.rank()}.pt" if parallel.rank() else ".pt")
        raise SystemExit(
            f"error: {error} Update {session.counters['updates']:,}, {session.env_steps:,} env_steps. "
            f"{error.save_batch(kept)}; {session.last_good}. Continue from there with a lower {remedy}."
        ) from error
    except OSError as error:  # failed writes are tolerated during the run, but not at its end
        raise SystemExit(f"error: {error}. The run is not finished: {session.last_good}.") from error
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise SystemExit(f"error: {out_of_memory_advice(error)} {session.last_good}.") from error
    finally:
        session.close()


def open_session(config: RunConfig, overrides: Sequence[str]) -> Session:
    """Check the configuration, lock the run directory, and open a session in it, unless it holds another run."""
    config.check()
    directory = config.run_directory
    lock = directory.claim() if parallel.is_first() else None
    if lock is not None and not config.resume:
        with suppress(FileNotFoundError):
            newest = latest_checkpoint(directory.checkpoints)
            lock.abandon()
            raise ValueError(
                f"run_dir={config.run_dir} holds a run already, with {newest.name}: continue it with "
                f"resume={config.run_dir}, or choose another run_dir."
            )
    note_start = partial(write_configuration, directory, config, overrides)
    return Session(config, directory, lock, note_start, partial(make_run_loggers, config, directory))


def write_configuration(directory: RunDirectory, config: RunConfig, overrides: Sequence[str], env_steps: int) -> None:
    """Write a run's configuration, also beside its best checkpoint, and its overrides; note this start."""
    for place in (directory, directory.best):
        replace_text(place.config, OmegaConf.to_yaml(OmegaConf.structured(config)))
        place.keep_drone(config.env.preset)
    kept = [override for override in overrides if not override.startswith("resume=")]
    replace_text(directory.overrides, OmegaConf.to_yaml(OmegaConf.create(kept)))
    directory.note_start(env_steps, kept, git_commit(Path(__file__).parent))


def make_run_loggers(config: RunConfig, directory: RunDirectory, resumed: int | None) -> list[RunLogger]:
    """Make a run's loggers and log its configuration; `resumed` is the env_steps of the resumed checkpoint."""
    loggers = make_loggers(directory.path, config.logger, resumed)
    plain = cast(DictConfig, OmegaConf.create(OmegaConf.to_container(OmegaConf.structured(config), enum_to_str=True)))
    for sink in loggers:
        sink.log_configuration(settings_of(plain), OmegaConf.to_yaml(plain))
    return loggers


def print_thread_error(failure: threading.ExceptHookArgs) -> None:
    """Print a thread's OSError in one line, since its waiting caller gets it too; other errors with traceback."""
    if isinstance(failure.exc_value, OSError):
        print(f"error in {failure.thread.name if failure.thread else 'a thread'}: {failure.exc_value}", file=sys.stderr)
    else:
        threading.__excepthook__(failure)


def resumed_config(algorithm: str, resume: str, overrides: list[str]) -> tuple[DictConfig, list[str], DictConfig]:
    """Return a saved run's configuration with the new overrides applied, all its overrides, and it as it was saved."""
    if is_agent(resume) or (not Path(resume).exists() and is_agent(agent_path(resume))):
        raise ValueError(f"resume={resume} is an agent, not a run to resume: start one with init_from={resume}.")
    directory = RunDirectory.of(latest_checkpoint(resume))
    if directory.run != directory:
        raise ValueError(
            f"resume={resume} holds only the networks of a run's best evaluation: set resume={directory.run.path}."
        )
    for file in (directory.config, directory.overrides):
        if not file.exists():
            raise ValueError(f"{directory.path} cannot be continued: it lacks {file.name}, which every run has.")
    run_dir, known = directory.path, saved_config(directory.path)
    if (trained_by := known.algorithm) != algorithm:
        raise ValueError(f"{run_dir} was trained by {trained_by}: continue it with recipes/{trained_by}.py.")
    for override in overrides:
        if override_key(override) == "run_dir" and Path(str(override_value(override))).absolute() != run_dir:
            raise ValueError(f"{override}: a resumed run stays in its own directory, {run_dir}. Leave it out.")
    saved = map(str, read_yaml(directory.overrides, ListConfig))
    merged = merge_overrides(merge_overrides(saved, [as_override("run_dir", run_dir)]), overrides)
    config = hydra.compose(algorithm, merged)
    restore_saved_settings(config, known, {override_key(override) for override in overrides})
    return config, merged, known


def keep_trained_on(config: DictConfig, known: DictConfig, overrides: Sequence[str]) -> None:
    """Set the track and the drone of files to what a run has kept, and refuse what it was not trained on."""
    config.track_description = known.track_description
    drone, kept, given = config.env.preset, known.env.preset, "env.preset" in map(override_key, overrides)
    if drone.endswith(SUFFIXES) and (not given or (Path(kept).is_file() and filecmp.cmp(drone, kept, shallow=False))):
        config.env.preset = kept
    for name in (*TRAINED_ON, *OBSERVATION_SETTINGS):
        trained, now = OmegaConf.select(known, name), OmegaConf.select(config, name)
        if now != trained:
            raise ValueError(
                f"{config.run_dir} was trained with {name}={format_value(trained)}, which cannot change to "
                f"{format_value(now)}: start a new run, or leave out what sets it."
            )


def is_finished(config: DictConfig) -> bool:
    """Return whether the resumed run is already complete, and print so; else it resumes from a sound checkpoint."""
    directory = RunDirectory(Path(config.run_dir))
    if directory.finished_env_steps() < config.total_env_steps:
        return False
    checkpoint = newest_sound(config.resume)
    config.resume = str(checkpoint)  # avoids a second search, and a second report of damage
    env_steps = env_steps_of(checkpoint)
    if env_steps < config.total_env_steps:
        return False
    print(f"already complete, at {env_steps:,} env_steps: set a larger total_env_steps to continue")
    return True


def next_steps(config: RunConfig, directory: RunDirectory) -> str:
    """Return lines with a finished run's best policy, latest video and latest plot, and commands to use next."""
    left = {"run": directory.path}
    if any(directory.best.checkpoints.glob(f"{PREFIX}-*")):
        left["best policy"] = directory.best.path
    if (evaluation := directory.latest_evaluation()) is not None:
        left |= {"film": directory.videos / f"{evaluation}.mp4", "plot": directory.plots / f"{evaluation}.png"}
    place, longer = from_here(directory.path), 2 * max(config.total_env_steps, directory.finished_env_steps())
    given = {name: shlex.quote(as_override(name, place)) for name in ("checkpoint", "agent", "runs", "resume")}
    moving = config.schedule.by_length if isinstance(config, WorldModelRunConfig) else []
    schedule_note = f"  # moves back the schedules that follow the run's length: {', '.join(moving)}" if moving else ""
    noisy = " start_noise=1" if is_race(config) else ""  # without noise all deterministic flights are the same
    commands = {
        "evaluate it": f"{command('evaluate')} {given['checkpoint']} episodes=100{noisy}",
        "watch it fly": f"{command('fly')} {given['agent']}" if is_race(config) else "",
        "draw it": f"{command('plot')} {given['runs']} output=figures",
        "continue": f"{command(config.algorithm)} {given['resume']} total_env_steps={longer}{schedule_note}",
    }
    files = {what: from_here(path) for what, path in left.items() if path.exists()}
    return "\n".join(f"{what + ':':<14}{words}" for what, words in {**files, **commands}.items() if words)
