"""How well a scan was tracked."""

from enum import Enum


class Status(str, Enum):
    """What to believe of a scan's pose.

    `ok`: it fits what was seen before. `degraded`: it fits badly, or only in some directions. `lost`: it does not fit;
    the pose is a prediction.
    """

    OK = "ok"
    DEGRADED = "degraded"
    LOST = "lost"
