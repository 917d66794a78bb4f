"""Configurations of runs, read back: typed as this version knows them, and compared."""

from collections.abc import Collection
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar, cast

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from composing.command_line import override_key
from composing.schema import RECIPES, RunConfig, WorldModelRunConfig
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

Config = TypeVar("Config", DictConfig, ListConfig)


def trained_config(run_dir: Path) -> RunConfig:
    """Read back the configuration that a run was trained with.

    Raises:
        ValueError: by an unknown algorithm.
    """
    path = RunDirectory(run_dir).config
    saved = read_yaml(path, DictConfig)
    algorithm = str(saved.get("algorithm", WorldModelRunConfig.algorithm))
    if algorithm not in RECIPES:
        raise ValueError(f"{path}: algorithm={shortened(algorithm)}; there are {', '.join(RECIPES)}.")
    return cast(RunConfig, OmegaConf.to_object(whole(with_schema(saved, algorithm), path)))


def with_schema(saved: DictConfig, algorithm: str) -> DictConfig:
    """Type a saved configuration: what it does not say is at its default, what is unknown here is left out."""
    schema = OmegaConf.structured(RECIPES[algorithm])
    if unknown := drop_unknown(saved, schema):
        print(f"settings of another version, left out: {', '.join(unknown)}")
    try:
        return cast(DictConfig, OmegaConf.merge(schema, saved))
    except OmegaConfBaseException as error:
        reason = str(error).replace("\n", " ")
        raise ValueError(f"The configuration of a saved run does not fit: {shortened(reason, 300)}") from error


def whole(config: DictConfig, path: Path) -> DictConfig:
    """Return a configuration that was read from a path, if it says all that has no default.

    Raises:
        ValueError: it does not.
    """
    if missing := sorted(OmegaConf.missing_keys(config)):
        raise ValueError(f"{path} is damaged: it does not say {shortened(', '.join(missing))}.")
    return config


def read_yaml(path: Path, kind: type[Config]) -> Config:
    """Read a file that a run left.

    Raises:
        ValueError: it is damaged, is not that at all, or refers to what lies outside of it.
    """
    try:
        content = OmegaConf.load(path)
    except (YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        raise ValueError(f"{path} is damaged: {shortened(' '.join(str(error).split()), 200)}") from error
    if not isinstance(content, kind) or (kind is DictConfig and not content):
        raise ValueError(f"{path} is damaged: it holds no {'list' if kind is ListConfig else 'settings'}.")
    if isinstance(content, DictConfig):
        refuse_references(content, path)
    return content


def refuse_references(saved: DictConfig, path: Path) -> None:
    """Refuse what a run never writes and a stranger might: ``${oc.env:NAME}`` would read this machine's environment.

    Raises:
        ValueError: a value refers to another; the message names it.
    """
    for name, value in flatten(cast(dict[str, Any], OmegaConf.to_container(saved, resolve=False))):
        if "${" in str(value):
            raise ValueError(
                f"{path}: {shortened(f'{name}: {value}')}. A saved configuration says values, it refers to none."
            )


def is_known(name: str, schema: DictConfig) -> bool:
    """Whether a schema has a setting or a group of this dotted name."""
    first, _, rest = name.partition(".")
    if first not in set(schema.keys()):
        return False
    inner = schema._get_node(first)
    return not rest or (isinstance(inner, DictConfig) and is_known(rest, inner))


def drop_unknown(saved: DictConfig, schema: DictConfig, prefix: str = "") -> list[str]:
    """Remove from a saved configuration what a schema does not have; return `name=value` of each."""
    unknown = [name for name in map(str, saved) if name not in set(schema.keys())]  # `in` overlooks what is missing
    dropped = [f"{prefix}{name}={saved.pop(name)}" for name in unknown]
    for name in map(str, saved):
        inner, known = saved[name], schema._get_node(name)
        if isinstance(inner, DictConfig) and isinstance(known, DictConfig):
            dropped += drop_unknown(inner, known, f"{prefix}{name}.")
    return dropped


def keep_saved(config: DictConfig, saved: DictConfig, given: Collection[str], prefix: str = "") -> None:
    """Set everything in a composed configuration to what was saved, but for `OF_THIS_MACHINE` and what is given now.

    So a run goes on as it was trained, whatever the defaults of a later version.

    Args:
        config: of the run that goes on, which is changed.
        saved: of the run as it was.
        given: names of settings and groups; `tuned` and `budget` are everything.
        prefix: of the names in this group.
    """
    for key, value in saved.items():
        name = prefix + str(key)
        parents = {name[:end] for end, letter in enumerate(name) if letter == "."}
        if not {name, "tuned", "budget", *parents}.isdisjoint(given) or name in OF_THIS_MACHINE:
            continue
        if isinstance(value, DictConfig) and isinstance(inner := config[key], DictConfig):
            keep_saved(inner, value, given, f"{name}.")
        else:
            config[key] = value


def begun_with(algorithm: str, run_dir: Path) -> list[str]:
    """Overrides that a run was begun with, as this version knows them; what it does not know is left out and named."""
    schema = OmegaConf.structured(RECIPES[algorithm])
    overrides = [str(override) for override in read_yaml(RunDirectory(run_dir).overrides, ListConfig)]
    known = [override for override in overrides if is_known(override_key(override), schema)]
    if unknown := [override for override in overrides if override not in known]:
        print(f"overrides of another version, left out: {', '.join(unknown)}")
    return [override for override in known if override_key(override) != "run_dir"]


def saved_config(algorithm: str, run_dir: Path) -> DictConfig:
    """What a run was last trained with, resolved; what older runs do not say is at its default.

    Raises:
        ValueError: it is another algorithm's run.
    """
    path = RunDirectory(run_dir).config
    saved = read_yaml(path, DictConfig)
    trained_by = saved.get("algorithm", algorithm)
    if trained_by != algorithm:
        raise ValueError(f"{run_dir} was trained by {trained_by}: continue it with recipes/{trained_by}.py.")
    config = whole(with_schema(saved, algorithm), path)
    if "tuned" in config and "tuned" not in saved:
        config.tuned = "none"  # begun before there was a choice
    return config


def changed_settings(config: DictConfig) -> list[str]:
    """Every setting in which a resumed run goes on differently: by an override, this machine, or another version."""
    before = flat_settings(saved_config(config.algorithm, Path(config.run_dir)))

    def word(value: Any) -> str:
        return "null" if value is None else str(value.value if isinstance(value, Enum) else value)

    return [
        f"{name}={word(value)} (was {word(before.get(name))})"
        for name, value in flat_settings(config).items()
        if value != before.get(name) and name not in ("resume", "run_dir", "track_description")
    ]


def flat_settings(config: DictConfig) -> dict[str, Any]:
    """Values by dotted name."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = str(key)
        if isinstance(value, DictConfig):
            flat |= {f"{name}.{inner}": leaf for inner, leaf in flat_settings(value).items()}
        else:
            flat[name] = value
    return flat
