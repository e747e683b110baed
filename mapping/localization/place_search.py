"""Search for the place of a recording in a finished map: bird's-eye correlation, registration, a test of ambiguity.

The map's points are surfels by region, to register scans to, and all of them a view from above, to search in. Some
scans that lie apart must fit at one place, and clearly better than at any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import (
    FloatArray,
    exp,
    inverse,
    levelling,
    make_transform,
    rotation_angle,
    transform_points,
)
from lidarslam.core.scan import median_gap_m
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.motion.prediction import Prediction
from lidarslam.mapping.registration.local_map import vertical_of
from lidarslam.mapping.registration.registration import Registration, register
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import point_keys, require_reach
from lidarslam.mapping.tracking.birds_eye_map import BirdsEyeMap
from lidarslam.mapping.tracking.budget import complete
from lidarslam.mapping.tracking.fit import NO_FIT, Fit, measure_fit
from lidarslam.mapping.tracking.scan_matcher import best_starts, positions_around, start_score

# Least edge of a surfel cell in spacings of the map's points. With fewer points in and around a cell normals are
# uncertain: at 1.7, roll was found to be degenerate in an office.
_CELLS_PER_SPACING = 3.5
_SAMPLES = 2000
# Edge of a cell of the view from above, in surfel cells, and of the parts of the map that are drawn, in such cells,
# with their overlap.
_VIEW_SCALE, _VIEW_CELLS, _OVERLAP_CELLS = 4.0, 800, 30
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
# Factor by which the scans' reach grows before regions are drawn again.
_GROWN = 1.25
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
# A scan is kept after this distance, in median ranges, or this turn. The latest are kept.
_APART_RANGES, _APART_RAD = 0.25, np.deg2rad(30.0)
_MOST = 24


class FixedMap:
    """Points (M, 3) with unit normals (M, 3) towards the side that was seen, which are never changed."""

    def __init__(self, points: FloatArray, normals: FloatArray) -> None:
        self._points = points
        self._normals = normals
        self._least_cell_m = _CELLS_PER_SPACING * (median_gap_m(points, _SAMPLES) or 0.0)
        self._up = vertical_of(normals)
        self._views: tuple[float, list[BirdsEyeMap]] = (0.0, [])

    def __len__(self) -> int:
        return len(self._points)

    def cell_m(self, wanted_m: float) -> float:
        """The edge of surfel cells nearest to the wanted one that the density of the points allows."""
        return max(wanted_m, self._least_cell_m)

    def region(self, centre: FloatArray, radius_m: float, cell_m: float) -> SurfelMap:
        """The surfels within a radius of a position (3,)."""
        offsets = self._points - centre
        near = np.einsum("ij,ij->i", offsets, offsets) < radius_m**2
        return SurfelMap.of_cloud(self._points[near], self._normals[near], cell_m, radius_m)

    def views(self, cell_m: float) -> list[BirdsEyeMap]:
        """The map from above, for surfel cells of an edge, in parts that overlap; kept for the next call."""
        if self._views[0] != cell_m:
            pixel_m = _VIEW_SCALE * cell_m
            require_reach(self._points, cell_m)
            _, kept = np.unique(point_keys(self._points, 0.5 * pixel_m), return_index=True)
            points = self._points[kept]
            parts = _parts(points[:, :2], _VIEW_CELLS * pixel_m, _OVERLAP_CELLS * pixel_m)
            self._views = cell_m, [BirdsEyeMap.of(points[part], self._up, pixel_m) for part in parts]
        return self._views[1]


def _parts(xy: FloatArray, edge_m: float, margin_m: float) -> list[NDArray[np.bool_]]:
    """Which of the points (M, 2) are in each square of a grid or within a margin of it; none of empty squares."""
    low = xy.min(axis=0)
    extent = xy.max(axis=0) - low
    counts = np.maximum(1, np.ceil(extent / edge_m)).astype(int)
    steps = extent / counts
    parts = []
    for i, j in np.ndindex(*counts):
        corner = low + steps * (i, j)
        inside = ((xy >= corner) & (xy <= corner + steps)).all(axis=1)
        if inside.any():
            parts.append(((xy >= corner - margin_m) & (xy <= corner + steps + margin_m)).all(axis=1))
    return parts


class Regions:
    """Regions of the map as surfels: all within reach of a position, and a margin; the latest few are kept."""

    def __init__(self, fixed_map: FixedMap, spare: float, kept: int = 1) -> None:
        self._map, self._spare, self._kept = fixed_map, spare, kept  # the margin is this share of the reach
        self.cell_m, self._reach_m, self._spare_m = 0.0, 0.0, 0.0
        self._drawn: list[tuple[FloatArray, SurfelMap]] = []

    def resize(self, wanted_m: float, reach_m: float) -> None:
        """Adapt to the wanted edge of cells and a reach; where either outgrows the regions, begin again."""
        cell_m = self._map.cell_m(wanted_m)
        if cell_m != self.cell_m or reach_m > _GROWN * self._reach_m:
            self.cell_m, self._reach_m, self._spare_m, self._drawn = cell_m, reach_m, self._spare * reach_m, []

    def around(self, position: FloatArray) -> SurfelMap:
        """A region with all that is within reach of a position (3,)."""
        for centre, region in self._drawn:
            if np.linalg.norm(centre - position) < self._spare_m:
                return region
        region = self._map.region(position, self._reach_m + self._spare_m, self.cell_m)
        self._drawn = [*self._drawn, (position.copy(), region)][-self._kept :]
        return region


@dataclass(frozen=True, eq=False)
class KeptScan:
    """A scan at its pose in a local frame of the recording."""

    T_local_lidar: FloatArray  # (4, 4)
    points: FloatArray  # (N, 3) in the LiDAR frame at the stamp, compensated, as they go into a map
    keypoints: FloatArray  # (K, 3) those that are registered
    cell_m: float  # size of cells that suits the scene
    range_m: float  # median range of the scene

    def is_apart_from(self, other: "KeptScan") -> bool:
        """Whether the sensor has moved or turned since another scan."""
        motion = inverse(other.T_local_lidar) @ self.T_local_lidar
        far = np.linalg.norm(motion[:3, 3]) > _APART_RANGES * self.range_m
        return bool(far or rotation_angle(motion) > _APART_RAD)


class KeptScans:
    """A bounded number of scans, apart from one another, and the latest; searched once there is one."""

    latest: KeptScan

    def __init__(self) -> None:
        self._apart: list[KeptScan] = []

    def add(self, scan: KeptScan) -> None:
        """Add the next scan that was registered in the local frame."""
        self.latest = scan
        if not self._apart or scan.is_apart_from(self._apart[-1]):
            self._apart = [*self._apart, scan][-_MOST:]

    def chosen(self, count: int) -> Sequence[KeptScan]:
        """The latest scan, and at most `count` others before it, backwards in time, evenly spread."""
        others = [scan for scan in reversed(self._apart) if scan is not self.latest]
        if not others:
            return [self.latest]
        spread = np.unique(np.linspace(0, len(others) - 1, min(count, len(others))).astype(np.intp))
        return [self.latest, *(others[index] for index in spread)]

    def points_around(self, reach_m: float) -> FloatArray:
        """The points (N, 3) of all scans within reach of the latest, in its LiDAR frame."""
        T_lidar_local, parts = inverse(self.latest.T_local_lidar), [self.latest.points]
        for scan in self._apart:
            T = T_lidar_local @ scan.T_local_lidar
            if scan is not self.latest and np.linalg.norm(T[:3, 3]) < reach_m:
                parts.append(transform_points(T, scan.points))
        points = np.concatenate(parts)
        inside = np.einsum("ij,ij->i", points, points) < reach_m**2
        return np.asarray(points[inside], dtype=np.float64)


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
        self._regions = Regions(fixed_map, _SPARE, _REGIONS)

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
        self._regions.resize(kept[0].cell_m, self._reach_m(kept[0]))
        few = replace(kept[0], keypoints=kept[0].keypoints[:: max(1, len(kept[0].keypoints) // _FEW_POINTS)])
        scores = [start_score(few.keypoints, start, self._regions.around(start[:3, 3])) for start in starts]
        promising = [starts[index] for index in np.argsort(scores)[::-1][:_PROMISING]]
        rough = self._places(few, promising, _ROUGH)
        likely = [place.T_map_lidar for place in rough if place.quality > _LIKELY * rough[0].quality]
        places = self._places(kept[0], likely, _CHAINED)
        if not places:
            return "no place in the map fits at all"
        if not places[0].objection():
            rivals = [place for place in places if place.quality > _RIVAL * places[0].quality]
            places = sorted((self._with_others(place, kept) for place in rivals), key=lambda place: -place.quality)
        return _decided(places)

    def _places(self, scan: KeptScan, starts: Sequence[FloatArray], sigmas: tuple[float, float]) -> list[Place]:
        """The different places that a scan is registered at from poses (4, 4), by descending quality."""
        places: list[Place] = []
        for start in starts:
            place = self._register(scan, start, sigmas)
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

    def _with_others(self, place: Place, kept: Sequence[KeptScan]) -> Place:
        """A place with the fits of the other scans; none where one contradicts the motion between the scans."""
        fits, last, T_map_last = list(place.fits), kept[0], place.T_map_lidar
        for scan in kept[1:]:
            motion = inverse(last.T_local_lidar) @ scan.T_local_lidar
            start = T_map_last @ motion
            found = self._register(scan, start, _CHAINED)
            if found is None or _is_off(start, found.T_map_lidar, motion, self._regions.cell_m):
                fits.append(NO_FIT)
                continue
            fits += found.fits
            last, T_map_last = scan, found.T_map_lidar
        return replace(place, fits=tuple(fits))

    def _register(self, scan: KeptScan, start: FloatArray, sigmas: tuple[float, float]) -> Place | None:
        surfel_map = self._regions.around(start[:3, 3])
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
