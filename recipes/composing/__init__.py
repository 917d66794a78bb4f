"""What the recipes share: from overrides to a run that can be started or continued."""

import sys

from composing.interruption import end_quietly
from composing.usage import answer_help

answer_help()  # here, because it is before torch is loaded, which takes seconds
sys.excepthook = end_quietly
