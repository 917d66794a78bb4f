"""What of a configuration is not as the file of the group `tuned` has it."""

from __future__ import annotations

from enum import Enum
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from composing.command_line import CONFIG_DIR
from dreamer_racing.figures.runs import flatten


def changed_from_tuned(config: DictConfig) -> list[str]:
    """Return the settings that are not as the file of `tuned`, or a file that it takes, has them.

    Returns:
        Each as ``setting=value (there)``, as the command line takes both.
    """
    numbers = numbers_of("tuned", config.tuned)
    for taken in numbers.pop("defaults"):
        ((group, name),) = taken.items()
        group = group.rpartition("/")[2]
        if group != "model":  # the size's own numbers follow from model.size
            numbers[group] = {**numbers_of(group, name), **numbers.get(group, {})}
            numbers[group].pop("defaults", None)
    numbers.pop("tuned")
    return [
        f"{name}={said(value)} ({said(there)})"
        for name, there in flatten(numbers)
        if plain(value := OmegaConf.select(config, name)) != there
    ]


def numbers_of(group: str, name: str) -> dict[str, Any]:
    """Return what a file of a group has."""
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(CONFIG_DIR / group / f"{name}.yaml")))


def plain(value: Any) -> Any:
    """Return a value as files have it."""
    return value.name if isinstance(value, Enum) else value


def said(value: Any) -> str:
    """Write a value as the command line takes it."""
    words = {None: "null", True: "true", False: "false"}
    value = plain(value)
    return words[value] if value is None or isinstance(value, bool) else str(value)
