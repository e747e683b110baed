"""Alignment from several initial estimates, and further afield where none of them fits."""

from collections.abc import Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.odometry.alignment.alignment import NORMAL, Alignment, Effort, InitialEstimate, align, align_each
from lidarslam.odometry.alignment.sweep_motion import SweepPair

# Several initial estimates are aligned roughly first; the best is aligned anew.
_ROUGH = Effort(iterations=6, column_step=6)
# Initial estimates that differ by less than this converge to the same motion.
_ALIKE_RAD, _ALIKE_M = 0.05, 0.5
# An alignment that explains less is doubtful, and steps along its weakest direction are tried, to either side.
DOUBTFUL = 0.45
STEPS_M: tuple[float, ...] = (0.8, 1.6, 2.4, 3.2)
# By how much more another alignment must explain, for each standard deviation that it is less likely.
_CLEARLY_BETTER = 0.05


def align_best(starts: Sequence[InitialEstimate], sweeps: SweepPair, effort: Effort = NORMAL) -> Alignment:
    """The alignment that explains most, from initial estimates, the most likely first.

    Estimates that differ are aligned roughly, and the best of them well; the less likely one is, the more it must
    explain. If that is doubtful, so are steps along the weakest direction.
    """
    best = align(_choose(starts, sweeps), sweeps, effort)
    if best.explained >= DOUBTFUL or not STEPS_M:
        return best
    other = try_instead(best, _along_weakest(best), sweeps, effort)
    if other is None or other.explained - best.explained <= _CLEARLY_BETTER * _sigmas_away(other, starts):
        return best
    return other


def try_instead(
    best: Alignment, starts: Sequence[FloatArray], sweeps: SweepPair, effort: Effort = NORMAL
) -> Alignment | None:
    """The alignment from the most promising of many motions (4, 4), if it explains clearly more than the best."""
    rough = align_each([InitialEstimate(T) for T in starts], sweeps, _ROUGH)
    start = max(rough, key=lambda alignment: alignment.explained).T_prev_curr
    other = align(InitialEstimate(start), sweeps, effort)
    return other if other.explained - best.explained > _CLEARLY_BETTER else None


def _sigmas_away(alignment: Alignment, starts: Sequence[InitialEstimate]) -> float:
    """Mahalanobis distance from the nearest initial estimate; 0 where none has a covariance."""
    distances = []
    for start in starts:
        if start.information is not None:
            away = log(alignment.T_prev_curr @ inverse(start.T_prev_curr))
            distances.append(float(np.sqrt(away @ start.information @ away)))
    return min(distances, default=0.0)


def _choose(starts: Sequence[InitialEstimate], sweeps: SweepPair) -> InitialEstimate:
    """The first, unless another is not like it and explains more than its likelihood asks for."""
    first = inverse(starts[0].T_prev_curr)
    away = np.array([log(start.T_prev_curr @ first) for start in starts])
    if (np.linalg.norm(away.reshape(-1, 2, 3), axis=2) < (_ALIKE_RAD, _ALIKE_M)).all():
        return starts[0]
    rough = align_each([InitialEstimate(start.T_prev_curr) for start in starts], sweeps, _ROUGH)
    scores = [one.explained - _CLEARLY_BETTER * start.sigmas for one, start in zip(rough, starts, strict=True)]
    return starts[int(np.argmax(scores))]


def _along_weakest(alignment: Alignment) -> list[FloatArray]:
    """The motion (4, 4), moved to and fro along its weakest direction."""
    moved = []
    for step_m in STEPS_M:
        for sign in (1.0, -1.0):
            T = alignment.T_prev_curr.copy()
            T[:3, 3] += sign * step_m * alignment.weakest
            moved.append(T)
    return moved
