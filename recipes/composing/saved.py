"""Configurations of runs, read back: typed as this version knows them, and compared."""

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

OF_THIS_MACHINE = (
    "device",
    "env.renderer",
    "model.mixed_precision",
    "model.cuda_graph",
    "resume",
    "run_dir",
)
"""What a run that is resumed chooses anew, unless it was begun with a choice."""
SEEN = ("env.control_rate", "env.camera_rate", "env.camera_tilt", "env.imu", "env.vector")
"""What an agent sees, and how often: other networks would learn from it."""

Config = TypeVar("Config", DictConfig, ListConfig)


def trained_config(run_dir: Path) -> RunConfig:
    """Read back the configuration that a run was trained with, as `saved_config` does."""
    return cast(RunConfig, OmegaConf.to_object(saved_config(run_dir)))


def saved_config(run_dir: Path) -> DictConfig:
    """Read back what a run was last trained with, resolved; what it does not say is at its default.

    Raises:
        ValueError: it is damaged, of an unknown algorithm, or has a setting that this version does not.
    """
    path = RunDirectory(run_dir).config
    saved = read_yaml(path, DictConfig)
    if (algorithm := str(saved.get("algorithm"))) not in RECIPES:
        raise ValueError(f"{path}: algorithm={shortened(algorithm)}; there are {', '.join(RECIPES)}.")
    try:
        config = cast(DictConfig, OmegaConf.merge(OmegaConf.structured(RECIPES[algorithm]), saved))
    except OmegaConfBaseException as error:
        reason = shortened(" ".join(str(error).split()), 300)
        raise ValueError(f"{path} does not fit: {reason}. The run is of another version: its own reads it.") from error
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise ValueError(f"{path} is damaged: it does not say {shortened(', '.join(missing))}.")
    return config


def read_yaml(path: Path, kind: type[Config]) -> Config:
    """Read a file that a run left.

    Raises:
        ValueError: it is damaged, is not that at all, or refers to what lies outside of it, as a run never writes and a
            stranger might: ``${oc.env:NAME}`` would read this machine's environment.
    """
    try:
        content = OmegaConf.load(path)
    except (YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} is damaged: {shortened(' '.join(str(error).split()), 200)}") from error
    if not isinstance(content, kind) or (kind is DictConfig and not content):
        raise ValueError(f"{path} is damaged: it holds no {'list' if kind is ListConfig else 'settings'}.")
    if isinstance(content, DictConfig):
        for name, value in flatten(cast(dict[str, Any], OmegaConf.to_container(content, resolve=False))):
            if "${" in str(value):
                said = shortened(f"{name}: {value}")
                raise ValueError(f"{path}: {said}. A saved configuration says values, it refers to none.")
    return content


def keep_saved(config: DictConfig, saved: DictConfig, given: Collection[str]) -> None:
    """Set everything in a composed configuration to what was saved, but for `OF_THIS_MACHINE` and what is given now.

    So a run goes on as it was trained, whatever the defaults of a later version.

    Args:
        config: of the run that goes on, which is changed.
        saved: of the run as it was.
        given: names of settings and groups; `tuned` and `budget` are everything.
    """
    if {"tuned", "budget"}.isdisjoint(given):
        for name, value in flatten(cast(dict[str, Any], OmegaConf.to_container(saved))):
            is_given = any(name == other or name.startswith(f"{other}.") for other in given)
            if not is_given and name not in OF_THIS_MACHINE:
                OmegaConf.update(config, name, value)


def settings_of(config: DictConfig) -> dict[str, Any]:
    """Return all settings by their dotted names, with values as files have them."""
    return dict(flatten(cast(dict[str, Any], OmegaConf.to_container(config, enum_to_str=True))))


def said(value: Any) -> str:
    """Write a value of `settings_of` as the command line takes it."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def changed_settings(config: DictConfig) -> list[str]:
    """Every setting in which a resumed run goes on differently: by an override, this machine, or another version."""
    before = settings_of(saved_config(Path(config.run_dir)))
    return [
        f"{name}={said(value)} (was {said(before.get(name))})"
        for name, value in settings_of(config).items()
        if value != before.get(name) and name not in ("resume", "run_dir", "track_description")
    ]
