"""Entry points: a recipe's `main`, given what hydra composes of the command line, or plain words on what it cannot."""

import difflib
import functools
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from composing.command_line import (
    CONFIG_DIR,
    as_override,
    follows,
    hydra_takes,
    override_key,
    plain_errors,
    say_error,
)
from composing.interruption import INTERRUPTED
from dreamer_racing.settings import shortened, suggestion

WHOLE = re.compile(r"\d{1,9}(\.\d{1,9})?[eE]\+?\d{1,2}")
"""A number such as 1e6."""
PLAIN = {
    r"could not be converted to Integer": "is no whole number",
    r"could not be converted to Float": "is no number",
    r"is not a valid bool \(type \w+\)": "is neither true nor false",
    r"Invalid type assigned: .*Ramp.*": "a schedule has an end and times of its own, NAME.to=, .begin=, .end=",
}
"""What the libraries say, and what is said instead."""
FLAGS = {"--json": "json=true"}
"""Settings that are customary as flags, for recipes that have them."""
HYDRAS_FLAGS = (
    "--cfg", "--config-dir", "--config-name", "--config-path", "--experimental-rerun", "--help", "--hydra-help",
    "--info", "--multirun", "--package", "--resolve", "--run", "--shell-completion", "--version",
)  # fmt: skip
"""Flags that are hydra's own; it takes the beginnings of their names, too."""
TEXTS = (
    "run_dir", "resume", "init_from", "checkpoint", "output", "name", "directory", "runs", "commit", "agent", "actor",
    "track", "evaluation", "run", "against", "beside", "picture", "replay", "report", "betaflight_dump",
)  # fmt: skip
"""Settings that are no numbers, whatever they look like."""


def recipe(name: str) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Make a function of a configuration the recipe of a name, whose file in `config` hydra composes it from.

    An override that hydra does not take is said in one paragraph on stderr, with exit status 2. Ctrl-C, where the
    recipe has no use for it, ends it with the shell's status.
    """

    def decorate(function: Callable[[Any], None]) -> Callable[[], None]:
        main = hydra.main(version_base="1.3", config_path=str(CONFIG_DIR), config_name=name)(function)

        @functools.wraps(function)
        def start() -> None:
            sys.excepthook = sys.__excepthook__  # packages are loaded
            sys.argv[1:] = [readable(FLAGS.get(argument, argument)) for argument in sys.argv[1:]]
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors as they are, instead of hydra's own page
            with plain_errors():
                refuse_dashes(sys.argv[1:])
                refuse_unknown_settings(sys.argv[1:], name)
            try:
                main()
            except HydraException as error:
                say_error(in_plain_words(error, name, sys.argv[1:]))
                raise SystemExit(2) from error
            except KeyboardInterrupt as interrupt:
                if not follows():
                    print(INTERRUPTED, file=sys.stderr)
                raise SystemExit(128 + signal.SIGINT) from interrupt

        return start

    return decorate


def readable(argument: str) -> str:
    """Return an override as hydra reads it.

    Whole numbers, one or several with commas between, get all their digits, since hydra takes 1e6 for a fraction; of
    texts a ~ at the beginning is the user's home, and they are quoted if hydra would refuse a letter in them, unless
    that has a meaning in lists or is a quote.
    """
    name, equals, value = argument.partition("=")
    if not equals:
        return argument
    if override_key(argument) in TEXTS:
        known = hydra_takes(argument) or set(value) & set(",[]{}'\"")
        return argument if known else as_override(name, os.path.expanduser(value))
    return f"{name}={','.join(map(_in_digits, value.split(',')))}"


def _in_digits(value: str) -> str:
    whole = WHOLE.fullmatch(value) and float(value).is_integer()
    return str(int(float(value))) if whole else value


def in_plain_words(error: HydraException, recipe_name: str, overrides: Sequence[str]) -> str:
    """Say what is wrong with an override, and what would be right."""
    text, cause = str(error), error.__cause__
    if match := re.search(r"Could not override '(.+?)'", text):
        return no_such_setting(match[1], recipe_name)
    if match := re.search(r"Could not find '(.+)/(.+?)'\n\nAvailable options in '.+?':\n((?:\t.+\n)+)", text):
        group, choice, choices = match[1], match[2], [word for word in match[3].split() if word != "schema"]
        return f"{group}={choice}: there are {', '.join(choices)}{suggestion(choice, choices)}."
    if match := re.search(r"Error merging override (.+)", text):
        wanted = str(cause).partition("\n")[0] if isinstance(cause, OmegaConfBaseException) else "it does not fit"
        for words, plain in PLAIN.items():
            wanted = re.sub(words, plain, wanted)
        return f"{match[1]}: {wanted}."
    if "parsing override" in text or "no viable alternative" in text:
        match = re.search(r"Error parsing override '(.+?)'", text)
        given = f"{match[1]}: an override is" if match else f"{' '.join(overrides)}: overrides are"
        return f"{given} written name=value, and a value with brackets, commas or spaces in quotes: 'name=\"a, b\"'."
    return " ".join(text.split())


def no_such_setting(name: str, recipe_name: str) -> str:
    """Say that there is no setting of a name, and which may be meant."""
    ready = GlobalHydra.instance().is_initialized()  # in the midst of an experiment
    with nullcontext() if ready else hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        known = setting_names(hydra.compose(recipe_name))
    if name in known:  # a group that nothing is taken from where nobody says so
        return f"{name}: is added, with a plus: +{name}=..."
    last = {full.rpartition(".")[2]: full for full in known}
    close = difflib.get_close_matches(name, known, n=1) or [
        last[word] for word in difflib.get_close_matches(name.rpartition(".")[2], last, n=1)
    ]
    meant = f" (did you mean {close[0]}?)" if close else ""
    return f"{name}: there is no such setting of recipes/{recipe_name}.py{meant}. docs/options.md has them all."


def setting_names(config: DictConfig, prefix: str = "") -> list[str]:
    """Return the dotted names of all settings and groups."""
    names = []
    for key in config:
        name = prefix + str(key)
        names.append(name)
        if not OmegaConf.is_missing(config, key) and isinstance(inner := config[key], DictConfig):
            names += setting_names(inner, f"{name}.")
    return names


def refuse_dashes(arguments: Sequence[str]) -> None:
    """Refuse a setting that is written as a flag, of which hydra has some of its own.

    Raises:
        ValueError: the message says how it is written.
    """
    for argument in arguments:
        flag, _, value = argument.partition("=")
        if flag.startswith("--") and not any(known.startswith(flag) for known in HYDRAS_FLAGS):
            written = f"{flag[2:].replace('-', '_')}={value or 'VALUE'}"
            raise ValueError(f"{argument}: settings are written without dashes, {written}.")


def refuse_unknown_settings(overrides: Sequence[str], recipe_name: str) -> None:
    """Refuse +name=value of what is neither a group of configurations nor a free entry: nothing would read it.

    A list of lists for a group is refused too: hydra fails on it.

    Raises:
        ValueError: the message says which may be meant.
    """
    for override in overrides:
        group, _, value = override.partition("=")
        if value.replace(" ", "").startswith("[[") and (CONFIG_DIR / group.lstrip("+")).is_dir():
            raise ValueError(f"{group}={shortened(value)}: a group takes the name of one of its configurations.")
    added = [override_key(override) for override in overrides if override.startswith("+")]
    if not added or any(override.startswith(("--config", "-c")) for override in overrides):
        return  # with configurations of one's own there may be other groups
    with hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        config = hydra.compose(recipe_name)
    known = set(setting_names(config))
    for name in added:
        inside = OmegaConf.select(config, name.rpartition(".")[0]) if "." in name else None
        free = isinstance(inside, DictConfig) and OmegaConf.get_type(inside) is dict
        if not (free or name in known or name.startswith("hydra") or (CONFIG_DIR / name).is_dir()):
            raise ValueError(no_such_setting(name, recipe_name))
