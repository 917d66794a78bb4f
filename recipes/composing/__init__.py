"""What the recipes share: from overrides to a run that can be started or continued."""

import sys

from composing.interruption import end_quietly
from composing.usage import answer_help
from dreamer_racing.caches import CacheError, ensure_caches

answer_help()  # here, because it is before torch is loaded, which takes seconds
try:
    ensure_caches()  # before Matplotlib is loaded
except CacheError as error:
    sys.exit(f"error: {error}")
sys.excepthook = end_quietly
