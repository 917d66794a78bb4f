"""Read, check and compare the saved configurations of runs."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from composing.schema import RECIPES, RunConfig
from dreamer_racing.figures.runs import flatten
from dreamer_racing.settings import shortened
from dreamer_racing.training.directory import RunDirectory

MACHINE_SETTINGS = ("device", "env.renderer", "model.mixed_precision", "model.cuda_graph", "resume", "run_dir")
"""Settings that a resumed run chooses anew, unless they were given when it began."""
OBSERVATION_SETTINGS = ("env.control_rate", "env.camera_rate", "env.camera_tilt", "env.imu", "env.vector")
"""Settings that define an agent's observations and their rate; its networks fit no others."""

Config = TypeVar("Config", DictConfig, ListConfig)


def trained_config(run_dir: Path) -> RunConfig:
    """Return the configuration that a run was trained with as an object; see `saved_config`."""
    return cast(RunConfig, OmegaConf.to_object(saved_config(run_dir)))


def saved_config(run_dir: Path) -> DictConfig:
    """Read the resolved configuration that a run was last trained with; settings that it lacks get their defaults."""
    path = RunDirectory(run_dir).config
    saved = read_yaml(path, DictConfig)
    if (algorithm := str(saved.get("algorithm"))) not in RECIPES:
        raise ValueError(f"{path}: algorithm={shortened(algorithm)}: must be one of {', '.join(RECIPES)}.")
    try:
        config = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(RECIPES[algorithm]), saved))
    except OmegaConfBaseException as error:
        reason = shortened(" ".join(str(error).split()), 300)
        raise ValueError(f"{path} cannot be read: {reason}. Use the version that wrote it.") from error
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise ValueError(f"{path} is damaged: it lacks {shortened(', '.join(missing))}.")
    config.env.preset = RunDirectory(run_dir).kept_preset(config.env.preset)
    return config


def read_yaml(path: Path, kind: type[Config]) -> Config:
    """Read a YAML file that a run wrote; refuse one that is damaged, of another kind, or contains interpolations.

    A run writes none, but in a file from a stranger ``${oc.env:NAME}`` would read this machine's environment.
    """
    try:
        content = OmegaConf.load(path)
    except (YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} is damaged: {shortened(' '.join(str(error).split()), 200)}") from error
    if not isinstance(content, kind) or (kind is DictConfig and not content):
        raise ValueError(f"{path} is damaged: it holds no {'list' if kind is ListConfig else 'settings'}.")
    if isinstance(content, DictConfig):
        for name, value in settings_of(content).items():
            if "${" in str(value):
                shown = shortened(f"{name}: {value}")
                raise ValueError(f"{path}: {shown}. A saved configuration must contain plain values, no references.")
    return content


def restore_saved_settings(config: DictConfig, saved: DictConfig, given: Collection[str]) -> None:
    """Set a composed configuration to the saved values, except `MACHINE_SETTINGS` and settings that are given now.

    None is kept once a group `tuned` or `budget` is given.
    """
    if {"tuned", "budget"}.isdisjoint(given):
        for name, value in settings_of(saved).items():
            is_given = any(name == other or name.startswith(f"{other}.") for other in given)
            if not is_given and name not in MACHINE_SETTINGS:
                OmegaConf.update(config, name, value)


def settings_of(config: DictConfig) -> dict[str, Any]:
    """Return all settings by their dotted names, with values as in YAML files."""
    return dict(flatten(cast(dict[str, Any], OmegaConf.to_container(config, enum_to_str=True))))


def format_value(value: Any) -> str:
    """Return a value of `settings_of` as it is written on the command line."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def changed_settings(config: DictConfig) -> list[str]:
    """Return the settings that a resumed run has changed: by an override, this machine, or another version."""
    before = settings_of(saved_config(Path(config.run_dir)))
    return [
        f"{name}={format_value(value)} (was {format_value(before.get(name))})"
        for name, value in settings_of(config).items()
        if value != before.get(name) and name not in ("resume", "run_dir", "track_description")
    ]
