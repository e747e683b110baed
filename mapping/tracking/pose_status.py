"""Status of a registered pose, with the reason in words."""

import numpy as np

from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.tracking.attempt import Attempt
from lidarslam.mapping.tracking.tracking_state import TrackingState

# At the end of the messages of scans that are degraded for no other reason.
NOT_CONFIRMED = "not confirmed yet"


def judge(
    attempt: Attempt, state: TrackingState, unexpected: bool, adrift: bool, config: TrackingConfig
) -> tuple[Status, str]:
    """The status of the fit; degraded as well for a pose that is unconfirmed, ambiguous or unconstrained.

    Args:
        attempt: registered.
        state: updated with the attempt.
        unexpected: whether odometry and last motion predicted another pose.
        adrift: whether the map is a new one, at an unknown pose in the one before.
        config: thresholds of the fit.
    """
    if attempt.status is not Status.OK:
        return attempt.status, attempt.fit.explain(config)
    assert attempt.registration is not None
    message, correction = "", attempt.correction
    angle_deg, distance_m = np.rad2deg(np.linalg.norm(correction[:3])), np.linalg.norm(correction[3:])
    where = f"{angle_deg:.0f} deg and {distance_m:.2f} m from the prediction"
    if attempt.relocalised:
        message = f"relocalised in the map, {where}; {NOT_CONFIRMED}"
    elif attempt.has_jumped:
        message = where
    elif state.is_unconfirmed:
        message = f"relocalised a moment ago; {NOT_CONFIRMED}"
    elif attempt.ambiguous:
        message = "the scene is repetitive: another motion since the last scan fits nearly as well"
    elif unexpected:
        message = "registered, but neither odometry nor last motion predicted this pose"
    else:
        message = _reservation(attempt.registration.degeneracy.names, attempt.unconstrained, adrift)
    return (Status.DEGRADED if message else Status.OK), message


def _reservation(degenerate: tuple[str, ...], unconstrained: tuple[str, ...], adrift: bool) -> str:
    """Why a scan that fits the map near its prediction is degraded nevertheless; empty where it is not."""
    if adrift:
        return "in a new map; its pose in the map before is unknown"
    if degenerate:
        return f"degenerate along {', '.join(degenerate)}: the prediction was kept"
    return f"hardly constrained along {', '.join(unconstrained)}: it may slide" if unconstrained else ""
