"""What the recipes share: from overrides to a run that can be started or continued."""

import sys

from composing.messages import end_quietly, refuse_without_packages

refuse_without_packages()  # before anything needs them

from composing.options import answer_early  # noqa: E402
from dreamer_racing.caches import CacheError, ensure_caches  # noqa: E402
from dreamer_racing.terminal import take_any_terminal  # noqa: E402

take_any_terminal()
answer_early()  # here, because it is before torch is loaded, which takes seconds
try:
    ensure_caches()  # before Matplotlib is loaded
except CacheError as error:
    sys.exit(f"error: {error}")
sys.excepthook = end_quietly

import dreamer_racing.envs  # noqa: E402, F401 - heeds MUJOCO_GL before TorchRL imports MuJoCo
