"""Where a new keyframe may lie: beside earlier ones near its estimate, or where earlier ones look like it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Saved, State
from mapping.loops.consistency import Link, Track, beyond_drift
from mapping.loops.descriptor import Drawing, Expected, Places, lay_over
from mapping.loops.loop_config import LoopConfig
from mapping.loops.place import Patch, make_patch
from mapping.loops.registration import Place

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


@dataclass(frozen=True, eq=False)
class Candidate:
    """An earlier keyframe that a new one may lie beside.

    Attributes:
        index: of the earlier keyframe.
        found_by: by the estimate, or by how the place looks.
        T_first_second: (4, 4) a rough guess of where the new one lies.
    """

    index: int
    found_by: FoundBy
    T_first_second: FloatArray


def most_sigmas(found_by: FoundBy, config: LoopConfig) -> float:
    """How many standard deviations of drift a closure may correct within a session."""
    return config.max_drift_sigmas if found_by == "nearby" else config.max_drift_sigmas_by_appearance


class Keyframes:
    """What is kept of every keyframe, about 55 kB with the defaults, and the search among them.

    Attributes:
        patches: one a keyframe.
        track: the present estimates.
    """

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self.patches: list[Patch] = []
        self.track = Track(np.empty((0, 4, 4)), np.empty(0), np.empty(0, dtype=np.int64))
        self._places = Places()
        self._radius_m = config.radius_m

    def __len__(self) -> int:
        return len(self.patches)

    @property
    def nbytes(self) -> int:
        """Memory of what is kept."""
        return self._places.nbytes + sum(patch.nbytes for patch in self.patches)

    @property
    def radius_m(self) -> float:
        """How far places are compared; known with the first keyframe that has points."""
        return self._radius_m or 1.0

    def add(self, points: FloatArray, way_m: float, session: int, poses: FloatArray) -> None:
        """Take the next keyframe: its submap (N, 3), way and session, and the present estimates (K, 4, 4) of all."""
        track = self.track
        self._keep(points)
        self.track = Track(
            np.asarray(poses, dtype=np.float64), np.append(track.way_m, way_m), np.append(track.session, session)
        )

    def state(self) -> State:
        """The present estimates; what is kept of submaps follows from them."""
        track = self.track
        return {"T_world_lidar": track.T_world_lidar, "way_m": track.way_m, "session": track.session}

    def restore(self, saved: Saved, submaps: Iterable[FloatArray]) -> None:
        """Go on from a state, and the points (N, 3) of all submaps there were."""
        for points in submaps:
            self._keep(points)
        count = len(self)
        self.track = Track(
            saved.array("T_world_lidar", (count, 4, 4)),
            saved.array("way_m", (count,)),
            saved.array("session", (count,), np.int64),
        )

    def _keep(self, points: FloatArray) -> None:
        config = self._config
        patch = make_patch(points, config.min_range_m, config.max_range_m, config.cells_per_range, config.max_points)
        if self._radius_m is None and len(patch):
            self._radius_m = _RADIUS_PER_RANGE * patch.range_m
        self._places.add(Drawing.of(patch).signature(self.radius_m))
        self.patches.append(patch)

    def place(self, index: int) -> Place:
        """A keyframe with those before and after it."""
        reach, session = self._config.neighbours, self.track.session
        around = [
            i
            for i in range(max(0, index - reach), min(len(self.patches), index + reach + 1))
            if i != index and session[i] == session[index]
        ]
        track = self.track
        return Place.join(
            self.patches[index],
            [(track.between(index, i), self.patches[i]) for i in around],
            [float(track.way_m[i] - track.way_m[index]) for i in around],
            self._config.drift_rates,
        )

    def candidates(self, index: int) -> Iterator[Candidate]:
        """Where the keyframe may lie, the likeliest first."""
        track, config, patch = self.track, self._config, self.patches[index]
        others = np.arange(index)
        elsewhere = track.session[others] != track.session[index]
        min_way_m = max(config.min_way_m, config.min_way_ranges * patch.range_m)
        others = others[elsewhere | (track.way_m[index] - track.way_m[others] > min_way_m)]
        if not len(others):
            return
        yield from self._nearby(index, others)
        yield from self._alike(index, others)

    def _nearby(self, index: int, others: NDArray[np.intp]) -> Iterator[Candidate]:
        """Earlier keyframes of the session within reach of the estimate."""
        track, config, patch = self.track, self._config, self.patches[index]
        others = others[track.session[others] == track.session[index]]
        rotation, translation = track.drift(others, index, config)
        distance = np.linalg.norm(track.T_world_lidar[others, :3, 3] - track.T_world_lidar[index, :3, 3], axis=1)
        within = distance < patch.range_m + 2.0 * translation
        others = others[within]
        rotation, translation, distance = (values[within] for values in (rotation, translation, distance))
        if not len(others) or not config.nearby_candidates:
            return
        source = Drawing.of(patch)
        similarity, _ = self._places.compare(source.signature(self.radius_m), others)
        # Near is what counts as long as drift is little, how it looks when it is much.
        cost = distance / (patch.range_m + translation) - similarity
        for k in _spread(others, cost, config.nearby_candidates):
            estimate = track.between(int(others[k]), index)
            target = Drawing.of(self.patches[others[k]])
            level = target.R_level_lidar @ estimate[:3, :3] @ source.R_level_lidar.T
            half = max(_YAW_MIN, _YAW_SIGMAS * float(rotation[k]))
            yaws = np.arctan2(level[1, 0], level[0, 0]) + np.linspace(-half, half, _YAW_TRIES)
            expected = Expected((target.R_level_lidar @ estimate[:3, 3])[:2], 2.0 * float(translation[k]))
            guess, _ = lay_over(target, source, yaws, self.radius_m, expected)
            yield Candidate(int(others[k]), "nearby", guess)

    def _alike(self, index: int, others: NDArray[np.intp]) -> list[Candidate]:
        """Earlier keyframes that look alike; those of other sessions may hang upside down."""
        config, patch, session = self._config, self.patches[index], self.track.session
        found: list[tuple[float, Candidate]] = []
        for upside_down in (False, True):
            chosen = others[session[others] != session[index]] if upside_down else others
            if not len(chosen) or not config.appearance_candidates:
                continue
            source = Drawing.of(patch, upside_down)
            similarity, turn = self._places.compare(source.signature(self.radius_m), chosen)
            for k in _spread(chosen, -similarity, 2 * config.appearance_candidates):
                if similarity[k] < config.min_similarity:
                    break
                yaws = turn[k] + np.array([0.0, np.pi])
                guess, score = lay_over(Drawing.of(self.patches[chosen[k]]), source, yaws, self.radius_m)
                found.append((score, Candidate(int(chosen[k]), "appearance", guess)))
        found.sort(key=lambda pair: -pair[0])
        plausible = [(score, c) for score, c in found if not self._beyond_drift_at(c.index, index, c.T_first_second)]
        if self._is_ambiguous(plausible, index):
            return []
        return [candidate for _, candidate in plausible[: config.appearance_candidates]]

    def _is_ambiguous(self, found: list[tuple[float, Candidate]], index: int) -> bool:
        """Whether a keyframe looks nearly as much like somewhere else as it does like the first of several."""
        if not found:
            return False
        track, range_m = self.track, self.patches[index].range_m
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
        rough = np.diag(np.repeat([_ROUGH_RAD**2, self.patches[second].range_m ** 2 * _ROUGH_RANGES**2], 3))
        link = Link(first, second, T_first_second, rough)
        return bool(beyond_drift(link, self.track, most_sigmas("appearance", self._config), self._config))


def _spread(indices: NDArray[np.intp], cost: FloatArray, count: int) -> list[int]:
    """Which few cost least, no two of them next to one another."""
    chosen: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        if all(abs(int(indices[k]) - int(indices[c])) >= _APART for c in chosen):
            chosen.append(int(k))
            if len(chosen) == count:
                break
    return chosen
