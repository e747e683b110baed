"""Tracking status."""

from enum import StrEnum


class Status(StrEnum):
    """Quality of a scan's pose.

    `ok`: the scan fits the map. `degraded`: it fits badly, or only some directions are constrained. `lost`: it does not
    fit, and the pose is a prediction.
    """

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"
