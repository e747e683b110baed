"""The running local map, rebuilt after a loop closure: submaps at their corrected places around the sensor.

Scans are registered in a frame without jumps, in which the first visit of a place lies displaced by drift, or is
forgotten. After a closure the submaps around the sensor are placed as in the corrected graph relative to the
latest keyframe, so that the surfaces of both visits coincide.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log, rotation_angle, transform_points
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.mapping.global_map.global_map import VoxelMeans
from lidarslam.mapping.global_map.voxels import POSITION, VIEW, Rows
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph.keyframe_graph import Keyframe, first_connected
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap

# A submap is off when its place in the local map differs from the corrected one by more than this share of a cell or
# this angle: half the width of a surfel, and the angle that it subtends at the median range of 30 cells.
_OFF_CELLS, _OFF_RAD = 0.5, np.deg2rad(1.0)
# Submaps within these parts of the radius of the local map must be in it, and not be off.
_HELD_WITHIN, _RIGHT_WITHIN = 0.5, 0.25
# Points of a drawn map, to bound its time; submaps overlap, so that fewer of each are enough.
_MOST_POINTS = 1_500_000
# A mean of a submap counts as this many points, so that a cell is full with those of a few submaps that saw it first,
# as it was when these were mapped; else the scans that follow would shift it to where they are.
_WEIGHT = 10.0
# Scans from the one before which a map is drawn to the first one that is registered to it: the graph has this much
# time before tracking waits for it. More than the scans that may wait for the global map and the graph.
SCANS_LATER = 12
# Drawn maps whose submaps are kept: at most one is drawn per scan, and closures are refined a few keyframes later.
_KEPT = SCANS_LATER + 4
# Part of the radius of the local map that the path must not have left: surfaces around the keyframe are held too.
_PART_OF_RADIUS = 0.6
# Chi-squared with six degrees of freedom, one time in a thousand: beyond, the two measurements contradict one another,
# and the surfaces of the first visit had drifted away.
_CHI_SQUARED_999 = 22.5


@dataclass(frozen=True, eq=False)
class Drawn:
    """Submaps as placed in a rebuilt local map."""

    since: int  # the first scan that is registered to it
    keys: Annotated[NDArray[np.intp], Shape(None)]  # (H,) the keyframes, ascending
    keyframes: int  # number of them then; later ones were inserted scan by scan
    T_odom_keyframe: Annotated[FloatArray, Shape(None, 4, 4)]  # (H, 4, 4)


class SubmapPlacement(Stateful):
    """Where the submaps of keyframes lie in the running local map, of this radius, and which of them it still holds."""

    _poses: list[Annotated[FloatArray, TRANSFORM]]  # T_odom_keyframe
    _held: list[int]  # keyframes whose submaps it holds
    _drawn: list[Drawn]

    def __init__(self, radius_m: float) -> None:
        self.radius_m = radius_m
        self._poses, self._held, self._drawn = [], [], []

    def __len__(self) -> int:
        return len(self._poses)

    def follow(self, T_odom_keyframe: FloatArray) -> None:
        """The next keyframe begins; submaps beyond the radius are forgotten."""
        self._held.append(len(self._poses))
        self._poses.append(T_odom_keyframe)
        near = self._distances(np.array([self._poses[key] for key in self._held])) < self.radius_m
        self._held = [key for key, is_near in zip(self._held, near, strict=True) if is_near]

    def redrawn(
        self, targets: FloatArray, members: NDArray[np.bool_], cells_m: CellSizes,
        submap: Callable[[int], VoxelMeans], scan: int,
    ) -> SurfelMap | None:  # fmt: skip
        """The map rebuilt without the latest scan; None unless a submap nearby is missing, or lies where it should not.

        Targets (K, 4, 4) are T_odom_keyframe as corrected, that of the last keyframe as it was; members (K,) are the
        submaps that are connected with the last one.
        """
        relative = np.where(members, self._distances(targets) / self.radius_m, np.inf)
        is_missing = not np.isin(np.flatnonzero(relative < _HELD_WITHIN), self._held).all()
        near = np.flatnonzero(relative < _RIGHT_WITHIN)
        off = inverse(np.array([self._poses[key] for key in near]).reshape(-1, 4, 4)) @ targets[near]
        is_far = np.linalg.norm(off[:, :3, 3], axis=1) > _OFF_CELLS * cells_m[0]
        if not is_missing and not (is_far | (rotation_angle(off) > _OFF_RAD)).any():
            return None
        self._poses, self._held = list(targets), np.flatnonzero(relative < 1.0).tolist()
        drawn = Drawn(scan + SCANS_LATER, np.array(self._held, dtype=np.intp), len(targets), targets[self._held])
        self._drawn = [*self._drawn, drawn][-_KEPT:]
        held = [submap(key).rows for key in self._held]
        step = 1 + sum(map(len, held)) // _MOST_POINTS
        submaps = [(targets[key], rows[::step]) for key, rows in zip(self._held, held, strict=True)]
        # Ended the map before a submap does, its border would be of the latest scans alone.
        reaches = (float(np.linalg.norm(rows[:, POSITION], axis=1).max(initial=0.0)) for rows in held)
        return draw_local_map(submaps, cells_m, max(self.radius_m, *reaches))

    def is_exchanged(self, first: int, second: int) -> bool:
        """Whether two scans were registered to different maps, one of them rebuilt."""
        return any(first < drawn.since <= second for drawn in self._drawn)

    def place(self, key: int, scan: int, T_odom_keyframe: FloatArray, at: int) -> tuple[FloatArray, int] | None:
        """Where a keyframe's submap lies in the map that a later scan `at` was registered to, and since which scan.

        Given the keyframe's own scan and registered pose (4, 4). None where the map does not have it.
        """
        drawn = next((drawn for drawn in reversed(self._drawn) if drawn.since <= at), None)
        if drawn is None or key >= drawn.keyframes:
            return T_odom_keyframe, scan
        rows = np.flatnonzero(drawn.keys == key)
        return (drawn.T_odom_keyframe[rows[0]], drawn.since) if len(rows) else None

    def as_registered(
        self, closure: LoopClosure, first: Keyframe, second: Keyframe, scan_poses: Sequence[FloatArray]
    ) -> LoopClosure:
        """The closure with the motion along the registered poses, where the map held its place along the whole path.

        A scan registered to surfaces seen from an earlier keyframe measures its pose relative to that keyframe, with
        all its points and without drift. Registering the two submaps measures the same again from the same points, with
        more noise. Where the map did not hold the place, or the two contradict one another, the closure is as it was.
        """
        place = self.place(closure.first, first.scan, scan_poses[first.scan], second.scan)
        if place is None or first.covariance is None or second.covariance is None:
            return closure
        T_odom_first, since = place
        way = np.array(scan_poses[since : second.scan + 1])
        if np.linalg.norm(way[:, :3, 3] - T_odom_first[:3, 3], axis=1).max() > _PART_OF_RADIUS * self.radius_m:
            return closure
        T_first_second = inverse(T_odom_first) @ way[-1]
        A = adjoint(inverse(T_first_second))
        covariance = second.covariance + A @ first.covariance @ A.T
        difference = log(inverse(T_first_second) @ closure.T_first_second)
        if difference @ np.linalg.solve(covariance + closure.covariance, difference) > _CHI_SQUARED_999:
            return closure
        return replace(closure, T_first_second=T_first_second, covariance=covariance)

    def _distances(self, poses: FloatArray) -> FloatArray:
        """(K,) of poses (K, 4, 4) from the last keyframe."""
        return np.asarray(np.linalg.norm(poses[:, :3, 3] - self._poses[-1][:3, 3], axis=1), dtype=np.float64)


def connected_with_last(keyframes: Sequence[Keyframe], closures: Iterable[RelativePose]) -> NDArray[np.bool_]:
    """(K,) the keyframes whose poses follow from the last one's: those of a segment do; loop closures join segments."""
    segments = np.array([keyframe.segment for keyframe in keyframes])
    pairs = [(int(key), int(key) + 1) for key in np.flatnonzero(np.diff(segments) == 0)]
    component = first_connected(len(keyframes), pairs + [(closure.first, closure.second) for closure in closures])
    return np.asarray(component == component[-1])


def draw_local_map(submaps: Iterable[tuple[FloatArray, Rows]], cells_m: CellSizes, radius_m: float) -> SurfelMap:
    """Surfels of submaps, each with `T_odom_keyframe` (4, 4) and its rows; full cells are those of the first ones."""
    drawn = SurfelMap(cells_m, radius_m)
    for T_odom_keyframe, rows in submaps:
        views = rows[:, VIEW].astype(np.float64)
        lengths = np.maximum(np.linalg.norm(views, axis=1, keepdims=True), 1e-9)
        elevations = -np.arcsin(np.clip(views[:, 2] / lengths[:, 0], -1.0, 1.0))
        points = transform_points(T_odom_keyframe, rows[:, POSITION].astype(np.float64))
        drawn.insert_seen(points, elevations, views / lengths @ T_odom_keyframe[:3, :3].T, _WEIGHT)
    return drawn
