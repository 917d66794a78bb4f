"""Write docs/options.md from the recipes' dataclasses: every option, its default, what it may be, and its meaning.

python docs/options.py            # write the page
python docs/options.py --check    # exit with status 2 if it is not up to date
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

RECIPES = Path(__file__).resolve().parents[1] / "recipes"
sys.path.append(str(RECIPES))  # where the next one is found

from composing.options import Option, common_options, options  # noqa: E402

PAGE = Path(__file__).with_name("options.md")
FIRST = ("dreamer_v3", "latent_ppo", "ppo", "sac", "experiment", "evaluate", "perception", "export", "plot")
HEAD = """# Options

Made by `python docs/options.py` from [recipes/composing/schema.py](../recipes/composing/schema.py) and the recipes:
change those, not this page. `--help` of a recipe says the same. Options are [hydra](https://hydra.cc) overrides,
`env.num_envs=64` or, for a whole group, `model=size12m`; the groups are the folders of
[recipes/config](../recipes/config). What is "chosen" is settled by the recipe when it starts, by device, size or
budget, and printed. A wrong name, type or value is refused with the field named.
"""


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only compare")
    arguments = parser.parse_args()
    text = make_page()
    if not arguments.check:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        parser.error(f"docs/{PAGE.name} is not what the dataclasses make: run python docs/options.py.")


def make_page() -> str:
    """Return the whole page."""
    shared = common_options()
    recipes = [*FIRST, *sorted(path.stem for path in RECIPES.glob("*.py") if path.stem not in FIRST)]
    parts = [HEAD, section("All training recipes", shared)]
    for name in recipes:
        found = options(name)
        trains = {option.name for option in shared} <= {option.name for option in found}
        parts.append(section(f"`recipes/{name}.py`", [option for option in found if not (trains and option in shared)]))
    return "\n".join(parts)


def section(title: str, found: Sequence[Option]) -> str:
    """Return a heading and a table."""
    lines = [f"## {title}", "", "| option | default | may be | |", "|---|---|---|---|"]
    for option in found:
        cells = (f"`{option.name}=`", option.default, option.allowed, option.meaning.replace("|", "\\|"))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
