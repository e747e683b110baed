"""When the poses of a running graph are optimised: not at every loop closure of a long recording."""

from collections.abc import Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.state.stateful import Stateful
from lidarslam.mapping.loops.closure import LoopClosure

# An optimisation takes time in proportion to the keyframes, so the next one waits for this part of their number: its
# time for each keyframe, some 15 ms, does not grow. With 10,000 keyframes that is a wait of some 100 m.
_PART = 200


class RelaxSchedule(Stateful):
    """Collects accepted loop closures until the poses are optimised with them."""

    _waiting: list[LoopClosure]
    _keyframes: int  # when they were optimised last

    def __init__(self) -> None:
        self._waiting, self._keyframes = [], 0

    def is_due(self, found: Sequence[LoopClosure], poses: Sequence[FloatArray]) -> bool:
        """Whether to optimise now: a closure contradicts the poses (4, 4) of all keyframes, which are enough by now.

        Args:
            found: closures since the last call, rejected ones too.
            poses: as estimated now.
        """
        self._waiting += [closure for closure in found if closure.accepted]
        if _PART * (len(poses) - self._keyframes) < len(poses):
            return False
        waiting, self._waiting = self._waiting, []
        if not any(_contradicts(closure, poses) for closure in waiting):
            return False
        self._keyframes = len(poses)
        return True


def _contradicts(closure: LoopClosure, poses: Sequence[FloatArray]) -> bool:
    """Whether a closure is farther from the present poses than its own deviation: only then it moves them."""
    error = log(inverse(poses[closure.first] @ closure.T_first_second) @ poses[closure.second])
    return float(error @ np.linalg.solve(closure.covariance, error)) > len(error)
