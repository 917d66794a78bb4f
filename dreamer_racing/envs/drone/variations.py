"""Drones as YAML files, for example of a measured drone, which `preset=` takes in place of a name.

preset: betaflight          # the preset that the drone varies; the widths of its randomisation stay
parameters:                 # fields of `QuadrotorParameters`, in SI units
  mass: 0.62
  betaflight:               # fields of `BetaflightParameters`
    p: [45, 47, 30]
about: {}                   # sources of the numbers; not read
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from dreamer_racing.settings import quoted, suggestion

T = TypeVar("T")
SUFFIXES = (".yaml", ".yml")
"""File name suffixes of drone files."""
UNCHANGED_FIELD = "randomisation"
"""Field that a drone file does not change."""


def write_variation(path: Path, preset: str, changes: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Write a drone file.

    Args:
        path: The file; an existing one is replaced.
        preset: The preset that the drone varies.
        changes: The changed fields, as returned by `field_differences`.
        about: Sources of its numbers, plain values.
    """
    content = {"preset": preset, "parameters": dict(changes), "about": dict(about)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100), encoding="utf-8")


def field_differences(base: Any, changed: Any) -> dict[str, Any]:
    """Return the fields in which one dataclass differs from another, as plain values."""
    fields = {}
    for name in (field.name for field in dataclasses.fields(base)):
        before, now = getattr(base, name), getattr(changed, name)
        if before == now or name == UNCHANGED_FIELD:
            continue
        inner = dataclasses.is_dataclass(before) and dataclasses.is_dataclass(now)
        fields[name] = field_differences(before, now) if inner else list(now) if isinstance(now, tuple) else now
    return fields


def read_variation(path: Path) -> tuple[Any, dict[str, Any]]:
    """Return the preset that a drone file varies, and its changes.

    Raises:
        ValueError: The file does not exist or is not a drone file.
    """
    if not path.is_file():
        raise ValueError(f"preset={path}: there is no such file.")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    changes = content.get("parameters", {}) if isinstance(content, dict) else None
    if not isinstance(changes, dict):
        raise ValueError(f"{path} is not a drone file: it needs preset: (a name) and parameters: (fields and values).")
    return content.get("preset"), changes


def apply_changes(base: T, changes: Mapping[str, Any]) -> T:
    """Return a copy of a dataclass with changed fields; lists become tuples.

    Raises:
        ValueError: A field does not exist, or a value is not allowed.
    """
    names = sorted({field.name for field in dataclasses.fields(base)} - {UNCHANGED_FIELD})  # type: ignore[arg-type]  # a dataclass, of any kind
    values: dict[str, Any] = {}
    for name, value in changes.items():
        if name not in names:
            raise ValueError(f"there is no parameter {quoted(name)}{suggestion(name, names)}: {', '.join(names)}.")
        before = getattr(base, name)
        if isinstance(value, dict):
            if not dataclasses.is_dataclass(before):
                raise ValueError(f"{name}={quoted(value)}: {name} has no fields.")
            values[name] = apply_changes(before, value)
        else:
            values[name] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(base, **values)  # type: ignore[type-var]  # likewise
