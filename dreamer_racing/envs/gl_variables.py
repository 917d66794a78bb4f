"""OpenGL environment variables with which the import of MuJoCo, dm_control or PyOpenGL can fail, such as `MUJOCO_GL`.

Physics needs no OpenGL and images can be rendered in several ways, so a bad value must not stop the program. A value
that makes an import fail is unset for this process and its children, with a warning.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys

logger = logging.getLogger(__name__)

VARIABLES = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")

unset_variables: dict[str, str] = {}
"""Settings that were unset, as `NAME=value`, and the reason for each."""


def imports_with_variable(name: str) -> bool:
    """Import a package that reads `MUJOCO_GL` and return True; if that fails, unset the variable, warn, return False.

    The variable is `PYOPENGL_PLATFORM` if the error names it, as those of MuJoCo and dm_control do on a mismatch.

    Raises:
        Exception: the package's own error, if `MUJOCO_GL` is not set.
    """
    value, platform = os.environ.get("MUJOCO_GL"), os.environ.get("PYOPENGL_PLATFORM")
    loaded = set(sys.modules)
    try:
        importlib.import_module(name)
    except Exception as error:  # RuntimeError for an unknown value, ImportError, PyOpenGL's AttributeError
        if value is None:
            raise
        reason = f"{type(error).__name__}: {error}"
    else:
        return True
    named = platform is not None and "PYOPENGL_PLATFORM" in reason
    variable, refusal = ("PYOPENGL_PLATFORM", platform) if named else ("MUJOCO_GL", value)
    del os.environ[variable]
    if platform is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)  # set by the failed import
    for module in set(sys.modules) - loaded:
        if module.partition(".")[0] == "OpenGL":  # is bound to the platform of its first import
            del sys.modules[module]
    setting = f"{variable}={refusal}"
    if setting not in unset_variables:
        package = name.partition(".")[0]
        logger.warning("%s is ignored: %s cannot be imported with it (%s).", setting, package, reason)
    unset_variables[setting] = reason
    return False


def validate_gl_variables() -> None:
    """Import MuJoCo now if `MUJOCO_GL` is set, so that a bad value cannot break a later import."""
    while "MUJOCO_GL" in os.environ and "mujoco" not in sys.modules:
        imports_with_variable("mujoco")  # each failure unsets one variable, so the loop ends


def describe_conflicts(backend: str) -> str:
    """Name the variables that may keep a backend from starting: ` (PYOPENGL_PLATFORM=glx is set)`, or ""."""
    values = {name: os.environ[name] for name in VARIABLES if os.environ.get(name)}
    named = [f"{name}={value}" for name, value in values.items() if value != backend]
    return f" ({', '.join(named)} {'is' if len(named) == 1 else 'are'} set)" if named else ""
