"""DreamerV3 on the drone race: collect → replay → update → evaluate.

    python recipes/dreamer_v3.py track=kidney
    python recipes/dreamer_v3.py track=figure8 env=faithful model=size12m total_env_steps=2000000
    python recipes/dreamer_v3.py resume=runs/dreamer_v3_kidney_20260101-120000
    python recipes/dreamer_v3.py env=dmc task=cartpole_swingup

Everything of a run lands in its run directory: checkpoints/, metrics.csv, tensorboard/, videos/, plots/, config.yaml.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import hydra
from arena import Environment, learner_config, make_env, reward_terms
from checks import check_dreamer, updates_in
from command_line import CONFIG_DIR, computes_bfloat16
from omegaconf import DictConfig, OmegaConf
from schema import Collection, DreamerConfig, Storage, register
from tensordict import TensorDictBase
from training import (
    Run,
    assemble,
    launch,
    make_collector,
    make_curriculum,
    resolve_common,
    seed_generators,
)

from dreamer_racing.checkpoint import GracefulExit
from dreamer_racing.collection import OverlappedRollouts, acting_copy
from dreamer_racing.diagnostics import CONTEXT, held_out_metrics
from dreamer_racing.envs.curriculum import BodyRateCurriculum, RelabelReward
from dreamer_racing.learner import DreamerLearner
from dreamer_racing.memory import available_memory, check_fits
from dreamer_racing.modules import Interface
from dreamer_racing.replay import StreamReplay, make_replay, replay_bytes

NUM_ENVS = 32
HELD_OUT_WINDOWS, HELD_OUT_RECORDS = 32, 2_000  # windows measured at a time, from the newest records of a world

register()


@dataclass(kw_only=True)
class DreamerRun(Run):
    """A run with a replay of sequences, whose learner makes updates by the replay ratio."""

    config: DreamerConfig
    learner: DreamerLearner
    replay: StreamReplay

    remedy: ClassVar[str] = "model.learning_rate, or model.mixed_precision=false"

    @property
    def updates_due(self) -> int:
        """Updates that the replay ratio still owes for the environment steps made since the prefill."""
        return max(0, updates_in(self.config, self.counters["env_steps"]) - self.counters["updates"])

    def take_in(self, rollout: TensorDictBase) -> None:
        """Store a rollout too."""
        self.replay.extend(rollout)
        super().take_in(rollout)

    def learn(self, rollout: TensorDictBase | None, stop: GracefulExit) -> None:
        """Make the updates that are due."""
        for _ in range(self.updates_due):
            if stop.requested:
                return
            with self.clock.timed("sample"):
                batch = self.replay.sample()
            self.metrics.push(self.learner.update(batch, self.clock.timed))
            self.counters["updates"] += 1

    def measure(self) -> None:
        """Measure the world model's errors on records that are never trained on, too."""
        super().measure()
        length = CONTEXT + self.config.model.imagination_horizon
        windows = self.replay.held_out(HELD_OUT_WINDOWS, length, HELD_OUT_RECORDS)
        if windows is not None and self.counters["updates"]:
            self.metrics.push(held_out_metrics(self.learner, windows))

    def save(self) -> Path:
        """Take in the rollout that is under way, if there is one, and save."""
        if isinstance(self.rollouts, OverlappedRollouts) and (rollout := self.rollouts.drain()) is not None:
            self.take_in(rollout)
        return super().save()

    def close(self) -> None:
        """End the thread that collects, if there is one."""
        if isinstance(self.rollouts, OverlappedRollouts):
            self.rollouts.close()
        super().close()


@hydra.main(version_base="1.3", config_path="config", config_name="dreamer_v3")
def main(config: DictConfig) -> None:
    """Compose the configuration, build the run, train."""
    launch(config, resolve, build)


def resolve(config: DictConfig) -> DictConfig:
    """Replace every `auto` and missing number by what it stands for on this machine, and say what was chosen."""
    device = resolve_common(config, NUM_ENVS)
    size = config.model.size
    if size == "auto":
        size = "size12m" if device.type == "cuda" else "cpu_small"
        print(f"model: {size} (model=auto on {device.type})")
    config.model.size = size
    numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{size}.yaml")
    for name in config.model:
        if OmegaConf.is_missing(config.model, name):
            config.model[name] = numbers[name]
    if config.model.mixed_precision is None:
        config.model.mixed_precision = computes_bfloat16(device)
        state, ability = ("on", "computes") if config.model.mixed_precision else ("off", "does not compute")
        print(f"mixed precision: {state}, this {device.type} device {ability} in bfloat16")
    if config.env.num_envs == 1 and config.replay.held_out:
        print("held out: nothing, because there is a single world (replay.held_out=0)")
        config.replay.held_out = 0
    return config


def build(config: DreamerConfig, overrides: list[str]) -> DreamerRun:
    """Make all parts of the run, restored from a checkpoint if it continues one."""
    check_dreamer(config)
    env = make_env(config)
    interface = Interface.of(env)
    learner = DreamerLearner(config.model.size, interface, learner_config(config), config.device, config.seed)
    seed_generators(config.seed)
    policy = learner.policy()
    overlapped = config.collection is Collection.overlapped
    acting = acting_copy(policy) if overlapped else policy
    collector = make_collector(config, env, acting)
    curriculum = make_curriculum(config)
    return assemble(
        DreamerRun,
        config,
        overrides,
        env,
        learner,
        collector,
        curriculum,
        OverlappedRollouts(collector, acting, policy) if overlapped else None,
        replay=make_run_replay(config, env, interface, curriculum),
    )


def make_run_replay(
    config: DreamerConfig, env: Environment, interface: Interface, curriculum: BodyRateCurriculum | None
) -> StreamReplay:
    """Make the replay, on the learner's device if it has room there; say where and how large."""
    settings = config.replay
    numbers = interface.vector_dim + interface.privileged_dim
    image = (64, 64, 3) if interface.pixels else (0,)
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


if __name__ == "__main__":
    main()
