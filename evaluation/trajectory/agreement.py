"""Whether two trajectories are of one drive at all: errors of unrelated ones are numbers without a meaning."""

import numpy as np

from evaluation.trajectory.metrics import TrajectoryMetrics
from lidarslam.core.geometry import FloatArray

# An estimate that stood still would be off by the whole spread; one of another place by more.
_UNRELATED_SHARE = 0.5
# Sensors that stay on one spot have no spread to compare with.
_NEGLIGIBLE_M = 0.1
# Spreads of one drive in two units, of which metres and millimetres are the likeliest.
_OTHER_UNIT = 20.0


def disagreement(metrics: TrajectoryMetrics) -> str | None:
    """What is wrong with an alignment that did not succeed, in a sentence; None where the trajectories agree.

    They agree while the error after alignment is less than half of the reference's spread, the root mean square
    distance of its positions from their middle.
    """
    spread_m = _spread_m(metrics.association.reference.positions)
    error_m = metrics.errors.ate_rmse_m
    if error_m <= max(_UNRELATED_SHARE * spread_m, _NEGLIGIBLE_M):
        return None
    own_spread_m = _spread_m(metrics.association.estimate.positions)
    said = (
        f"the trajectory does not follow its reference: {error_m:.3g} m off (RMSE), where the reference itself spreads"
        f" over {spread_m:.3g} m"
    )
    if min(spread_m, own_spread_m) > 0.0 and max(spread_m / own_spread_m, own_spread_m / spread_m) > _OTHER_UNIT:
        return f"{said} and the trajectory over {own_spread_m:.3g} m; are both in metres?"
    return f"{said}; tracking was lost, or the reference belongs to another recording or sensor"


def _spread_m(positions: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))
