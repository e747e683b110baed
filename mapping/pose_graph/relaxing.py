"""When the poses of a running graph are optimised: not at every loop closure of a long recording."""

from collections.abc import Sequence

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Stateful
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.pose_graph.edges import squared_error

# An optimisation takes time in proportion to the keyframes. The next one waits for the hundredth part of their number,
# so that its time for each keyframe does not grow: none waits with 100 keyframes, 300 m or so with 10,000.
_PART = 100
# Only a closure farther from the present poses than its own deviation moves them: squared, in six dimensions.
_DEVIATIONS = 6.0


class RelaxSchedule(Stateful):
    """Collects accepted loop closures until the poses are optimised with them."""

    _waiting: list[LoopClosure]
    _keyframes: int  # when they were optimised last

    def __init__(self) -> None:
        self._waiting, self._keyframes = [], 0

    @property
    def waiting(self) -> Sequence[LoopClosure]:
        """Closures that the poses are not optimised with yet."""
        return self._waiting

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
        if not any(squared_error(closure, poses) > _DEVIATIONS for closure in waiting):
            return False
        self._keyframes = len(poses)
        return True
