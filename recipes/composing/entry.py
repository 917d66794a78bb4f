"""Entry points: call a recipe's `main` with the configuration that hydra composes, and print errors in plain words."""

import functools
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

from composing.messages import INTERRUPTED, is_follower_rank, say_error
from composing.options import CONFIG_DIR, FLAGS, no_such_setting
from dreamer_racing.envs.simulator.opengl import RendererUnavailableError
from dreamer_racing.settings import check_settings, is_number, wrong_choice
from dreamer_racing.terminal import start_logging


@contextmanager
def plain_errors(applies: Callable[[], bool] = lambda: True, also: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn errors that the user can fix, `also` of further types, into one paragraph on stderr and exit status 2.

    It `applies` during set-up only: the same types of errors inside training are defects, and keep their tracebacks.
    """
    errors: tuple[type[Exception], ...] = (MissingMandatoryValue, ValueError, OSError, RendererUnavailableError, *also)
    try:
        yield
    except errors as error:
        if not applies():
            raise
        missing = isinstance(error, MissingMandatoryValue)
        say_error(f"{getattr(error, 'full_key', '')}= is missing, and there is no default." if missing else error)
        raise SystemExit(2) from error


@contextmanager
def plain_disk_errors() -> Iterator[None]:
    """Turn a failure to write results into one line on stderr and exit status 1."""
    try:
        yield
    except OSError as error:
        print(f"error: {error}. The results written so far are incomplete.", file=sys.stderr)
        raise SystemExit(1) from error


def new_run_dir(recipe: str, track: str) -> Path:
    """Return a new folder name below `runs/`, which ends with the time."""
    return Path("runs") / f"{recipe}_{Path(track).stem}_{datetime.now():%Y%m%d-%H%M%S}"


def override_key(override: str) -> str:
    """Return the name of the setting in an override."""
    return override.partition("=")[0].lstrip("+~")


def as_override(name: str, text: str | Path) -> str:
    """Return an override that hydra parses as exactly this text, quoted if needed."""
    plain, quoted = (f"{name}={word}" for word in (text, QuotedString(str(text), Quote.single).with_quotes()))
    return plain if is_parsable(plain) and override_value(plain) == str(text) else quoted


def override_value(override: str) -> object:
    """Return the value that hydra parses from a valid override."""
    return OverridesParser.create().parse_override(override).value()


def is_parsable(override: str) -> bool:
    """Return whether hydra can parse an override."""
    try:
        override_value(override)
    except HydraException:
        return False
    return True


def merge_overrides(saved: Iterable[str], given: Sequence[str]) -> list[str]:
    """Return the saved overrides of a run, with those of settings that are given now replaced."""
    replaced = {override_key(override) for override in given}
    return [override for override in saved if override_key(override) not in replaced] + list(given)


SCHEMAS: dict[str, type] = {}  # configuration dataclasses of the imported recipes, by the recipes' names
WHOLE = re.compile(r"\d{1,9}(\.\d{1,9})?[eE]\+?\d{1,2}")  # a number such as 1e6
PLAIN = {  # patterns of the libraries' messages, and the words to print instead
    r"could not be converted to Integer": "is not a whole number",
    r"could not be converted to Float": "is not a number",
    r"is not a valid bool \(type \w+\)": "is neither true nor false",
    r"Invalid type assigned: .*Ramp.*": "a schedule is set by NAME.to=, NAME.begin= and NAME.end=",
}
TEXTS = (
    "run_dir", "resume", "init_from", "checkpoint", "output", "name", "directory", "runs", "commit", "agent", "actor",
    "track", "evaluation", "run", "against", "beside", "picture", "replay", "report", "betaflight_dump",
    "flight", "vehicle", "betaflight", "firmware", "preset", "env.preset", "dreams",
)  # fmt: skip
"""Settings that are always text, even if they look like numbers."""


def recipe(
    name: str, schema: type, composed: bool = False, logs: bool = True
) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Return a decorator that turns a function of a configuration into the entry point of a recipe.

    Hydra composes the configuration from the file of the recipe's name in `config`; without such a file it is the
    schema alone, and hydra writes no files. The function takes an object of the schema that has passed all checks, or
    if it is `composed`, hydra's `DictConfig`, in which settings may be missing. If it `logs`, the package's log
    messages are printed on stdout.
    """
    SCHEMAS[name] = schema
    ConfigStore.instance().store(name=f"{name}_schema", node=schema)
    if not (CONFIG_DIR / f"{name}.yaml").is_file():
        silent = [{f"override hydra/{kind}_logging": "none"} for kind in ("job", "hydra")]
        hydras = {"output_subdir": None, "run": {"dir": "."}}
        node = {"defaults": [f"{name}_schema", "_self_", *silent], "hydra": hydras}
        ConfigStore.instance().store(name=name, node=node)

    def decorate(function: Callable[[Any], None]) -> Callable[[], None]:
        @functools.wraps(function)
        def with_typed(config: DictConfig) -> None:
            if logs:
                start_logging()
            function(to_checked_object(config))

        task = function if composed else with_typed
        main = hydra.main(version_base="1.3", config_path=str(CONFIG_DIR), config_name=name)(task)

        @functools.wraps(function)
        def start() -> None:
            sys.excepthook = sys.__excepthook__  # imports are done: `end_quietly` is no longer needed
            sys.argv[1:] = [normalise_argument(FLAGS.get(argument, argument)) for argument in sys.argv[1:]]
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # raise errors, instead of hydra's own report
            try:
                main()
            except HydraException as error:
                say_error(in_plain_words(error, name, sys.argv[1:]))
                raise SystemExit(2) from error
            except KeyboardInterrupt as interrupt:
                if not is_follower_rank():
                    print(INTERRUPTED, file=sys.stderr)
                raise SystemExit(128 + signal.SIGINT) from interrupt

        return start

    return decorate


def to_checked_object(config: DictConfig) -> Any:
    """Return a configuration as an object of its dataclass; refuse missing, out-of-range and inconsistent settings."""
    with plain_errors():
        settings: Any = OmegaConf.to_object(config)
        check_settings(settings)
        if hasattr(settings, "check"):
            settings.check()
    return settings


def normalise_argument(argument: str) -> str:
    """Return an argument, rewritten if hydra would misread or refuse it.

    Whole numbers such as 1e6, also in comma-separated lists, are written out in digits, since hydra reads a float. Text
    (`TEXTS`) that hydra would refuse or read as a number is quoted, and a leading ~ replaced by the user's home, unless
    the text contains quotes or the characters of lists and dictionaries.
    """
    name, equals, value = argument.partition("=")
    if not equals:
        return argument
    if override_key(argument) in TEXTS:
        structured = set(value) & set(",[]{}'\"")
        is_text = is_parsable(argument) and not is_number(override_value(argument))
        return argument if structured or is_text else as_override(name, os.path.expanduser(value))
    return f"{name}={','.join(map(_in_digits, value.split(',')))}"


def _in_digits(value: str) -> str:
    return str(int(float(value))) if WHOLE.fullmatch(value) and float(value).is_integer() else value


def in_plain_words(error: HydraException, recipe_name: str, overrides: Sequence[str]) -> str:
    """Return a message that says what is wrong with an override, and what would be right."""
    text, cause = str(error), error.__cause__
    if match := re.search(r"Could not override '(.+?)'", text):
        return no_such_setting(match[1], recipe_name)
    if match := re.search(r"Could not find '(.+)/(.+?)'\n\nAvailable options in '.+?':\n((?:\t.+\n)+)", text):
        group, choice, choices = match[1], match[2], [word for word in match[3].split() if word != "schema"]
        return wrong_choice(group, choice, choices)
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
