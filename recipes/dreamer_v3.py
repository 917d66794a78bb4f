"""DreamerV3 on the drone race: collect → replay → update → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dreamer_v3.py env=dmc task=cartpole_swingup

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

import random
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import hydra
import numpy as np
import torch
from arena import (
    Environment,
    Report,
    crash_causes,
    is_race,
    learner_config,
    make_env,
    make_report,
    reward_terms,
    scene_name,
)
from checks import check, check_overrides, refuse_to_replace, updates_in
from command_line import (
    CONFIG_DIR,
    choose_device,
    computes_bfloat16,
    merge_overrides,
    new_run_dir,
    plain_errors,
    start_logging,
)
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from schema import Collection, DreamerConfig, Storage, register
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker
from tqdm import tqdm

from dreamer_racing.checkpoint import (
    BestCheckpoint,
    CollectorState,
    GracefulExit,
    RunCheckpoints,
    ensure_writable,
    latest_checkpoint,
)
from dreamer_racing.collection import OverlappedRollouts, acting_copy
from dreamer_racing.diagnostics import CONTEXT, held_out_metrics
from dreamer_racing.envs.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.partial_reset import TransformedPixelEnv
from dreamer_racing.finite_guard import NonFiniteLossError
from dreamer_racing.learner import DreamerLearner
from dreamer_racing.memory import (
    available_memory,
    check_fits,
    is_out_of_memory,
    keep_freed_memory,
    out_of_memory_advice,
)
from dreamer_racing.metrics import EpisodeTracker, MetricsLog
from dreamer_racing.modules import DreamerPolicy, Interface
from dreamer_racing.replay import StreamReplay, make_replay, replay_bytes
from dreamer_racing.timing import RunClock

HELD_OUT_WINDOWS, HELD_OUT_RECORDS = 32, 2_000  # windows measured at a time, from the newest records of a world

register()


@dataclass
class Run:
    """The parts of a run, in the order in which data flows through them."""

    config: DreamerConfig
    directory: Path
    env: Environment
    collector: Collector
    rollouts: Iterator[TensorDictBase]
    tracker: EpisodeTracker
    curriculum: BodyRateCurriculum | None
    replay: StreamReplay
    learner: DreamerLearner
    report: Report
    metrics: MetricsLog
    checkpoints: RunCheckpoints
    best: BestCheckpoint
    counters: dict[str, int]  # env_steps, updates, episodes
    clock: RunClock
    evaluated: int = -1  # updates at the last evaluation

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        return max(0, updates_in(self.config, self.counters["env_steps"]) - self.counters["updates"])

    @property
    def last_good(self) -> str:
        """Which checkpoint is left when training breaks off."""
        try:
            return f"the last good checkpoint is {latest_checkpoint(self.directory)}"
        except FileNotFoundError:
            return "there is no checkpoint yet"

    def close(self) -> None:
        """Free simulators and files."""
        if isinstance(self.rollouts, OverlappedRollouts):
            self.rollouts.close()
        self.collector.shutdown()
        self.report.close()
        self.metrics.close()


@hydra.main(version_base="1.3", config_path="config", config_name="dreamer_v3")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    start_logging()
    sys.path.append(str(Path.cwd()))  # losses of the user's own, loss.world_model=module:Class
    torch.set_float32_matmul_precision("medium")  # fp32 in effect on CPU, TF32 on CUDA
    with plain_errors():
        overrides = list(HydraConfig.get().overrides.task)
        if config.resume:
            config, overrides = resumed_config(config.resume, overrides)
        check_overrides(config, overrides)
        run = build(cast(DreamerConfig, OmegaConf.to_object(resolve(config))), overrides)
    if run.learner.device.type == "cpu" and not keep_freed_memory():
        print("memory: freed blocks go back to the system, for this C library cannot keep them; updates are slower")
    try:
        train(run)
    except NonFiniteLossError as error:
        torch.save(error.batch.to("cpu").to_dict(), run.directory / "nonfinite_batch.pt")
        raise SystemExit(
            f"error: {error} Update {run.counters['updates']:,}, {run.counters['env_steps']:,} env_steps. The batch is "
            f"kept in {run.directory / 'nonfinite_batch.pt'}; {run.last_good}. Continue from there with a lower "
            "model.learning_rate, or model.mixed_precision=false."
        ) from error
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise SystemExit(f"error: {out_of_memory_advice(error)} {run.last_good}.") from error
    finally:
        run.close()


def resumed_config(resume: str, overrides: list[str]) -> tuple[DictConfig, list[str]]:
    """The configuration of the run to continue, with the overrides given now on top."""
    run_dir = latest_checkpoint(resume).parent.parent
    saved = OmegaConf.load(run_dir / "overrides.yaml")
    merged = merge_overrides([*saved, f"run_dir={run_dir}"], overrides)
    return hydra.compose("dreamer_v3", merged), merged


def resolve(config: DictConfig) -> DictConfig:
    """Replace every `auto` and missing number by what it stands for on this machine, and say what was chosen."""
    device = choose_device(config.device)
    if config.device == "auto":
        print(f"device: {device} (device=auto)")
    size = config.model.size
    if size == "auto":
        size = "size12m" if device.type == "cuda" else "cpu_small"
        print(f"model: {size} (model=auto on {device.type})")
    config.device, config.model.size = str(device), size
    if config.env.device == "auto":
        config.env.device = worlds_device(config)
        print(f"worlds: {config.env.device} (env.device=auto)")
    numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{size}.yaml")
    for name in config.model:
        if OmegaConf.is_missing(config.model, name):
            config.model[name] = numbers[name]
    if config.model.mixed_precision is None:
        config.model.mixed_precision = computes_bfloat16(device)
        state, ability = ("on", "computes") if config.model.mixed_precision else ("off", "does not compute")
        print(f"mixed precision: {state}, this {device.type} device {ability} in bfloat16")
    if config.run_dir is None:
        config.run_dir = str(new_run_dir("dreamer_v3", scene_name(cast(DreamerConfig, config))))
    if config.env.num_envs == 1 and config.replay.held_out:
        print("held out: nothing, because there is a single world (replay.held_out=0)")
        config.replay.held_out = 0
    return config


def worlds_device(config: DictConfig) -> str:
    """The device for the worlds to train in: the learner's, where they have a simulator and the renderer asked for."""
    on_cuda = torch.device(config.device).type == "cuda"
    fits = config.env.suite == "race" and config.env.renderer in ("auto", "warp")
    return str(config.device) if on_cuda and fits else "cpu"


def build(config: DreamerConfig, overrides: list[str]) -> Run:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    assert config.run_dir is not None, "resolve() names it"
    check(config)
    refuse_to_replace(config)
    directory = ensure_writable(config.run_dir)
    env = make_env(config)
    interface = Interface.of(env)
    learner = DreamerLearner(config.model.size, interface, learner_config(config), config.device, config.seed)
    seed_generators(config.seed)
    policy = learner.policy()
    overlapped = config.collection is Collection.overlapped
    acting = acting_copy(policy) if overlapped else policy
    collector = make_collector(config, env, acting)
    curriculum = make_curriculum(config)
    replay = make_run_replay(config, env, interface, curriculum)
    tracker = EpisodeTracker(config.env.num_envs, crash_causes(config))
    counters = {"env_steps": 0, "updates": 0, "episodes": 0}
    parts = {"learner": learner, "replay": replay, "counters": counters, "env": env, "tracker": tracker}
    parts |= {"collector": CollectorState(collector)} | ({"curriculum": curriculum} if curriculum else {})
    checkpoints = RunCheckpoints(directory, parts, config.checkpoint.keep)
    if config.resume:
        checkpoints.load(config.resume)
        print(f"resumed {config.resume} at {counters['env_steps']:,} env_steps, {counters['updates']:,} updates")
    best = BestCheckpoint(directory, {"learner": learner, "counters": counters})
    for folder in (directory, best.directory):
        OmegaConf.save(OmegaConf.structured(config), folder / "config.yaml")
    OmegaConf.save(
        OmegaConf.create([o for o in overrides if not o.startswith("resume=")]), directory / "overrides.yaml"
    )
    metrics = MetricsLog(
        directory,
        tensorboard=config.logger.tensorboard,
        resume_env_steps=counters["env_steps"] if config.resume else None,
    )
    print(f"run directory: {directory}")
    return Run(
        config=config,
        directory=directory,
        env=env,
        collector=collector,
        rollouts=OverlappedRollouts(collector, acting, policy) if overlapped else iter(collector),
        tracker=tracker,
        curriculum=curriculum,
        replay=replay,
        learner=learner,
        report=make_report(config, directory, learner, config.evaluation.episodes, config.evaluation.video_steps),
        metrics=metrics,
        checkpoints=checkpoints,
        best=best,
        counters=counters,
        clock=RunClock(counters),
    )


def seed_generators(seed: int) -> None:
    """Seed all global generators, of which torch's samples actions and latents."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what libraries draw from
    torch.manual_seed(seed)


def make_collector(config: DreamerConfig, env: Environment, policy: DreamerPolicy) -> Collector:
    """Make the collector of rollouts [num_envs, rollout_steps], on the worlds' device."""
    return Collector(
        TransformedPixelEnv(env, Compose(InitTracker(), policy.make_primer())),
        policy,
        frames_per_batch=config.env.num_envs * config.rollout_steps,
        total_frames=-1,
        env_device=env.device,
        policy_device=config.device,
        storing_device=env.device,
        track_traj_ids=False,
        no_cuda_sync=False,
    )


def make_curriculum(config: DreamerConfig) -> BodyRateCurriculum | None:
    """Make the schedule of the race's body-rate penalty; other suites have none."""
    if not is_race(config):
        return None
    settings = asdict(config.curriculum)
    del settings["relabel"]
    return BodyRateCurriculum(**settings)


def make_run_replay(
    config: DreamerConfig, env: Environment, interface: Interface, curriculum: BodyRateCurriculum | None
) -> StreamReplay:
    """Make the replay, on the learner's device if it has room there; say where and how large."""
    settings = config.replay
    numbers = interface.vector_dim + interface.privileged_dim
    image = interface.image_shape if interface.pixels else (0,)
    size = replay_bytes(settings.capacity, image, interface.action_dim, numbers)
    storage_device = settings.device
    if storage_device == "auto":
        on_learner = config.device != "cpu" and size < 0.5 * available_memory(config.device)
        storage_device = config.device if on_learner else "cpu"
    where = storage_device if settings.storage is Storage.tensor else "files"
    if settings.storage is Storage.tensor:
        check_fits(size, storage_device, f"replay.capacity={settings.capacity:,}")
    print(f"replay: {settings.capacity:,} records, {size / 1e9:.1f} GB when full, in memory of {where}")
    return make_replay(
        settings.capacity,
        config.env.num_envs,
        config.model.batch_size,
        config.model.batch_length,
        config.device,
        storage=settings.storage.value,
        storage_device=storage_device,
        seed=config.seed,
        transform=RelabelReward(curriculum) if curriculum and config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
        reward_keys=reward_terms(env),
        recent_share=settings.recent_share,
        recent_records=settings.recent_records,
        held_out=settings.held_out,
        prefetch=2 if config.device != "cpu" and storage_device == "cpu" else None,
    )


def train(run: Run) -> None:
    """Collect and learn until `total_env_steps` or a signal; log, evaluate and save on the way."""
    config, counters = run.config, run.counters
    schedule = Schedule(
        counters["env_steps"], log=config.logger.every, evaluate=config.evaluation.every, save=config.checkpoint.every
    )
    with (
        GracefulExit() as stop,
        tqdm(total=config.total_env_steps, initial=counters["env_steps"], unit="step", dynamic_ncols=True) as bar,
    ):
        if counters["env_steps"] >= config.total_env_steps:
            bar.write(f"complete already: raise total_env_steps={config.total_env_steps} to go on")
        learn(run, stop)  # what a signal left undone
        while counters["env_steps"] < config.total_env_steps and not stop.requested:
            with run.clock.timed("collect"):
                take_in(run, next(run.rollouts))
            bar.update(counters["env_steps"] - bar.n)
            learn(run, stop)
            if stop.signal_name:
                break
            if schedule.due("log", counters["env_steps"]):
                measure(run)
                show(bar, run.metrics.write(counters["env_steps"]))
            if schedule.due("evaluate", counters["env_steps"]):
                evaluate(run)
            if schedule.due("save", counters["env_steps"]):
                save(run)
        if stop.requested:
            bar.write(f"{stop.signal_name}: saving; continue with resume={run.directory}")
        saved = save(run)
        if not stop.requested and config.evaluation.every and run.evaluated != counters["updates"]:
            evaluate(run)
        run.metrics.write(counters["env_steps"])
        bar.write(f"checkpoint: {saved}")


def take_in(run: Run, rollout: TensorDictBase) -> None:
    """Store a rollout, account for the episodes that ended in it, and let the curriculum set the b₂ of what comes."""
    run.replay.extend(rollout)
    run.counters["env_steps"] += rollout.numel()
    episodes = run.tracker.update(rollout)
    run.counters["episodes"] += len(episodes)
    run.metrics.push(run.tracker.summary(episodes))
    if run.curriculum:
        run.env.body_rate_weight = run.curriculum.update(episodes["return"])
        run.metrics.push({"curriculum/body_rate_weight": run.env.body_rate_weight})


def learn(run: Run, stop: GracefulExit) -> None:
    """Make the updates that are due."""
    for _ in range(run.updates_due):
        if stop.requested:
            return
        with run.clock.timed("sample"):
            batch = run.replay.sample()
        run.metrics.push(run.learner.update(batch, run.clock.timed))
        run.counters["updates"] += 1


def measure(run: Run) -> None:
    """Take the clock's readings, and the world model's errors on records that are never trained on."""
    run.metrics.push(run.clock.read())
    windows = run.replay.held_out(HELD_OUT_WINDOWS, CONTEXT + run.config.model.imagination_horizon, HELD_OUT_RECORDS)
    if windows is not None and run.counters["updates"]:
        run.metrics.push(held_out_metrics(run.learner, windows))


def save(run: Run) -> Path:
    """Save everything, unless the networks have just been spoilt."""
    run.learner.check_finite()
    if isinstance(run.rollouts, OverlappedRollouts) and (rollout := run.rollouts.drain()) is not None:
        take_in(run, rollout)
    return run.checkpoints.save(run.counters["env_steps"])


def evaluate(run: Run) -> None:
    """Evaluate, without a trace in the random numbers of training."""
    devices = [run.learner.device] if run.learner.device.type == "cuda" else []
    with run.clock.timed("evaluate"), torch.random.fork_rng(devices=devices):
        metrics = run.report.make(run.counters["env_steps"], run.config.evaluation.stochastic)
    run.metrics.push(metrics)
    run.evaluated = run.counters["updates"]
    # Gates first, return where the gates are the same: a return lies far below a million.
    score = 1e6 * metrics.get("evaluation/gates_per_episode", 0.0) + metrics["evaluation/return_mean"]
    run.best.offer(score, run.counters["env_steps"])


def show(bar: tqdm, row: dict[str, float]) -> None:
    """Put the latest numbers behind the progress bar."""
    shown = {"return": "episode/return", "gates": "episode/gates_passed", "updates/s": "rate/updates"}
    bar.set_postfix({label: f"{row[key]:.2f}" for label, key in shown.items() if key in row})


class Schedule:
    """Says when something that happens every so many env_steps is due."""

    def __init__(self, env_steps: int, **every: int) -> None:
        self._every = every
        self._done = {name: env_steps // period if period else 0 for name, period in every.items()}

    def due(self, name: str, env_steps: int) -> bool:
        """Whether another period has passed; asking takes note of it."""
        period = self._every[name]
        if not period or env_steps // period <= self._done[name]:
            return False
        self._done[name] = env_steps // period
        return True


if __name__ == "__main__":
    main()
