"""`MUJOCO_GL` and what else MuJoCo, dm_control and PyOpenGL read when they are imported, and fail by.

Physics needs no OpenGL, and images can be drawn in several ways: no such variable is a reason to fly nothing. A value
by which an import fails is left out of account, in this process and those that it starts, and that is said.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys

logger = logging.getLogger(__name__)

VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")

refused: dict[str, str] = {}
"""What was left out of account, `NAME=value`, and why."""


def imports_with_variable(name: str) -> bool:
    """Import a package that reads `MUJOCO_GL`; if that fails, take the variable that is in the way away and say so.

    That is `PYOPENGL_PLATFORM` where the error names it, as MuJoCo's and dm_control's do if it is another platform.

    Raises:
        Exception: what the package raises, where `MUJOCO_GL` is not set.
    """
    value, platform = os.environ.get("MUJOCO_GL"), os.environ.get("PYOPENGL_PLATFORM")
    loaded = set(sys.modules)
    try:
        importlib.import_module(name)
    except Exception as error:  # RuntimeError for a wrong word, ImportError, and AttributeError of PyOpenGL's
        if value is None:
            raise
        reason = f"{type(error).__name__}: {error}"
    else:
        return True
    named = platform is not None and "PYOPENGL_PLATFORM" in reason
    variable, refusal = ("PYOPENGL_PLATFORM", platform) if named else ("MUJOCO_GL", value)
    del os.environ[variable]
    if platform is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)  # set by what failed
    for module in set(sys.modules) - loaded:
        if module.partition(".")[0] == "OpenGL":  # is bound to the platform that it was first imported for
            del sys.modules[module]
    setting = f"{variable}={refusal}"
    if setting not in refused:
        package = name.partition(".")[0]
        logger.warning("%s is left out of account: %s cannot be imported with it (%s).", setting, package, reason)
    refused[setting] = reason
    return False


def heed_variables() -> None:
    """Import MuJoCo now if `MUJOCO_GL` is set, so that those who import it later are not failed by it."""
    while "MUJOCO_GL" in os.environ and "mujoco" not in sys.modules:
        imports_with_variable("mujoco")  # or one variable less is set


def in_the_way(backend: str) -> str:
    """Name what is set and may keep a back end from starting: ` (PYOPENGL_PLATFORM=glx is set)`, or nothing."""
    values = {name: os.environ[name] for name in VARIABLES if os.environ.get(name)}
    named = [f"{name}={value}" for name, value in values.items() if value != backend]
    return f" ({', '.join(named)} {'is' if len(named) == 1 else 'are'} set)" if named else ""
