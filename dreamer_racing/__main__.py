"""Start a recipe by its name: `python -m dreamer_racing dreamer_v3 track=kidney`, with a clone or without.

An installed package holds the recipes; a clone has them beside the package.
"""

import ast
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

from dreamer_racing.settings import suggestion
from dreamer_racing.terminal import take_any_terminal

PACKAGE = Path(__file__).resolve().parent


def recipes_folder() -> Path:
    """Return the folder of the recipes.

    Raises:
        FileNotFoundError: This installation has none.
    """
    for folder in (PACKAGE / "recipes", PACKAGE.parent / "recipes"):
        if (folder / "composing").is_dir():
            return folder
    raise FileNotFoundError(f"There are no recipes in {PACKAGE} or beside it: install dreamer_racing again.")


def usage(folder: Path) -> Iterator[str]:
    """Yield the lines of the help: every recipe with the first line of its docstring."""
    yield from ("usage: python -m dreamer_racing RECIPE [NAME=VALUE ...]", "")
    for path in sorted(folder.glob("*.py")):
        said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        yield f"  {path.stem:<16}{said.partition(chr(10))[0]}"
    yield from ("", "python -m dreamer_racing RECIPE --help has the options of one.")


def main() -> None:
    """Run the recipe that the command line names, as `python recipes/RECIPE.py` does."""
    take_any_terminal()
    folder = recipes_folder()
    name, *overrides = sys.argv[1:] or ["--help"]
    if name in ("--help", "-h"):
        sys.stdout.write("\n".join((*usage(folder), "")))
        return
    names = sorted(path.stem for path in folder.glob("*.py"))
    if name not in names:
        sys.stderr.write(f"error: {name}: no such recipe{suggestion(name, names)}; {', '.join(names)}.\n")
        raise SystemExit(2)
    script = str(folder / f"{name}.py")
    sys.path.insert(0, str(folder))  # as Python does for a script
    sys.argv = [script, *overrides]
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    main()
