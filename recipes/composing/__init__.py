"""Shared code of the recipes: from overrides to a run that can be started or resumed."""

import sys

from composing.messages import end_quietly, refuse_without_packages

refuse_without_packages()  # before anything imports them

from composing.options import handle_help_and_typos  # noqa: E402
from dreamer_racing.caches import CacheError, ensure_caches  # noqa: E402
from dreamer_racing.terminal import take_any_terminal  # noqa: E402

take_any_terminal()
handle_help_and_typos()  # before torch is imported, which takes seconds
try:
    ensure_caches()  # before Matplotlib is loaded
except CacheError as error:
    sys.exit(f"error: {error}")
sys.excepthook = end_quietly

import dreamer_racing.envs  # noqa: E402, F401 - applies MUJOCO_GL before TorchRL imports MuJoCo
