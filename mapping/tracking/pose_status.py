"""What to tell of a scan's pose: whether to believe it, and in words that a person understands, why not."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from mapping.config import TrackingConfig
from mapping.prediction import Prediction
from mapping.tracking.attempts import Placed

# A pose so far from where it was expected, in standard deviations and at least in degrees and metres, is suspicious
# however it fits.
_MOST_SIGMAS = 5.0
_LEAST_JUMP = np.array([np.deg2rad(10.0)] * 3 + [0.5] * 3)


@dataclass(frozen=True)
class Circumstances:
    """Under which a scan was laid on the map.

    Attributes:
        found: it was found by looking around.
        unconfirmed: too few scans since then have confirmed that.
        adrift: the map was begun anew, and nobody knows where it lies beside the one before.
        unexpected: it was found where odometry and motion before did not lead to.
    """

    found: bool = False
    unconfirmed: bool = False
    adrift: bool = False
    unexpected: bool = False


def has_jumped(correction: FloatArray, prediction: Prediction) -> bool:
    """Whether a pose lies farther (6,) from where it was expected than any carrier explains."""
    usual = np.maximum(_MOST_SIGMAS * np.sqrt(np.diag(prediction.covariance)[:6]), _LEAST_JUMP)
    return bool((np.abs(correction) > usual).any())


def judge(
    placed: Placed, correction: FloatArray, jumped: bool, now: Circumstances, config: TrackingConfig
) -> tuple[Status, str]:
    """The fit decides; degraded is also what fits far from where it was expected, and what the prior holds.

    Args:
        placed: the scan, laid on the map.
        correction: (6,) from where it was expected.
        jumped: whether that is more than any carrier explains.
        now: what else there is to know.
        config: when a fit is good.
    """
    if placed.status is not Status.OK:
        return placed.status, placed.fit.explain(config)
    assert placed.refined is not None
    message = ""
    angle_deg, distance_m = np.rad2deg(np.linalg.norm(correction[:3])), np.linalg.norm(correction[3:])
    where = f"{angle_deg:.0f} deg and {distance_m:.2f} m from where it was expected"
    if now.found:
        message = f"found again in the map, {where}; the next scans must confirm it"
    elif jumped:
        message = where
    elif now.unconfirmed:
        message = "found again a moment ago, and not yet confirmed"
    elif placed.rivalled:
        message = "the scene repeats itself: another motion since the last scan fits nearly as well"
    elif now.unexpected:
        message = "it fits where neither the odometry nor the motion before lead to"
    elif now.adrift:
        message = "in a map begun anew; where it lies beside the one before is a guess"
    elif names := placed.refined.degeneracy.names:
        message = f"nothing to see along {', '.join(names)}; the prior was kept"
    return (Status.DEGRADED if message else Status.OK), message
