"""Reasons why a vehicle is in its state, or does not arm, as found by `safety.Safety` and its checks."""

from __future__ import annotations

import enum


class Reason(enum.Enum):
    """Why a vehicle is in its state, or does not arm."""

    KILL = "kill"
    NO_ENABLE = "no enable"
    NOT_RELEASED = "enable not released before"
    NOT_REQUESTED = "arming not requested"
    CONTRACT = "contract"
    CLOCK = "clock"
    OVERRUNS = "overruns"
    LINK_LOST = "link lost"
    REFUSED = "refused"
    NOT_FINITE = "pose not finite"
    POSE_JUMP = "pose jump"
    ATTITUDE_JUMP = "attitude jump"
    POSE_CONTRADICTION = "pose contradiction"
    POSE_FROZEN = "pose frozen"
    POSE_STALE = "pose stale"
    POSE_LOST = "pose lost"
    GEOFENCE = "geofence"
    SPEED = "speed"
    TILT = "tilt"
    STRANDED = "stranded"
    NO_SETPOINT = "no setpoint"
    SETPOINT_LOST = "setpoint lost"
    OUTSIDE_START_BOX = "outside start box"
    TURNED_AT_START = "turned at start"
    TILTED_AT_START = "tilted at start"
    MOVING_AT_START = "moving at start"
    ARMING = "arming"
    FINISHED = "finished"


Findings = dict[Reason, str]
"""Reasons found at a tick, each with a message for a person."""
