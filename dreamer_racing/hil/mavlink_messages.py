"""Import of MAVLink's message definitions, for the link and for the pose source."""

from __future__ import annotations

from typing import Any

from dreamer_racing.commands import install_extra


def import_messages(who: str) -> Any:
    """Return the module of MAVLink 2's common messages.

    Args:
        who: What needs it, for the error message.

    Raises:
        ImportError: pymavlink is not installed.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise ImportError(f"{who} needs pymavlink: {install_extra('hil')}.") from error
    return common
