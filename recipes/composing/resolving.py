"""Fill in the settings that a configuration leaves open, for this machine, and print the choices."""

import math
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from itertools import takewhile
from pathlib import Path
from typing import cast

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from composing.building import serialize_track_file, worlds_device
from composing.entry import new_run_dir
from composing.options import CONFIG_DIR
from composing.saved import format_value, settings_of
from composing.workers import resolve_workers
from dreamer_racing import parallel
from dreamer_racing.devices import choose_device, choose_mixed_precision
from dreamer_racing.envs.race.race import EPISODE_TIME
from dreamer_racing.envs.tracks import TrackError

NUM_ENVS = 32  # of the recipes with a world model
SHORT_WINDOW = 16  # records, on a CUDA device
MODEL_OF_BUDGET = {"smoke": "debug", "paper": "paper_large"}
NAMES = {"dreamer_v3": "DreamerV3", "latent_ppo": "latent PPO"}
FEW_WORLDS = 4  # with fewer worlds none is held out


def resolve_common(config: DictConfig, num_envs: int) -> torch.device:
    """Fill in the settings that every recipe leaves open, print the choices, and return the learner's device."""
    device = choose_device(config.device)
    if config.device == "auto":
        print(f"device: {device} (device=auto)")
    config.device = str(device)
    if OmegaConf.is_missing(config.env, "num_envs"):
        config.env.num_envs = num_envs
    if not math.isfinite(config.env.control_rate):
        raise ValueError(f"env.control_rate={config.env.control_rate} Hz: must be a finite number.")
    if config.env.episode_steps is None and config.env.suite == "race":
        config.env.episode_steps = round(EPISODE_TIME * config.env.control_rate)
    if config.env.device == "auto":
        config.env.device = worlds_device(device, config.env)
        if device.type != "cpu":
            print(f"worlds: {config.env.device} (env.device=auto, env.renderer={config.env.renderer})")
    if config.env.suite == "race":
        note_track(config)
    if config.env.reward is not None and config.curriculum.maximum:
        print(
            f"reward: {config.env.reward}, minus the curriculum's penalty of body rates, which grows once the mean "
            f"return is above curriculum.threshold={config.curriculum.threshold:g} (curriculum=none: without it)"
        )
    if config.run_dir is None:
        scene = config.track if config.env.suite == "race" else config.task
        config.run_dir = parallel.broadcast(str(new_run_dir(config.algorithm, scene)))
    return device


def note_track(config: DictConfig) -> None:
    """Store a track file's contents in a new run's configuration; in a resumed run, print if the file has changed."""
    if config.track_description is None:
        found: list[str | None] = []
        parallel.run_in_all(lambda: found.append(serialize_track_file(config.track)))
        config.track_description = parallel.broadcast(found[0])
        return
    with suppress(TrackError):  # the file is gone or no longer valid
        if serialize_track_file(config.track) != config.track_description:
            print(f"track: {config.track} has changed since the run started; the run keeps the old track")


def resolve_baseline(config: DictConfig, num_envs: Mapping[str, int]) -> DictConfig:
    """Fill in the settings that a baseline leaves open, by its observations, and print the choices."""
    resolve_common(config, num_envs["pixels" if config.env.from_pixels else "state"])
    if config.network.size == "auto":
        sees = "images" if config.env.from_pixels else "numbers"
        config.network.size = "paper" if config.env.from_pixels and config.budget != "smoke" else "small"
        print(f"network: {config.network.size} (network=auto, seeing {sees}, budget={config.budget})")
    fill_in(config.network, "network")
    return config


def fill_in(group: DictConfig, folder: str) -> None:
    """Fill in the settings that a group lacks from the file of its size."""
    numbers = cast(DictConfig, OmegaConf.load(CONFIG_DIR / folder / f"{group.size}.yaml"))
    for name in group:
        if OmegaConf.is_missing(group, name):
            group[name] = numbers[name]


def tune(config: DictConfig) -> str:
    """Choose the configuration of the group `tuned` for a run with a world model, and print the choice."""
    device, size, budget = choose_device(config.device).type, config.model.size, config.budget
    others = {
        "env.from_pixels=false": not config.env.from_pixels,
        f"model={size}": size not in ("auto", "cpu_small"),
        f"budget={budget}": budget in ("smoke", "paper"),
    }
    if reasons := [setting for setting, other in others.items() if other]:
        print(f"settings: tuned=none, the algorithm as published; there are no tuned settings for {', '.join(reasons)}")
        return "none"
    chosen = "race" if config.env.suite == "race" else "suite"
    if device != "cpu":
        more = "; tuned=gpu has more worlds and updates, but is not measured" if chosen == "race" else ""
        print(f"settings: tuned={chosen}, measured on CPUs. model=size12m gives the algorithm as published{more}")
    return chosen


def resolve_world_model(config: DictConfig) -> DictConfig:
    """Fill in the settings that a world-model recipe leaves open, by device, size and budget; print the choices."""
    device = resolve_common(config, NUM_ENVS)
    size = config.model.size
    if size == "auto":
        by_device = "size12m" if device.type == "cuda" else "cpu_small"
        size = MODEL_OF_BUDGET.get(config.budget, by_device)
        print(f"model: {size} (model=auto on {device.type}, budget={config.budget})")
    config.model.size = size
    shorten_windows(config, device)
    disable_drift_loss(config)
    resolve_workers(config)
    fill_in(config.model, "model")
    if config.model.mixed_precision is None:
        config.model.mixed_precision, reason = parallel.broadcast(choose_mixed_precision(device))
        print(f"mixed precision: {'on' if config.model.mixed_precision else 'off'}, {reason}")
    if config.model.cuda_graph is None:  # updates must be alike, and processes exchange no data in them
        alone = parallel.asked_for() == 1 or config.algorithm == "latent_ppo"
        config.model.cuda_graph = device.type == "cuda" and alone and config.model.imagination_every == 1
        if config.model.cuda_graph:
            print("updates: replayed as one CUDA graph (model.cuda_graph=null)")
    print_tuned(config)
    if config.replay.held_out is None:
        worlds = config.env.num_envs // parallel.asked_for()  # those of the first process, which holds them out
        config.replay.held_out = int(worlds >= FEW_WORLDS)
        if not config.replay.held_out:
            print(f"held out: nothing, because there are only {worlds} worlds (replay.held_out=null)")
    return config


def print_tuned(config: DictConfig) -> None:
    """Print what the chosen settings of the group `tuned` mean, and which of them have other values here."""
    if config.tuned not in ("auto", "none") and (CONFIG_DIR / "tuned" / f"{config.tuned}.yaml").is_file():
        files = [CONFIG_DIR / "tuned" / folder / f"{config.tuned}.yaml" for folder in ("", config.algorithm)]
        description = [line for file in files if file.exists() for line in head_of(file)]
        files_hint = f"recipes/config/tuned/{config.tuned}.yaml and tuned/{config.algorithm} have all values"
        first = f"settings: tuned={config.tuned}, for {NAMES[config.algorithm]} {description[0]}"
        print("\n  ".join((first, *description[1:], files_hint)))
        if changed := changed_from_tuned(config, files):
            print(f"settings that differ from tuned={config.tuned} (its values in brackets): {', '.join(changed)}")
        print(f"length: {config.total_env_steps:,} env_steps; the progress shows the measured time left")


def head_of(file: Path) -> list[str]:
    """Return a file's head comment without hydra's own first line, up to the first empty comment line."""
    lines = file.read_text(encoding="utf-8").splitlines()[1:]
    return [line[2:] for line in takewhile(lambda line: line.startswith("# "), lines)]


def changed_from_tuned(config: DictConfig, files: list[Path]) -> list[str]:
    """Return ``setting=value (tuned value)`` for each setting that differs here from what `tuned` chooses."""
    named = {name for file in files if file.exists() for name in settings_of(cast(DictConfig, OmegaConf.load(file)))}
    running = GlobalHydra.instance().is_initialized()  # in a recipe
    with nullcontext() if running else hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        tuned = settings_of(hydra.compose(config.algorithm, [f"tuned={config.tuned}"]))
        plain = settings_of(hydra.compose(config.algorithm, ["tuned=none", f"model={tuned['model.size']}"]))
    here = settings_of(config)
    return [
        f"{name}={format_value(here[name])} ({format_value(value)})"
        for name, value in tuned.items()
        if value != here[name] and (value != plain[name] or name in named) and name != "tuned"
    ]


def shorten_windows(config: DictConfig, device: torch.device) -> None:
    """Use more and shorter windows per batch on a CUDA device, if neither their number nor their length is given.

    The records of a window are processed in sequence, with kernel launches for each. Short windows begin with stored
    latents; without, their first records would teach the model to forget.
    """
    open_numbers = all(OmegaConf.is_missing(config.model, name) for name in ("batch_size", "batch_length"))
    shortened = device.type == "cuda" and open_numbers and config.replay.context is not False
    if shortened:
        numbers = OmegaConf.load(CONFIG_DIR / "model" / f"{config.model.size}.yaml")
        shortened = numbers.batch_length > SHORT_WINDOW
    if shortened:
        config.model.batch_length = SHORT_WINDOW
        config.model.batch_size = numbers.batch_size * numbers.batch_length // SHORT_WINDOW
        print(
            f"batch: {config.model.batch_size} windows of {SHORT_WINDOW} records that start from stored latents (CUDA)"
        )
    if config.replay.context is None:
        config.replay.context = shortened


def disable_drift_loss(config: DictConfig) -> None:
    """Turn the policy-drift loss off if the replay stores no latents, or if latents are sampled."""
    reasons = {
        "the replay stores no latents (replay.context=false)": not config.replay.context,
        "latents are sampled (model.sampled=true)": config.model.sampled,
    }
    if config.loss.drift_scale and any(reasons.values()):
        config.loss.drift_scale = 0.0
        print(f"policy drift penalty: off, because {' and '.join(name for name, holds in reasons.items() if holds)}")
