"""What of a configuration is not as the file of the group `tuned` has it."""

from __future__ import annotations

from enum import Enum
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from composing.options import CONFIG_DIR
from dreamer_racing.figures.runs import flatten


def changed_from_tuned(config: DictConfig) -> list[str]:
    """Return the settings that are not as the file of `tuned`, or a file that it takes, has them.

    Returns:
        Each as ``setting=value (there)``, as the command line takes both.
    """
    numbers = tuned_numbers(config.tuned, config.algorithm)
    numbers.pop("tuned")
    return [
        f"{name}={said(value)} ({said(there)})"
        for name, there in flatten(numbers)
        if plain(value := OmegaConf.select(config, name)) != there
    ]


def tuned_numbers(tuned: str, algorithm: str) -> dict[str, Any]:
    """Return what a file of the group `tuned`, and that of an algorithm, have over what they take of other groups."""
    groups, own = layers_of(tuned)
    if (CONFIG_DIR / "tuned" / algorithm / f"{tuned}.yaml").exists():
        own = merged(own, layers_of(tuned, f"tuned/{algorithm}")[1])
    groups.pop("model", None)  # the size's own numbers follow from model.size
    taken = {group: numbers_of(group, name) for group, name in groups.items()}
    for numbers in taken.values():
        numbers.pop("defaults", None)
    return merged(taken, own)


def layers_of(tuned: str, group: str = "tuned") -> tuple[dict[str, str], dict[str, Any]]:
    """Return which files of other groups a file of the group `tuned` takes, by group, and its own numbers.

    If it takes another file of its own group, that one's are among them, and give way to its own.
    """
    groups: dict[str, str] = {}
    own = numbers_of(group, tuned)
    for taken in own.pop("defaults", ()):
        if isinstance(taken, str):
            below, numbers = layers_of(taken, group)
            groups, own = below | groups, merged(numbers, own)
        else:
            groups |= {other.rpartition("/")[2]: name for other, name in taken.items()}
    return groups, own


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return nested settings, those above where both have them."""
    return cast(dict[str, Any], OmegaConf.to_container(OmegaConf.merge(below, above)))


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
