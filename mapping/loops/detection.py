"""Loop detection: candidates for each new keyframe, verified one by one, accepted when they are consistent.

Candidates are earlier keyframes near the estimate, and earlier keyframes with a similar descriptor. Precision comes
before recall: a false closure corrupts the map, a missed one leaves it unchanged. A closure that drift cannot explain
is rejected within a segment; where tracking was lost, a new segment begins.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops.birds_eye_view import BirdsEyeView, align, compare
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, LoopClosure, RelativePose, Track
from lidarslam.mapping.loops.sparse_submap import SparseSubmap, SubmapFile
from lidarslam.mapping.loops.verification import GUESS_SIGMAS, MIN_INLIERS, SubmapCloud, Verification, verify

logger = logging.getLogger(__name__)

# Shorter paths back are no loops, in median ranges and in metres.
_MIN_WAY_RANGES, _MIN_WAY_M = 3.0, 10.0
# Candidates of either kind that are verified: each costs some 30 ms.
_NEARBY_CANDIDATES = _APPEARANCE_CANDIDATES = 2
# Least correlation of similar descriptors.
_MIN_SIMILARITY = 0.35
# Keyframes on either side whose points help in the registration.
_NEIGHBOURS = 2
# Radius of descriptors, in median ranges of the first keyframe.
_RADIUS_PER_RANGE = 4.0
# The heading around a nearby keyframe's estimate that is searched, in standard deviations and at least in radians.
_YAW_SIGMAS = 2.0
_YAW_MIN = np.deg2rad(6.0)
_YAW_TRIES = 5
# Turns of a closure that is given, all around, and sectors of them that each make a start.
_ALL_YAWS, _SECTORS = 72, 12
# Keyframes closer to one another than this count as one candidate.
_APART = 3
# Standard deviation of a guess from two views: radians, and of the median range.
_ROUGH_RAD = np.deg2rad(10.0)
_ROUGH_RANGES = 0.3
# A second place whose score comes this near to the best one's makes both ambiguous.
_AMBIGUOUS = 0.9
# Standard deviations of drift that a closure may correct: a candidate by appearance may be anywhere.
_MAX_SIGMAS, _MAX_SIGMAS_BY_APPEARANCE = 3.0, 2.0
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


@dataclass(frozen=True, eq=False)
class Candidate:
    """An earlier keyframe, and a rough guess `T_first_second` (4, 4) of where the new one lies from it."""

    index: int
    by_appearance: bool
    T_first_second: FloatArray


def objection_to_drift(link: RelativePose, by_appearance: bool, track: Track) -> str:
    """Why drift does not explain a link; empty when it does, and between segments."""
    sigmas = track.correction_sigmas(link)
    if sigmas <= (_MAX_SIGMAS_BY_APPEARANCE if by_appearance else _MAX_SIGMAS):
        return ""
    way_m = track.way_m[link.second] - track.way_m[link.first]
    return f"corrects {sigmas:.1f} standard deviations of the drift over {way_m:.0f} m"


class KeyframeDatabase(Stateful):
    """Sparse submaps and descriptors of all keyframes, and the search among them."""

    track: Track  # the present estimates

    def __init__(self, config: LoopConfig, directory: Path | None = None) -> None:
        self._config = config
        self.track = Track(np.empty((0, 4, 4)), np.empty(0), np.empty(0, dtype=np.int64), config.drift_rates)
        self.submaps = SubmapFile(directory)
        self._descriptors = np.empty((0, 1, 1), dtype=np.complex64)  # (N, ...), with room for more keyframes

    def __len__(self) -> int:
        return len(self.submaps)

    @property
    def radius_m(self) -> float:
        """How far descriptors reach; follows the first keyframe that has points."""
        submaps = (self.submaps[index] for index in range(len(self)))
        return next((_RADIUS_PER_RANGE * submap.range_m for submap in submaps if len(submap)), 1.0)

    def add(self, points: FloatArray, way_m: float, segment: int, poses: FloatArray) -> None:
        """Add a keyframe: its submap (N, 3), path length and segment, and the present estimates (K, 4, 4) of all."""
        self.keep(points)
        ways_m, segments = np.append(self.track.way_m, way_m), np.append(self.track.segment, segment)
        self.track = Track(poses, ways_m, segments, self.track.drift_rates)

    def keep(self, points: FloatArray) -> None:
        """Keep the submap (N, 3) of the next keyframe, whose estimate is known or follows."""
        self.submaps.append(SparseSubmap.of(points, self._config.max_range_m))
        descriptor = BirdsEyeView.of(self.submaps[-1]).descriptor(self.radius_m)
        if len(self) > len(self._descriptors):
            room = np.zeros((max(64, 2 * len(self)), *descriptor.shape), dtype=np.complex64)
            room[: len(self) - 1] = self._descriptors[: len(self) - 1].reshape(-1, *descriptor.shape)
            self._descriptors = room
        self._descriptors[len(self) - 1] = descriptor

    def cloud(self, index: int) -> SubmapCloud:
        """A keyframe with those before and after it in its segment."""
        track, last = self.track, len(self) - 1
        reach = range(max(0, index - _NEIGHBOURS), min(last, index + _NEIGHBOURS) + 1)
        around = [i for i in reach if i != index and track.segment[i] == track.segment[index]]
        return SubmapCloud.join(
            self.submaps[index],
            [(track.between(index, i), self.submaps[i]) for i in around],
            [float(track.way_m[i] - track.way_m[index]) for i in around],
            track.drift_rates,
        )

    def candidates(self, index: int, barred: NDArray[np.bool_] | None = None) -> Iterator[Candidate]:
        """Candidates for a keyframe, the likeliest first, without those of a mask (K,)."""
        track = self.track
        min_way_m = self._config.min_way_m
        if min_way_m is None:
            min_way_m = max(_MIN_WAY_M, _MIN_WAY_RANGES * self.submaps[index].range_m)
        others = np.arange(index)
        elsewhere = track.segment[others] != track.segment[index]
        chosen = elsewhere | (track.way_m[index] - track.way_m[others] > min_way_m)
        others = others[chosen if barred is None else chosen & ~barred[:index]]
        if len(others):
            yield from self._nearby(index, others)
            yield from self._alike(index, others)

    def _compare(self, view: BirdsEyeView, others: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        is_run = others[-1] - others[0] == len(others) - 1  # as within one segment: a view of them is no copy
        chosen = self._descriptors[slice(others[0], others[-1] + 1) if is_run else others]
        return compare(view.descriptor(self.radius_m), chosen)

    def _nearby(self, index: int, others: NDArray[np.intp]) -> Iterator[Candidate]:
        """Earlier keyframes of the segment within reach of the estimate."""
        track, submap = self.track, self.submaps[index]
        others = others[track.segment[others] == track.segment[index]]
        _, translation = track.drift(others, index)
        distance = np.linalg.norm(track.T_world_lidar[others, :3, 3] - track.T_world_lidar[index, :3, 3], axis=1)
        within = distance < submap.range_m + 2.0 * translation
        if not within.any():
            return
        others, translation, distance = others[within], translation[within], distance[within]
        similarity, _ = self._compare(BirdsEyeView.of(submap), others)
        # The nearest while drift is small, the most similar once it is large.
        cost = distance / (submap.range_m + translation) - similarity
        for k in _spread(others, cost, _NEARBY_CANDIDATES):
            yield Candidate(int(others[k]), False, self._near_estimate(int(others[k]), index))

    def _near_estimate(self, first: int, second: int) -> FloatArray:
        """`T_first_second` (4, 4) by aligning the views, within standard deviations of the drift."""
        estimate = self.track.between(first, second)
        rotation, translation = (float(sigma[0]) for sigma in self.track.drift(np.array([first]), second))
        target, source = (BirdsEyeView.of(self.submaps[index]) for index in (first, second))
        level = target.R_level_lidar @ estimate[:3, :3] @ source.R_level_lidar.T
        half = max(_YAW_MIN, _YAW_SIGMAS * rotation)
        yaws = np.arctan2(level[1, 0], level[0, 0]) + np.linspace(-half, half, _YAW_TRIES)
        expected_xy = (target.R_level_lidar @ estimate[:3, 3])[:2]
        return align(target, source, yaws, self.radius_m, expected_xy, 2.0 * translation)[0]

    def starts(self, first: int, second: int) -> list[FloatArray]:
        """`T_first_second` (4, 4) to begin with: estimated, of views aligned within the drift, and in each sector."""
        target, source = (BirdsEyeView.of(self.submaps[index]) for index in (first, second))
        sectors = np.linspace(-np.pi, np.pi, _ALL_YAWS, endpoint=False).reshape(_SECTORS, -1)
        return [
            self.track.between(first, second),
            self._near_estimate(first, second),
            *(align(target, source, yaws, self.radius_m)[0] for yaws in sectors),
        ]

    def _alike(self, index: int, others: NDArray[np.intp]) -> list[Candidate]:
        """Earlier keyframes with similar descriptors; sensors of other segments may be mounted upside down."""
        elsewhere = others[self.track.segment[others] != self.track.segment[index]]
        found = [*self._similar(index, others), *self._similar(index, elsewhere, upside_down=True)]
        found.sort(key=lambda pair: -pair[0])
        rough = np.diag(np.repeat([_ROUGH_RAD**2, (_ROUGH_RANGES * self.submaps[index].range_m) ** 2], 3))
        links = [RelativePose(candidate.index, index, candidate.T_first_second, rough) for _, candidate in found]
        is_plausible = [not objection_to_drift(link, True, self.track) for link in links]
        plausible = list(compress(found, is_plausible))
        if self._is_ambiguous(plausible, index):
            return []
        return [candidate for _, candidate in plausible[:_APPEARANCE_CANDIDATES]]

    def _similar(
        self, index: int, others: NDArray[np.intp], upside_down: bool = False
    ) -> Iterator[tuple[float, Candidate]]:
        """The most similar keyframes, aligned by their views, with the scores of these alignments."""
        if not len(others):
            return
        source = BirdsEyeView.of(self.submaps[index], upside_down)
        similarity, turn = self._compare(source, others)
        for k in _spread(others, -similarity, 2 * _APPEARANCE_CANDIDATES):
            if similarity[k] < _MIN_SIMILARITY:
                break
            target = BirdsEyeView.of(self.submaps[others[k]])
            guess, score = align(target, source, turn[k] + np.array([0.0, np.pi]), self.radius_m)
            yield score, Candidate(int(others[k]), True, guess)

    def _is_ambiguous(self, found: list[tuple[float, Candidate]], index: int) -> bool:
        """Whether a second place in the segment of the best candidate has nearly its score."""
        track, range_m = self.track, self.submaps[index].range_m
        for score, other in found[1:]:
            best = found[0][1]
            between = inverse(best.T_first_second) @ track.between(best.index, other.index) @ other.T_first_second
            apart_m = 2.0 * _ROUGH_RANGES * range_m + 2.0 * track.drift_m(best.index, other.index)
            is_rival = track.segment[other.index] == track.segment[best.index] and score > _AMBIGUOUS * found[0][0]
            if is_rival and np.linalg.norm(between[:3, 3]) > apart_m:
                return True
        return False


def _spread(indices: NDArray[np.intp], cost: FloatArray, count: int) -> list[int]:
    """The few that cost least, no two of them next to one another."""
    chosen: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        if len(chosen) == count:
            break
        if all(abs(int(indices[k]) - int(indices[c])) >= _APART for c in chosen):
            chosen.append(int(k))
    return chosen


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
        self, points: FloatArray, way_m: float, segment: int, poses: FloatArray, barred: NDArray[np.bool_] | None = None
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
        track, range_m = self.database.track, self.database.submaps[-1].range_m
        latest = [one.second for one in self._accepted[-_MANY:] if track.segment[one.second] == segment]
        if self._pending or not latest:
            return False
        since_m = way_m - track.way_m[latest]
        are_many = len(latest) == _MANY and since_m[0] < _MANY * range_m
        return bool(since_m[-1] < (max(_SPACING_M, range_m) if are_many else _SPACING_M))

    def _look(self, index: int, barred: NDArray[np.bool_] | None) -> list[LoopClosure]:
        """Verify a keyframe's candidates, and decide on those that pass."""
        decided: list[LoopClosure] = []
        source: SubmapCloud | None = None  # most keyframes have no candidate
        for candidate in self.database.candidates(index, barred):
            source = source or self.database.cloud(index)
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
