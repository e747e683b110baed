"""Loop candidates: earlier keyframes near the estimate, and earlier keyframes with a similar descriptor."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Stateful
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops.bird_eye_view import BirdEyeView, align, compare
from lidarslam.mapping.loops.closure import RelativePose, Track
from lidarslam.mapping.loops.sparse_submap import SparseSubmap, SubmapFile
from lidarslam.mapping.loops.verification import SubmapCloud

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
        track = self.track
        self.keep(points)
        way_m_all, segments = np.append(track.way_m, way_m), np.append(track.segment, segment)
        self.track = Track(poses, way_m_all, segments, track.drift_rates)

    def keep(self, points: FloatArray) -> None:
        """Keep the submap (N, 3) of the next keyframe, whose estimate is known or follows."""
        self.submaps.append(SparseSubmap.of(points, self._config.max_range_m))
        descriptor = BirdEyeView.of(self.submaps[-1]).descriptor(self.radius_m)
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

    def _compare(self, view: BirdEyeView, others: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
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
        similarity, _ = self._compare(BirdEyeView.of(submap), others)
        # The nearest while drift is small, the most similar once it is large.
        cost = distance / (submap.range_m + translation) - similarity
        for k in _spread(others, cost, _NEARBY_CANDIDATES):
            yield Candidate(int(others[k]), False, self._near_estimate(int(others[k]), index))

    def _near_estimate(self, first: int, second: int) -> FloatArray:
        """`T_first_second` (4, 4) by aligning the views, within standard deviations of the drift."""
        estimate = self.track.between(first, second)
        rotation, translation = (float(sigma[0]) for sigma in self.track.drift(np.array([first]), second))
        target, source = (BirdEyeView.of(self.submaps[index]) for index in (first, second))
        level = target.R_level_lidar @ estimate[:3, :3] @ source.R_level_lidar.T
        half = max(_YAW_MIN, _YAW_SIGMAS * rotation)
        yaws = np.arctan2(level[1, 0], level[0, 0]) + np.linspace(-half, half, _YAW_TRIES)
        expected_xy = (target.R_level_lidar @ estimate[:3, 3])[:2]
        return align(target, source, yaws, self.radius_m, expected_xy, 2.0 * translation)[0]

    def starts(self, first: int, second: int) -> list[FloatArray]:
        """`T_first_second` (4, 4) to begin with: estimated, of views aligned within the drift, and in each sector."""
        target, source = (BirdEyeView.of(self.submaps[index]) for index in (first, second))
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
        source = BirdEyeView.of(self.submaps[index], upside_down)
        similarity, turn = self._compare(source, others)
        for k in _spread(others, -similarity, 2 * _APPEARANCE_CANDIDATES):
            if similarity[k] < _MIN_SIMILARITY:
                break
            target = BirdEyeView.of(self.submaps[others[k]])
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
