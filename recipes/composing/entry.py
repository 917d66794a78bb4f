"""Entry points: a recipe's `main`, given what hydra composes of the command line, or plain words on what it cannot."""

import functools
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from composing.messages import INTERRUPTED, follows, say_error
from composing.options import CONFIG_DIR, FLAGS, no_such_choice, no_such_setting
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.settings import check_settings


@contextmanager
def plain_errors(applies: Callable[[], bool] = lambda: True, also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn errors that a person can mend into one paragraph on stderr and exit status 2.

    Args:
        applies: whether it does by now; during set-up only, since the same error types inside training are defects,
            and keep their tracebacks.
        also: further types of errors that a person can mend here.
    """
    mended: tuple[type[Exception], ...] = (MissingMandatoryValue, ValueError, OSError, RendererUnavailableError, *also)
    try:
        yield
    except mended as error:
        if not applies():
            raise
        missing = isinstance(error, MissingMandatoryValue)
        say_error(f"{getattr(error, 'full_key', '')}= is missing, and there is no default." if missing else error)
        raise SystemExit(2) from error


@contextmanager
def plain_disk_errors() -> Iterator[None]:
    """Turn what a full disk does to results into a line on stderr and exit status 1."""
    try:
        yield
    except OSError as error:
        print(f"error: {error}. What was written so far is no whole result.", file=sys.stderr)
        raise SystemExit(1) from error


def start_logging() -> None:
    """Show what the package chose and why, one line each."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stdout, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.INFO)
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def follow_quietly() -> None:
    """Leave it to the first of several processes to say what is the same in all; warnings and errors go to stderr."""
    sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - until the process ends
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr, force=True)
    logging.getLogger("dreamer_racing").setLevel(logging.WARNING)


def new_run_dir(recipe: str, track: str) -> Path:
    """A fresh folder name below `runs/`."""
    return Path("runs") / f"{recipe}_{Path(track).stem}_{datetime.now():%Y%m%d-%H%M%S}"


def override_key(override: str) -> str:
    """The setting that an override is of."""
    return override.partition("=")[0].lstrip("+~")


def as_override(name: str, text: str | Path) -> str:
    """Write a setting that is a text so that hydra reads that text, whatever letters are in it."""
    plain, quoted = (f"{name}={word}" for word in (text, QuotedString(str(text), Quote.single).with_quotes()))
    return plain if hydra_takes(plain) and override_value(plain) == str(text) else quoted


def override_value(override: str) -> object:
    """What hydra reads in an override that it takes."""
    return OverridesParser.create().parse_override(override).value()


def hydra_takes(override: str) -> bool:
    """Whether hydra can read an override."""
    try:
        override_value(override)
    except HydraException:
        return False
    return True


def merge_overrides(saved: Iterable[str], given: Sequence[str]) -> list[str]:
    """Overrides of a run that is continued: those it was started with, replaced by the ones given now."""
    replaced = {override_key(override) for override in given}
    return [override for override in saved if override_key(override) not in replaced] + list(given)


SCHEMAS: dict[str, type] = {}
"""Dataclasses of the recipes that are loaded, by their names."""
WHOLE = re.compile(r"\d{1,9}(\.\d{1,9})?[eE]\+?\d{1,2}")
"""A number such as 1e6."""
PLAIN = {
    r"could not be converted to Integer": "is no whole number",
    r"could not be converted to Float": "is no number",
    r"is not a valid bool \(type \w+\)": "is neither true nor false",
    r"Invalid type assigned: .*Ramp.*": "a schedule has an end and times of its own, NAME.to=, .begin=, .end=",
}
"""What the libraries say, and what is said instead."""
TEXTS = (
    "run_dir", "resume", "init_from", "checkpoint", "output", "name", "directory", "runs", "commit", "agent", "actor",
    "track", "evaluation", "run", "against", "beside", "picture", "replay", "report", "betaflight_dump",
    "flight", "vehicle",
)  # fmt: skip
"""Settings that are no numbers, whatever they look like."""


def recipe(
    name: str, schema: type, composed: bool = False, logs: bool = True
) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Make a function of a configuration the recipe of a name.

    An override that hydra does not take is said in one paragraph on stderr, with exit status 2. Ctrl-C, where the
    recipe has no use for it, ends it with the shell's status.

    Args:
        name: of the recipe. Hydra composes the configuration from the file of this name in `config`; where there is
            none it is the schema alone, and hydra leaves nothing behind.
        schema: dataclass of the configuration.
        composed: whether the function takes what hydra composed, with settings left open, instead of an object of the
            dataclass whose numbers are within their ranges, and that its method `check` takes, if it has one.
        logs: whether what the package logs is said, on stdout; not where programs read that.
    """
    SCHEMAS[name] = schema
    ConfigStore.instance().store(name=f"{name}_schema", node=schema)
    if not (CONFIG_DIR / f"{name}.yaml").is_file():
        ConfigStore.instance().store(name=name, node=schema_alone(name))

    def decorate(function: Callable[[Any], None]) -> Callable[[], None]:
        @functools.wraps(function)
        def with_typed(config: DictConfig) -> None:
            if logs:
                start_logging()
            function(typed(config))

        task = function if composed else with_typed
        main = hydra.main(version_base="1.3", config_path=str(CONFIG_DIR), config_name=name)(task)

        @functools.wraps(function)
        def start() -> None:
            sys.excepthook = sys.__excepthook__  # packages are loaded
            sys.argv[1:] = [readable(FLAGS.get(argument, argument)) for argument in sys.argv[1:]]
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors as they are, instead of hydra's own page
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


def typed(config: DictConfig) -> Any:
    """Return an object of the dataclass of a configuration; refuse what is missing, out of its range, or by `check`."""
    with plain_errors():
        settings: Any = OmegaConf.to_object(config)
        check_settings(settings)
        if hasattr(settings, "check"):
            settings.check()
    return settings


def schema_alone(name: str) -> dict[str, Any]:
    """Return the configuration of a recipe that has settings of its own and chooses nothing from groups."""
    silent = [{f"override hydra/{kind}_logging": "none"} for kind in ("job", "hydra")]
    return {
        "defaults": [f"{name}_schema", "_self_", *silent],
        "hydra": {"output_subdir": None, "run": {"dir": "."}},
    }


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
        return no_such_choice(group, choice, choices)
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
