"""Loop detection: candidates for each new keyframe, verified one by one, accepted when they are consistent.

Precision comes before recall: a false closure corrupts the map, a missed one leaves it unchanged. A closure
that drift cannot explain is rejected within a segment; where tracking was lost, a new segment begins.
"""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops.candidates import Candidate, KeyframeDatabase, objection_to_drift
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure
from lidarslam.mapping.loops.verification import GUESS_SIGMAS, MIN_INLIERS, Verification, verify

logger = logging.getLogger(__name__)

# Distance after a closure before the next is sought: another would repeat it. After many in a row it is the median
# range: more of them cost time without improving the trajectory.
_SPACING_M = 2.0
_MANY = 40
# A closure near the estimate needs no other while drift is less than this part of the median range.
_ALONE_RANGES = 0.5
# Any other needs this many consistent ones, spread over this distance, in median ranges.
_CONSISTENT, _SPAN_RANGES = 2, 1.0
# Distance after which a closure that no other is consistent with is rejected.
_PENDING_M = 100.0
# A cycle whose standard deviation exceeds this part of the median range closes for any links.
_SIGNIFICANT_RANGES = 0.25
# A closure by appearance needs this many times the support of its rivals, of which the last count.
_OUTVOTED = 3
_RIVALS = 5
# A closure is compared with at most this many of those before it.
_MEMORY = 40
_ALONE = "no other closure agrees"


class LoopDetector(Stateful):
    """Keeps a sparse submap and a descriptor of every keyframe, in its database, and finds loop closures among them."""

    database: KeyframeDatabase
    _accepted: list[LoopClosure]
    _pending: list[LoopClosure]

    def __init__(self, config: LoopConfig, directory: Path | None = None) -> None:
        self._config = config
        self.database = KeyframeDatabase(config, directory)
        self._accepted, self._pending = [], []

    def add(
        self,
        points: FloatArray,
        way_m: float,
        segment: int,
        poses: FloatArray,
        barred: NDArray[np.bool_] | None = None,
    ) -> list[LoopClosure]:
        """Add the next keyframe, and return the closures that are accepted or rejected by now.

        It has a submap (N, 3) in its LiDAR frame, a path length from the start, and a segment, a stretch of continuous
        tracking. Poses (K, 4, 4) are `T_world_lidar` of all keyframes as estimated now, this one last; it is not closed
        with the barred ones (K,).
        """
        self.database.add(points, way_m, segment, poses)
        decided = self._drop_old(way_m, segment)
        if len(self.database.submaps[-1]) >= MIN_INLIERS and not self._is_soon(way_m, segment):
            decided += self._look(len(self.database) - 1, barred)
        return decided

    def close(self, first: int, second: int, given: tuple[int, int]) -> LoopClosure:
        """A closure of two keyframes that is given by two scans: accepted where the submaps fit from some start.

        Neither drift nor other closures object to it.
        """
        target, source = self.database.cloud(first), self.database.cloud(second)
        starts, least = self.database.starts(first, second), self._config.min_overlap
        found = [one for start in starts if (one := verify(target, source, start)) is not None]
        if not found:
            far = np.diag(GUESS_SIGMAS**2)
            return LoopClosure(first, second, starts[0], far, 0.0, np.inf, 0.0, False, 0, "nothing in common", given)
        best = max(found, key=lambda one: (not one.objection(least), one.information))
        closure = _closure(Candidate(first, False, best.T_target_source), second, best)
        closure = replace(closure, reason=best.objection(least), given=given)
        if closure.accepted:
            self._accepted.append(closure)
        return closure

    def finish(self) -> list[LoopClosure]:
        """Closures that no other agreed with to the end, as rejected."""
        left, self._pending = self._pending, []
        return [replace(closure, reason=_ALONE) for closure in left]

    def _is_soon(self, way_m: float, segment: int) -> bool:
        """Whether the last closure is so recent that another would repeat it."""
        if self._pending or not self._accepted:
            return False
        track, range_m = self.database.track, self.database.submaps[-1].range_m
        since_m = [way_m - track.way_m[one.second] for one in self._accepted[-_MANY:]]
        are_many = len(since_m) == _MANY and since_m[0] < _MANY * range_m
        spacing_m = max(_SPACING_M, range_m) if are_many else _SPACING_M
        return bool(track.segment[self._accepted[-1].second] == segment and since_m[-1] < spacing_m)

    def _look(self, index: int, barred: NDArray[np.bool_] | None) -> list[LoopClosure]:
        """Verify a keyframe's candidates, and decide on those that pass."""
        decided: list[LoopClosure] = []
        source = self.database.cloud(index)
        for candidate in self.database.candidates(index, barred):
            found = verify(self.database.cloud(candidate.index), source, candidate.T_first_second)
            if found is None:
                continue
            closure = _closure(candidate, index, found)
            reason = found.objection(self._config.min_overlap)
            reason = reason or objection_to_drift(closure, closure.by_appearance, self.database.track)
            pair = f"loop closure between keyframes {closure.first} and {index}"
            logger.info("%s: %s (overlap %.2f)", pair, reason or "verified", found.overlap)
            if reason:
                decided.append(replace(closure, reason=reason))
                continue
            self._pending.append(closure)
            accepted = self._accept_supported()
            decided += accepted
            if any(one.second == index for one in accepted):
                break
        return decided

    def _accept_supported(self) -> list[LoopClosure]:
        """Accept pending closures that have enough support, until nothing changes."""
        accepted: list[LoopClosure] = []
        while found := next(((c, n) for c in self._pending if (n := self._support(c)) is not None), None):
            self._pending.remove(found[0])
            accepted.append(replace(found[0], consistent=found[1]))
            self._accepted.append(accepted[-1])
        return accepted

    def _support(self, closure: LoopClosure) -> int | None:
        """The number of other closures that agree, pending ones too; None where they are too few to accept it."""
        track, range_m = self.database.track, self.database.submaps[closure.second].range_m
        agreeing, against = self._votes(closure)
        # A rival has as much weight as it has support itself: a false closure mostly stands alone. Where places repeat,
        # false ones agree among themselves; then the estimate decides.
        rival = max((len(self._votes(other)[0]) for other in against[-_RIVALS:]), default=0)
        if against and rival * (_OUTVOTED if closure.by_appearance else 1) >= max(len(agreeing), 1):
            return None
        ways_m = track.way_m[[closure.second, *(other.second for other in agreeing)]]
        is_near = not closure.by_appearance and track.drift_m(closure.first, closure.second) < _ALONE_RANGES * range_m
        is_shared = len(agreeing) >= _CONSISTENT and float(np.ptp(ways_m)) >= _SPAN_RANGES * range_m
        return len(agreeing) if is_near or is_shared else None

    def _votes(self, closure: LoopClosure) -> tuple[list[LoopClosure], list[LoopClosure]]:
        """Other closures that agree with one, and that contradict it, where their cycle is significant."""
        track = self.database.track
        most_m = _SIGNIFICANT_RANGES * self.database.submaps[closure.second].range_m
        agreeing: list[LoopClosure] = []
        against: list[LoopClosure] = []
        for other in [*self._accepted[-_MEMORY:], *self._pending[-_MEMORY:]]:
            cycle = None if other is closure else track.close_cycle(closure, other)
            if cycle is not None and cycle[1] <= most_m:
                (agreeing if cycle[0] < CHI_SQUARED_99 else against).append(other)
        return agreeing, against

    def _drop_old(self, way_m: float, segment: int) -> list[LoopClosure]:
        """Closures that no other agreed with for too long, as rejected."""
        track = self.database.track
        ends = [closure.second for closure in self._pending]
        is_old = (track.segment[ends] != segment) | (way_m - track.way_m[ends] > _PENDING_M)
        pending, self._pending = self._pending, [self._pending[n] for n in np.flatnonzero(~is_old)]
        return [replace(pending[n], reason=_ALONE) for n in np.flatnonzero(is_old)]


def _closure(candidate: Candidate, second: int, found: Verification) -> LoopClosure:
    return LoopClosure(
        candidate.index, second, found.T_target_source, found.covariance, found.overlap, found.residual_m,
        found.inlier_ratio, candidate.by_appearance, 0, "",
    )  # fmt: skip
