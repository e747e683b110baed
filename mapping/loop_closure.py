"""Loop closures: each new keyframe is held against earlier ones near it or like it, and what fits is judged.

Precision comes before recall: a false closure tears a map apart, a missed one leaves it as good as it was. What drift
cannot explain is not believed within a session; where tracking was lost, go on with a new session number.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from mapping.loop_config import LoopConfig
from mapping.loop_consistency import Link, Track, close_circle, correction_sigmas
from mapping.loop_verification import Place, Verification, verify
from mapping.place_recognition import Drawing, Expected, Patch, Places, lay_over, make_patch

FoundBy = Literal["nearby", "appearance"]
# Around a nearby keyframe's estimate its heading may be so wrong, in standard deviations and at least in radians.
_YAW_SIGMAS = 2.0
_YAW_MIN = np.deg2rad(6.0)
_YAW_TRIES = 5
# Keyframes that are next to one another are one candidate.
_APART = 3
# A guess from two drawings may be so wrong: radians, and of the median range.
_ROUGH_RAD = np.deg2rad(10.0)
_ROUGH_RANGES = 0.3
# A place that fits elsewhere nearly as well as this, beside where it fits best, is recognised nowhere.
_AMBIGUOUS = 0.9
_RADIUS_PER_RANGE = 4.0
# Circles that may be off by more than this, of the median range, tell nothing.
_TELLING_RANGES = 0.25
# Places found by how they look need so many times the agreement of what contradicts them, of which the last count.
_OUTVOTED = 3
_RIVALS = 5
# A closure is held against at most so many of those before it.
_MEMORY = 40


@dataclass(frozen=True, eq=False)
class Submap:
    """What was seen around a keyframe.

    Attributes:
        index: of the keyframe, from 0 without gaps, over all sessions.
        session: which recording; keyframes of one follow one another.
        way_m: path length from the session's start.
        points: (N, 3) in the keyframe's LiDAR frame, compensated and thinned.
    """

    index: int
    session: int
    way_m: float
    points: FloatArray


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """One place seen twice, or said to be.

    Attributes:
        first, second: the keyframes; the second is the later one.
        T_first_second: (4, 4).
        covariance: (6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first.
        overlap: 0 to 1, share of what each sees of the other that fits; the worse side.
        residual_m: root mean square distance of what fits.
        inlier_ratio: share of the second's points that fit.
        found_by: by the estimate, or by how the place looks.
        consistent: how many other closures agree.
        verdict, reason: whether to believe it; why not.
    """

    first: int
    second: int
    T_first_second: FloatArray
    covariance: FloatArray
    overlap: float
    residual_m: float
    inlier_ratio: float
    found_by: FoundBy
    consistent: int
    verdict: Literal["accepted", "rejected"]
    reason: str

    @property
    def link(self) -> Link:
        """As consistency sees it."""
        return Link(self.first, self.second, self.T_first_second, self.covariance)


@dataclass(frozen=True)
class _Candidate:
    index: int
    found_by: FoundBy
    T_first_second: FloatArray


class LoopDetector:
    """Keeps what is needed of every keyframe, about 55 kB with the defaults, and finds closures among them."""

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._patches: list[Patch] = []
        self._places = Places()
        self._way_m: list[float] = []
        self._session: list[int] = []
        self._track = Track(np.empty((0, 4, 4)), np.empty(0), np.empty(0, dtype=np.int64))
        self._radius_m = config.radius_m
        self._accepted: list[LoopClosure] = []
        self._pending: list[LoopClosure] = []

    @property
    def nbytes(self) -> int:
        """Memory of what is kept."""
        return self._places.nbytes + sum(patch.nbytes for patch in self._patches)

    def add(self, submap: Submap, poses: FloatArray) -> list[LoopClosure]:
        """Take the next keyframe, and say which closures are decided by now.

        Args:
            submap: of the keyframe.
            poses: (K, 4, 4) `T_world_lidar` of all keyframes, this one last, as they are estimated now.

        Raises:
            ValueError: keyframes do not come one by one, or the poses are not theirs.
        """
        if submap.index != len(self._patches) or poses.shape != (submap.index + 1, 4, 4):
            raise ValueError(f"expected keyframe {len(self._patches)} with as many poses, got {submap.index}")
        config = self._config
        patch = make_patch(
            submap.points, config.min_range_m, config.max_range_m, config.cells_per_range, config.max_points
        )
        if self._radius_m is None and len(patch):
            self._radius_m = _RADIUS_PER_RANGE * patch.range_m
        radius_m = self._radius_m or 1.0
        signature = Drawing.of(patch).signature(radius_m)
        self._patches.append(patch)
        self._places.add(signature)
        self._way_m.append(submap.way_m)
        self._session.append(submap.session)
        self._track = Track(np.asarray(poses, dtype=np.float64), np.array(self._way_m), np.array(self._session))
        decided = self._drop_old(submap)
        if len(patch) < config.min_inliers or self._is_soon(submap):
            return decided
        return decided + self._look(submap.index, radius_m)

    def finish(self) -> list[LoopClosure]:
        """Closures that nothing agreed with to the end, as rejected."""
        left = [self._refused(closure, "no other closure agrees") for closure in self._pending]
        self._pending = []
        return left

    def _is_soon(self, submap: Submap) -> bool:
        """Whether the last closure is so recent that another would say the same."""
        if self._pending or not self._accepted:
            return False
        last = self._accepted[-1].second
        return self._session[last] == submap.session and submap.way_m - self._way_m[last] < self._config.spacing_m

    def _look(self, index: int, radius_m: float) -> list[LoopClosure]:
        """Verify a keyframe's candidates, and decide on those that fit."""
        decided: list[LoopClosure] = []
        source = self._place(index)
        for candidate in self._candidates(index, radius_m):
            found = verify(self._place(candidate.index), source, candidate.T_first_second)
            if found is None:
                continue
            closure = _closure(candidate, index, found)
            objection = found.objection(self._config) or self._beyond_drift(closure.link, closure.found_by)
            if objection:
                decided.append(self._refused(closure, objection))
                continue
            self._pending.append(closure)
            accepted = self._decide()
            decided += accepted
            if any(one.second == index for one in accepted):
                break
        return decided

    def _place(self, index: int) -> Place:
        """A keyframe with those before and after it."""
        reach = self._config.neighbours
        around = [
            i
            for i in range(max(0, index - reach), min(len(self._patches), index + reach + 1))
            if i != index and self._session[i] == self._session[index]
        ]
        return Place.join(self._patches[index], [(self._track.between(index, i), self._patches[i]) for i in around])

    def _candidates(self, index: int, radius_m: float) -> Iterator[_Candidate]:
        """Where the keyframe may lie, the likeliest first."""
        track, config, patch = self._track, self._config, self._patches[index]
        others = np.arange(index)
        elsewhere = track.session[others] != track.session[index]
        min_way_m = max(config.min_way_m, config.min_way_ranges * patch.range_m)
        others = others[elsewhere | (track.way_m[index] - track.way_m[others] > min_way_m)]
        if not len(others):
            return
        yield from self._nearby(index, others, radius_m)
        yield from self._alike(index, others, radius_m)

    def _nearby(self, index: int, others: NDArray[np.intp], radius_m: float) -> Iterator[_Candidate]:
        """Earlier keyframes of the session within reach of the estimate."""
        track, config, patch = self._track, self._config, self._patches[index]
        others = others[track.session[others] == track.session[index]]
        rotation, translation = track.drift(others, index, config)
        distance = np.linalg.norm(track.T_world_lidar[others, :3, 3] - track.T_world_lidar[index, :3, 3], axis=1)
        within = distance < patch.range_m + 2.0 * translation
        others, rotation, translation, distance = (
            others[within],
            rotation[within],
            translation[within],
            distance[within],
        )
        if not len(others) or not config.nearby_candidates:
            return
        source = Drawing.of(patch)
        similarity, _ = self._places.compare(source.signature(radius_m), others)
        # Near is what counts as long as drift is little, how it looks when it is much.
        cost = distance / (patch.range_m + translation) - similarity
        for k in _spread(others, cost, config.nearby_candidates):
            estimate = track.between(int(others[k]), index)
            target = Drawing.of(self._patches[others[k]])
            level = target.R_level_lidar @ estimate[:3, :3] @ source.R_level_lidar.T
            half = max(_YAW_MIN, _YAW_SIGMAS * float(rotation[k]))
            yaws = np.arctan2(level[1, 0], level[0, 0]) + np.linspace(-half, half, _YAW_TRIES)
            expected = Expected((target.R_level_lidar @ estimate[:3, 3])[:2], 2.0 * float(translation[k]))
            guess, _ = lay_over(target, source, yaws, radius_m, expected)
            yield _Candidate(int(others[k]), "nearby", guess)

    def _alike(self, index: int, others: NDArray[np.intp], radius_m: float) -> list[_Candidate]:
        """Earlier keyframes that look alike; those of other sessions may hang upside down."""
        config, patch, session = self._config, self._patches[index], self._track.session
        found: list[tuple[float, _Candidate]] = []
        for upside_down in (False, True):
            chosen = others[session[others] != session[index]] if upside_down else others
            if not len(chosen) or not config.appearance_candidates:
                continue
            source = Drawing.of(patch, upside_down)
            similarity, turn = self._places.compare(source.signature(radius_m), chosen)
            for k in _spread(chosen, -similarity, 2 * config.appearance_candidates):
                if similarity[k] < config.min_similarity:
                    break
                yaws = turn[k] + np.array([0.0, np.pi])
                guess, score = lay_over(Drawing.of(self._patches[chosen[k]]), source, yaws, radius_m)
                found.append((score, _Candidate(int(chosen[k]), "appearance", guess)))
        found.sort(key=lambda pair: -pair[0])
        plausible = [(score, c) for score, c in found if not self._beyond_drift_at(c.index, index, c.T_first_second)]
        if self._is_ambiguous(plausible, index):
            return []
        return [candidate for _, candidate in plausible[: config.appearance_candidates]]

    def _is_ambiguous(self, found: list[tuple[float, _Candidate]], index: int) -> bool:
        """Whether a keyframe looks nearly as much like somewhere else as it does like the first of several."""
        if not found:
            return False
        track, range_m = self._track, self._patches[index].range_m
        score, best = found[0]
        for other_score, other in found[1:]:
            if track.session[other.index] != track.session[best.index]:
                continue
            between = inverse(best.T_first_second) @ track.between(best.index, other.index) @ other.T_first_second
            _, drift_m = track.drift(np.array([best.index]), other.index, self._config)
            elsewhere = np.linalg.norm(between[:3, 3]) > 2.0 * _ROUGH_RANGES * range_m + 2.0 * drift_m[0]
            if elsewhere and other_score > _AMBIGUOUS * score:
                return True
        return False

    def _beyond_drift_at(self, first: int, second: int, T_first_second: FloatArray) -> bool:
        """Whether drift does not explain even a rough guess."""
        rough = np.diag(np.repeat([_ROUGH_RAD**2, self._patches[second].range_m ** 2 * _ROUGH_RANGES**2], 3))
        return bool(self._beyond_drift(Link(first, second, T_first_second, rough), "appearance"))

    def _beyond_drift(self, link: Link, found_by: FoundBy) -> str:
        """Why drift does not explain a link within a session; empty when it does."""
        if self._session[link.first] != self._session[link.second]:
            return ""
        most = self._config.max_drift_sigmas if found_by == "nearby" else self._config.max_drift_sigmas_by_appearance
        sigmas = correction_sigmas(link, self._track, self._config)
        if sigmas <= most:
            return ""
        way_m = self._way_m[link.second] - self._way_m[link.first]
        return f"corrects {sigmas:.1f} standard deviations of the drift over {way_m:.0f} m"

    def _decide(self) -> list[LoopClosure]:
        """Accept what enough others support, again and again until nothing changes."""
        accepted: list[LoopClosure] = []
        while True:
            for closure in self._pending:
                supported, count = self._support(closure)
                if supported:
                    break
            else:
                return accepted
            self._pending.remove(closure)
            accepted.append(replace(closure, consistent=count))
            self._accepted.append(accepted[-1])

    def _support(self, closure: LoopClosure) -> tuple[bool, int]:
        """Whether to believe a closure, and how many others agree; those not decided upon count too."""
        config, track = self._config, self._track
        range_m = self._patches[closure.second].range_m
        agreeing, against = self._judged_by_others(closure)
        # What disagrees weighs as much as agrees with it in turn: a wrong closure mostly stands alone. Where places
        # repeat, wrong ones agree among themselves; then the estimate is what to go by.
        rival = max((len(self._judged_by_others(other)[0]) for other in against[-_RIVALS:]), default=0)
        if against and rival * (1 if closure.found_by == "nearby" else _OUTVOTED) >= max(len(agreeing), 1):
            return False, len(agreeing)
        if track.session[closure.first] == track.session[closure.second]:
            _, drift_m = track.drift(np.array([closure.first]), closure.second, config)
            if closure.found_by == "nearby" and drift_m[0] < config.alone_ranges * range_m:
                return True, len(agreeing)
        places = track.way_m[[closure.second, *(other.second for other in agreeing)]]
        spread = float(np.ptp(places)) >= config.agreeing_span_ranges * range_m
        return len(agreeing) >= config.agreeing and (spread or not config.agreeing), len(agreeing)

    def _judged_by_others(self, closure: LoopClosure) -> tuple[list[LoopClosure], list[LoopClosure]]:
        """Which others agree with a closure and which do not, of those near enough for that to tell."""
        most_m = _TELLING_RANGES * self._patches[closure.second].range_m
        agreeing: list[LoopClosure] = []
        against: list[LoopClosure] = []
        for other in [*self._accepted[-_MEMORY:], *self._pending[-_MEMORY:]]:
            circle = None if other is closure else close_circle(closure.link, other.link, self._track, self._config)
            # A long way round closes whatever the links say.
            if circle is not None and circle.sigma_m <= most_m:
                (agreeing if circle.closes else against).append(other)
        return agreeing, against

    def _drop_old(self, submap: Submap) -> list[LoopClosure]:
        """Closures that nothing agreed with for too long, as rejected."""
        way_m, session = self._way_m, self._session
        old = [
            c for c in self._pending
            if session[c.second] != submap.session or submap.way_m - way_m[c.second] > self._config.pending_m
        ]  # fmt: skip
        self._pending = [closure for closure in self._pending if closure not in old]
        return [self._refused(closure, "no other closure agrees") for closure in old]

    def _refused(self, closure: LoopClosure, reason: str) -> LoopClosure:
        return replace(closure, verdict="rejected", reason=reason)


def _spread(indices: NDArray[np.intp], cost: FloatArray, count: int) -> list[int]:
    """Which few cost least, no two of them next to one another."""
    chosen: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        if all(abs(int(indices[k]) - int(indices[c])) >= _APART for c in chosen):
            chosen.append(int(k))
            if len(chosen) == count:
                break
    return chosen


def _closure(candidate: _Candidate, second: int, found: Verification) -> LoopClosure:
    return LoopClosure(
        candidate.index, second, found.T_target_source, found.covariance, found.overlap, found.residual_m,
        found.inlier_ratio, candidate.found_by, 0, "accepted", "",
    )  # fmt: skip
