"""Search for the place of a recording in a finished map: bird's-eye correlation, registration, a test of ambiguity.

Some scans that lie apart must fit at one place, and clearly better than at any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lidarslam.core.geometry import (
    FloatArray,
    exp,
    inverse,
    levelling,
    make_transform,
    rotation_angle,
    transform_points,
)
from lidarslam.mapping.localization.fixed_map import FixedMap, Regions
from lidarslam.mapping.localization.local_mapping import KeptScan, KeptScans
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.registration import Registration, register
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.tracking.budget import complete
from lidarslam.mapping.tracking.fit import NO_FIT, Fit
from lidarslam.mapping.tracking.scan_matcher import measure_fit
from lidarslam.mapping.tracking.start_poses import best_starts, positions_around, start_score

# Places around a supposed one that are tried: distance, in cells, and turn.
_NEAR_CELLS, _NEAR_YAW_DEG = 6.0, 20.0
# Radius of the view from above and of the points that are registered, in median ranges; places that are
# tried, and the largest number with one heading.
_RANGES, _PLACES, _PEAKS = 3.0, 32, 8
# Points that are registered first, and the share of the best quality above which all points are.
_FEW_POINTS, _LIKELY = 500, 0.5
# Of these, that are registered.
_PROMISING = 16
# A region of the map serves several places: it is larger than the scans' reach by this factor. Number of them kept.
_SPARE, _REGIONS = 1.5, 8
# Other scans that must fit, and their largest deviation from the recording's own motion: angle and distance.
_OTHERS = 5
_MOST_TURN, _MOST_SHIFT_CELLS, _MOST_SHIFT_SHARE = np.deg2rad(4.0), 2.0, 0.04
# Standard deviations of a place that may be anywhere near, and of one that follows from another: radians, metres.
_ROUGH, _CHAINED = (np.deg2rad(20.0), 5.0), (np.deg2rad(3.0), 0.5)
_STILL = 1e-3
# Least averages over the scans: inlier ratio, share of inliers among all points, directional support.
_LEAST_RATIO, _LEAST_SHARE, _LEAST_SUPPORT = 0.8, 0.45, 0.6
# Places of lower quality than this share of the best one's are no rivals, nor those within cells and an angle of it. At
# 0.8 a wrong place in a row of equal houses was taken.
_RIVAL = 0.6
_SAME_CELLS, _SAME_RAD = 4.0, np.deg2rad(20.0)


@dataclass(frozen=True, eq=False)
class Place:
    """A place where the latest scan was registered."""

    registration: Registration  # of the latest scan
    surfel_map: SurfelMap  # that it was registered to
    fits: tuple[Fit, ...]  # of the latest scan, and of others

    @property
    def T_map_lidar(self) -> FloatArray:
        """(4, 4) of the latest scan."""
        return self.registration.T_world_lidar

    @property
    def means(self) -> tuple[float, float, float]:
        """Over the scans, of the inlier ratio, of the share of inliers among all points, and of the support."""
        fits = [(fit.inlier_ratio or 0.0, fit.inlier_share, fit.support or 0.0) for fit in self.fits]
        ratio, share, support = (float(np.mean(values)) for values in zip(*fits, strict=True))
        return ratio, share, support

    @property
    def quality(self) -> float:
        """Score among places."""
        _, share, support = self.means
        return share * support

    def objection(self) -> str:
        """Why the scans do not fit; empty when they do."""
        ratio, share, support = self.means
        if share < _LEAST_SHARE:
            return f"only {100.0 * share:.0f} % of the points lie on surfaces of the map"
        if ratio < _LEAST_RATIO:
            return f"only {100.0 * ratio:.0f} % of the points near surfaces of the map fit"
        if support < _LEAST_SUPPORT:
            return f"only {100.0 * support:.0f} % of the points that constrain one direction fit"
        return ""

    def is_at(self, other: "Place") -> bool:
        """Whether two places are the same."""
        motion = inverse(self.T_map_lidar) @ other.T_map_lidar
        near = np.linalg.norm(motion[:3, 3]) < _SAME_CELLS * self.surfel_map.cell_m
        return bool(near and rotation_angle(motion) < _SAME_RAD)


Found: TypeAlias = Place | str
"""Result of a search: a place, or the reason for none."""


class PlaceSearch:
    """Searches a map, with the points of scans within a range."""

    def __init__(self, fixed_map: FixedMap, max_range_m: float) -> None:
        self._map = fixed_map
        self._max_range_m = max_range_m
        self._regions: Regions | None = None

    def anywhere(self, scans: KeptScans, up: FloatArray) -> Found:
        """Search the whole map with the scans kept so far; `up` (3,) is the vertical of their local frame."""
        latest = scans.latest
        cell_m, reach_m = self._map.cell_m(latest.cell_m), _RANGES * latest.range_m
        points = scans.points_around(reach_m)
        R_level_lidar = levelling(up) @ latest.T_local_lidar[:3, :3]
        starts: list[FloatArray] = []
        for view in self._map.views(cell_m):
            T = make_transform(view.R_level_world.T @ R_level_lidar, np.zeros(3))
            starts.extend(complete(view.find(points, T, reach_m, _PLACES, _PEAKS)))
        return self.among(scans, starts)

    def among(self, scans: KeptScans, starts: Sequence[FloatArray]) -> Found:
        """The one of the places near poses (4, 4) of the latest scan where all scans fit, if no other fits as well."""
        kept = scans.chosen(_OTHERS)
        if not starts:
            return "there is nothing upright to search with"
        reach_m, cell_m = self._reach_m(kept[0]), self._map.cell_m(kept[0].cell_m)
        if self._regions is None or self._regions.cell_m != cell_m:
            self._regions = Regions(self._map, cell_m, reach_m, _SPARE * reach_m, _REGIONS)
        regions = self._regions
        few = replace(kept[0], keypoints=kept[0].keypoints[:: max(1, len(kept[0].keypoints) // _FEW_POINTS)])
        scores = [start_score(few.keypoints, start, regions.around(start[:3, 3])) for start in starts]
        promising = [starts[index] for index in np.argsort(scores)[::-1][:_PROMISING]]
        rough = self._places(few, promising, _ROUGH, regions)
        likely = [place.T_map_lidar for place in rough if place.quality > _LIKELY * rough[0].quality]
        places = self._places(kept[0], likely, _CHAINED, regions)
        if not places:
            return "no place in the map fits at all"
        if not places[0].objection():
            places = [place for place in places if place.quality > _RIVAL * places[0].quality]
            places = [self._with_others(place, kept, regions) for place in places]
            places.sort(key=lambda place: -place.quality)
        return _decided(places)

    def _places(
        self, scan: KeptScan, starts: Sequence[FloatArray], sigmas: tuple[float, float], regions: Regions
    ) -> list[Place]:
        """The different places that a scan is registered at from poses (4, 4), by descending quality."""
        places: list[Place] = []
        for start in starts:
            place = self._register(scan, start, sigmas, regions)
            if place is not None and not any(place.is_at(other) for other in places):
                places.append(place)
        return sorted(places, key=lambda place: -place.quality)

    def guessed(self, scans: KeptScans, up: FloatArray, x: float, y: float, yaw: float) -> FloatArray:
        """`T_map_local` (4, 4) for a rough position and heading of the local frame, at the height that fits."""
        latest = scans.latest
        reach_m, R_level_local = _RANGES * latest.range_m, levelling(up)
        points = transform_points(latest.T_local_lidar, scans.points_around(reach_m)) @ R_level_local.T
        view = min(self._map.views(self._map.cell_m(latest.cell_m)), key=lambda view: view.distance_m(x, y))
        T = make_transform(view.R_level_world.T @ R_level_local, np.zeros(3))
        return view.pose_at(yaw, np.array([x, y]), points, T, reach_m)

    def around(self, scans: KeptScans, T_map_lidar: FloatArray) -> Found:
        """Search near a pose (4, 4) of the latest scan."""
        latest = scans.latest
        cell_m, reach_m = self._map.cell_m(latest.cell_m), self._reach_m(latest)
        region = self._map.region(T_map_lidar[:3, 3], 1.5 * reach_m, cell_m)
        up, starts = region.vertical(), []
        for yaw_deg in (0.0, _NEAR_YAW_DEG, -_NEAR_YAW_DEG):
            T = T_map_lidar.copy()
            T[:3, :3] = exp(np.array([*(np.deg2rad(yaw_deg) * up), 0.0, 0.0, 0.0]))[:3, :3] @ T[:3, :3]
            starts.append(positions_around(T, up, _NEAR_CELLS * cell_m, 0.5 * _NEAR_CELLS * cell_m))
        return self.among(scans, list(complete(best_starts(latest.keypoints, np.concatenate(starts), region))))

    def _with_others(self, place: Place, kept: Sequence[KeptScan], regions: Regions) -> Place:
        """A place with the fits of the other scans; none where one contradicts the motion between the scans."""
        fits, last, T_map_last = list(place.fits), kept[0], place.T_map_lidar
        for scan in kept[1:]:
            motion = inverse(last.T_local_lidar) @ scan.T_local_lidar
            start = T_map_last @ motion
            found = self._register(scan, start, _CHAINED, regions)
            if found is None or _is_off(start, found.T_map_lidar, motion, regions.cell_m):
                fits.append(NO_FIT)
                continue
            fits += found.fits
            last, T_map_last = scan, found.T_map_lidar
        return replace(place, fits=tuple(fits))

    def _register(
        self, scan: KeptScan, start: FloatArray, sigmas: tuple[float, float], regions: Regions
    ) -> Place | None:
        surfel_map = regions.around(start[:3, 3])
        points = scan.keypoints
        points = points[np.einsum("ij,ij->i", points, points) < self._reach_m(scan) ** 2]
        variances = np.array([sigmas[0]] * 3 + [sigmas[1]] * 3 + [_STILL] * 6) ** 2
        prediction = Prediction(0.0, start, np.zeros(6), np.diag(variances))
        found = register(Sweep(points), prediction, surfel_map, with_velocity=False, patient=True)
        if found is None:
            return None
        return Place(found, surfel_map, (measure_fit(points, found.T_world_lidar, surfel_map),))

    def _reach_m(self, scan: KeptScan) -> float:
        return min(_RANGES * scan.range_m, self._max_range_m)


def _decided(places: Sequence[Place]) -> Found:
    """The first of places by descending quality, unless it does not fit, or a rival fits as well."""
    best = places[0]
    if objection := best.objection():
        return f"{objection}, at the best place"
    rivals = [place for place in places[1:] if place.quality > _RIVAL * best.quality]
    if rivals:
        apart_m = float(np.linalg.norm(rivals[0].T_map_lidar[:3, 3] - best.T_map_lidar[:3, 3]))
        return f"{len(rivals) + 1} places fit alike, two of them {apart_m:.1f} m apart"
    return best


def _is_off(start: FloatArray, found: FloatArray, motion: FloatArray, cell_m: float) -> bool:
    """Whether the registered pose of a scan contradicts the motion (4, 4) from another one."""
    off, way_m = inverse(start) @ found, float(np.linalg.norm(motion[:3, 3]))
    far = np.linalg.norm(off[:3, 3]) > _MOST_SHIFT_CELLS * cell_m + _MOST_SHIFT_SHARE * way_m
    return bool(far or rotation_angle(off) > _MOST_TURN)
