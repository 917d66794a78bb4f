"""DreamerV3 on the drone race: collect → replay → update → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from command_line import CONFIG_DIR, choose_device, merge_overrides, new_run_dir, plain_errors, start_logging
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from schema import DreamerConfig, register
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv
from tqdm import tqdm

from dreamer_racing.checkpoint import GracefulExit, RunCheckpoints, ensure_writable, latest_checkpoint
from dreamer_racing.envs.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.envs.gates import CrashCause
from dreamer_racing.envs.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.learner import DreamerLearner, LearnerConfig
from dreamer_racing.losses import WORLD_MODEL_LOSSES, find_loss
from dreamer_racing.metrics import EpisodeTracker, MetricsLog
from dreamer_racing.modules import Interface
from dreamer_racing.replay import StreamReplay, make_replay, replay_bytes
from dreamer_racing.reporting import EvaluationReport
from dreamer_racing.timing import RunClock

register()


@dataclass
class Run:
    """The parts of a run, in the order in which data flows through them."""

    config: DreamerConfig
    directory: Path
    env: DroneRacingEnv
    collector: Collector
    tracker: EpisodeTracker
    curriculum: BodyRateCurriculum
    replay: StreamReplay
    learner: DreamerLearner
    report: EvaluationReport
    metrics: MetricsLog
    checkpoints: RunCheckpoints
    counters: dict[str, int]  # env_steps, updates, episodes
    clock: RunClock

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        model, steps = self.config.model, self.counters["env_steps"] - self.config.prefill
        per_step = model.replay_ratio / (model.batch_size * model.batch_length)
        return max(0, int(steps * per_step) - self.counters["updates"])

    def close(self) -> None:
        """Free simulators and files."""
        self.collector.shutdown()
        self.report.close()
        self.metrics.close()


@hydra.main(version_base="1.3", config_path="config", config_name="dreamer_v3")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    start_logging()
    torch.set_float32_matmul_precision("medium")  # fp32 in effect on CPU, TF32 on CUDA
    with plain_errors():
        overrides = list(HydraConfig.get().overrides.task)
        if config.resume:
            config, overrides = resumed_config(config.resume, overrides)
        run = build(cast(DreamerConfig, OmegaConf.to_object(resolve(config))), overrides)
    try:
        train(run)
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
    numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{size}.yaml")
    for name in config.model:
        if OmegaConf.is_missing(config.model, name):
            config.model[name] = numbers[name]
    if config.run_dir is None:
        config.run_dir = str(new_run_dir("dreamer_v3", config.track))
    return config


def build(config: DreamerConfig, overrides: list[str]) -> Run:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    assert config.run_dir is not None, "resolve() names it"
    directory = ensure_writable(config.run_dir)
    worlds: dict[str, Any] = {
        "track": config.track,
        "preset": config.env.preset,
        "renderer": config.env.renderer,
        "camera": Camera(tilt=config.env.camera_tilt),
    }
    env = DroneRacingEnv(
        num_envs=config.env.num_envs,
        episode_steps=config.env.episode_steps,
        from_pixels=config.env.from_pixels,
        privileged=find_loss(WORLD_MODEL_LOSSES, config.loss.world_model).reads_privileged,
        seed=config.seed,
        **worlds,
    )
    interface = Interface.of(env)
    learner = DreamerLearner(config.model.size, interface, learner_config(config), config.device, config.seed)
    torch.manual_seed(config.seed)
    policy = learner.policy()
    collector = Collector(
        TransformedEnv(env, Compose(InitTracker(), policy.make_primer())),
        policy,
        frames_per_batch=config.env.num_envs * config.rollout_steps,
        total_frames=-1,
        env_device="cpu",
        policy_device=config.device,
        storing_device="cpu",
        no_cuda_sync=False,
    )
    curriculum = BodyRateCurriculum(
        **{name: value for name, value in asdict(config.curriculum).items() if name != "relabel"}
    )
    replay = make_replay(
        config.replay.capacity,
        config.env.num_envs,
        config.model.batch_size,
        config.model.batch_length,
        config.device,
        storage=config.replay.storage.value,
        storage_device="cpu",
        seed=config.seed,
        transform=RelabelReward(curriculum) if config.curriculum.relabel else None,
        observation_keys=interface.replay_keys,
    )
    print(f"replay: {config.replay.capacity:,} records, {replay_bytes(config.replay.capacity) / 1e9:.1f} GB when full")
    tracker = EpisodeTracker(config.env.num_envs, CrashCause)
    counters = {"env_steps": 0, "updates": 0, "episodes": 0}
    checkpoints = RunCheckpoints(
        directory,
        {"learner": learner, "replay": replay, "curriculum": curriculum, "counters": counters},
        config.checkpoint.keep,
    )
    if config.resume:
        checkpoints.load(config.resume)
        env.set_seed(config.seed + counters["env_steps"])
        print(f"resumed {config.resume} at {counters['env_steps']:,} env_steps, {counters['updates']:,} updates")
    OmegaConf.save(OmegaConf.structured(config), directory / "config.yaml")
    OmegaConf.save(
        OmegaConf.create([o for o in overrides if not o.startswith("resume=")]), directory / "overrides.yaml"
    )
    report = EvaluationReport(directory, learner, worlds, config.evaluation.episodes, config.evaluation.video_steps)
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
        tracker=tracker,
        curriculum=curriculum,
        replay=replay,
        learner=learner,
        report=report,
        metrics=metrics,
        checkpoints=checkpoints,
        counters=counters,
        clock=RunClock(counters),
    )


def learner_config(config: DreamerConfig) -> LearnerConfig:
    """The learner's numbers from the groups `model` and `loss`."""
    model, loss = config.model, asdict(config.loss)
    names = {name: loss.pop(name) for name in ("world_model", "actor", "critic")}
    return LearnerConfig(
        batch_size=model.batch_size,
        batch_length=model.batch_length,
        imagination_horizon=model.imagination_horizon,
        imagination_starts=model.imagination_starts,
        lr=model.learning_rate,
        behavior_lr=model.behavior_learning_rate,
        warmup_updates=model.warmup_updates,
        **{f"{part}_loss": name for part, name in names.items()},
        **loss,
    )


def train(run: Run) -> None:
    """Collect and learn until `total_env_steps` or a signal; log, evaluate and save on the way."""
    config, counters = run.config, run.counters
    schedule = Schedule(
        counters["env_steps"], log=config.logger.every, evaluate=config.evaluation.every, save=config.checkpoint.every
    )
    run.env.body_rate_weight = run.curriculum.body_rate_weight
    collected = iter(run.collector)
    with (
        GracefulExit() as stop,
        tqdm(total=config.total_env_steps, initial=counters["env_steps"], unit="step", dynamic_ncols=True) as bar,
    ):
        while counters["env_steps"] < config.total_env_steps and not stop.requested:
            with run.clock.timed("collect"):
                rollout = next(collected)
                run.replay.extend(rollout)
            counters["env_steps"] += rollout.numel()
            bar.update(rollout.numel())
            finish_episodes(run, rollout)
            with run.clock.timed("update"):
                learn(run, stop)
            if schedule.due("log", counters["env_steps"]):
                run.metrics.push(run.clock.read())
                show(bar, run.metrics.write(counters["env_steps"]))
            if schedule.due("evaluate", counters["env_steps"]):
                with run.clock.timed("evaluate"):
                    run.metrics.push(run.report.make(counters["env_steps"], config.evaluation.stochastic))
            if schedule.due("save", counters["env_steps"]):
                run.checkpoints.save(counters["env_steps"])
        if stop.requested:
            bar.write(f"{stop.signal_name}: saving; continue with resume={run.directory}")
        saved = run.checkpoints.save(counters["env_steps"])
        if not stop.requested and config.evaluation.every:
            run.metrics.push(run.report.make(counters["env_steps"], config.evaluation.stochastic))
        run.metrics.write(counters["env_steps"])
        bar.write(f"checkpoint: {saved}")


def finish_episodes(run: Run, rollout: Any) -> None:
    """Account for the episodes that ended in a rollout; let the curriculum set the b₂ of the steps to come."""
    episodes = run.tracker.update(rollout)
    run.counters["episodes"] += len(episodes)
    run.env.body_rate_weight = run.curriculum.update(episodes["return"])
    run.metrics.push({**run.tracker.summary(episodes), "curriculum/body_rate_weight": run.env.body_rate_weight})


def learn(run: Run, stop: GracefulExit) -> None:
    """Make the updates that are due."""
    for _ in range(run.updates_due):
        if stop.requested:
            return
        run.metrics.push(run.learner.update(run.replay.sample()))
        run.counters["updates"] += 1


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
