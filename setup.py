"""What pyproject.toml cannot say: a wheel holds the recipes, the agents and the page of options, inside the package.

A clone has them beside the package, and an editable installation uses them there.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
SHIPPED = ("recipes", "agents", "docs/options.md")


class BuildWithRecipes(build_py):
    """Builds the package, and copies what ships beside it into it."""

    def run(self) -> None:
        """Build."""
        super().run()
        if self.editable_mode:
            return
        package = Path(self.build_lib) / "dreamer_racing"
        for name in SHIPPED:
            if (ROOT / name).is_dir():
                skipped = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / name, package / name, ignore=skipped, dirs_exist_ok=True)
            else:
                (package / name).parent.mkdir(exist_ok=True)
                shutil.copy2(ROOT / name, package / name)


setup(cmdclass={"build_py": BuildWithRecipes})
