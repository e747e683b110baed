"""Surfaces of the sensor's carrier in its scans: at one place in the sensor's frame while the scene passes by.

A vehicle's side, a robot's body or a mast takes part of the view. Where that part is the larger one, registration
finds the sensor at rest, and all scans fit.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray, principal_axes
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording

# Every fourth of the first scans, and every 32nd of those after them: a recording may begin at rest.
_FIRST, _STEP, _LATER_STEP = 64, 4, 32
_FEWEST_SCANS, _MOST_SCANS = 8, 40
# A patch is the surface around one of these directions, its plane fitted to this many neighbouring directions.
_APART_RAD, _MOST_PATCHES, _NEIGHBOURS = 0.03, 2000, 20
_MOST_READ = 40_000
# A patch is flat when the least variance is this share of the next, or no more than the noise of ranges, metres; level
# when its normal is within 37 degrees of z.
_FLAT, _NOISE_M, _LEVEL = 0.12, 0.02, 0.8
# A flat patch recurs where the median of the points around it is this near its plane, another one where a point is
# this near; metres, and share of the range.
_NEAR_PLANE, _NEAR_POINT, _AROUND, _IN_PATCH = (0.015, 0.002), (0.05, 0.01), (0.1, 0.06), 4
# Of scans in which a patch of the carrier recurs, and of those in which half of the others may.
_ALWAYS, _SELDOM = 0.9, 0.34
_LEAST_SHARE, _FEWEST_OTHERS = 0.05, 20
# The scene is farther away than the carrier, by this factor; the walls are where people walk around a sensor at rest.
_FARTHER = 1.5
# Walls of a straight corridor are parallel to the path, and recur too; those of a carrier face other ways as well.
_FACING, _FEWEST_FACING, _LEAST_FACING = 0.9, 15, 0.08
# The carrier is within this of the sensor; the edge of its voxels.
_REACH_M, _VOXEL_M = 15.0, 0.1
_GRID = 2 * round(_REACH_M / _VOXEL_M)


@dataclass(frozen=True, eq=False)
class Carrier:
    """The voxels around the sensor that its carrier takes."""

    voxels: NDArray[np.bool_]  # (GRID, GRID, GRID), the sensor in the middle
    share: float  # of the surfaces in view

    @property
    def warning(self) -> str:
        """What is left out."""
        return (
            f"{100.0 * self.share:.0f} % of the surfaces in view stay at one place in the sensor's frame while the"
            " scene passes by: taken as those of its carrier, and left out (reader.carrier=keep keeps them)"
        )

    def remove(self, scan: Scan) -> Scan:
        """The scan without its points on the carrier."""
        near = np.flatnonzero(np.abs(scan.points).max(axis=1) < _REACH_M)
        index = ((scan.points[near] + _REACH_M) / _VOXEL_M).astype(np.intp)
        kept = np.ones(len(scan), dtype=bool)
        kept[near] = ~self.voxels[tuple(index.T)]
        return scan.select(kept)


def sampled(recording: Recording) -> Iterator[Scan]:
    """The scans from which the carrier is found."""
    yield from recording.scans(0, _FIRST, _STEP, Faults())
    yield from recording.scans(_FIRST, None, _LATER_STEP, Faults())


def carrier_in(scans: Iterable[FloatArray]) -> Carrier | None:
    """The carrier, from points (N, 3) of scans; None unless it certainly takes part of the view.

    No more scans are read than needed.
    """
    few = (points[:: max(1, len(points) // _MOST_READ)] for points in scans)
    patches = Patches.of(next(few, np.empty((0, 3))))
    if not patches.is_flat.any():
        return None
    recur: list[NDArray[np.bool_]] = []
    read: list[FloatArray] = []
    for points in islice(few, _MOST_SCANS):
        read.append(points)
        recur.append(patches.recur_in(points))
        seen = np.array(recur)
        fixed = patches.may_be_fixed & (seen.mean(axis=0) >= _ALWAYS)
        if len(recur) > 1 and fixed.mean() < _LEAST_SHARE:
            return None
        if len(recur) >= _FEWEST_SCANS and patches.pass_by(seen, fixed) and patches.face_all_ways(fixed):
            return Carrier(_taken(patches, read), float(fixed.mean()))
    return None


@dataclass(frozen=True, eq=False)
class Patches:
    """Surfaces that the sensor sees, spread evenly over the directions."""

    centres: FloatArray  # (M, 3)
    normals: FloatArray  # (M, 3) unit
    is_flat: NDArray[np.bool_]  # (M,)

    @classmethod
    def of(cls, points: FloatArray) -> Self:
        """The patches of a scan (N, 3)."""
        ranges = np.linalg.norm(points, axis=1)
        points, ranges = points[ranges > 0.0], ranges[ranges > 0.0]
        points = points[one_per_cell(np.ascontiguousarray(points / ranges[:, None]), _APART_RAD)]
        if len(points) < _NEIGHBOURS:
            return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, dtype=bool))
        asked = points[:: -(-len(points) // _MOST_PATCHES)]
        means, scatter, axes = principal_axes(points[cKDTree(points).query(asked, k=_NEIGHBOURS)[1]])
        is_flat = scatter[:, 0] < np.maximum(_FLAT * scatter[:, 1], _NEIGHBOURS * _NOISE_M**2)
        return cls(np.where(is_flat[:, None], means, asked), axes[:, :, 0], is_flat)

    @cached_property
    def _ranges(self) -> FloatArray:
        return np.asarray(np.linalg.norm(self.centres, axis=1))

    @cached_property
    def _is_level(self) -> NDArray[np.bool_]:
        """(M,) such as the ground, which recurs wherever it is level."""
        return np.asarray(self.is_flat & (np.abs(self.normals[:, 2]) > _LEVEL))

    @cached_property
    def may_be_fixed(self) -> NDArray[np.bool_]:
        """(M,) which are near, upright surfaces."""
        return np.asarray(self.is_flat & ~self._is_level & (self._ranges < _REACH_M))

    def recur_in(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which patches (M,) are at the same place in another scan (N, 3)."""
        if len(points) < 3 * _IN_PATCH:
            return np.zeros(len(self.centres), dtype=bool)
        near_plane, near_point, around = (a + b * self._ranges for a, b in (_NEAR_PLANE, _NEAR_POINT, _AROUND))
        distances, found = (np.asarray(part) for part in cKDTree(points).query(self.centres, k=3 * _IN_PATCH))
        is_near = distances < around[:, None]
        off = np.einsum("nki,ni->nk", points[np.where(is_near, found, 0)] - self.centres[:, None], self.normals)
        in_patch = is_near.sum(axis=1)
        # Those that are not near come last; the lower of the two in the middle of an even number.
        ordered = np.sort(np.where(is_near, off, np.inf), axis=1)
        middle = np.abs(ordered[np.arange(len(off)), np.maximum(in_patch - 1, 0) // 2])
        in_plane = (in_patch >= _IN_PATCH) & (middle < near_plane)
        return np.asarray(np.where(self.is_flat, in_plane, distances[:, 0] < near_point))

    def pass_by(self, seen: NDArray[np.bool_], fixed: NDArray[np.bool_]) -> bool:
        """Whether most of the others, which are farther, recur in few of the later half of the scans (S, M)."""
        others = ~fixed & ~self._is_level
        if np.count_nonzero(others) < _FEWEST_OTHERS:
            return False
        if np.median(self._ranges[others]) < _FARTHER * np.median(self._ranges[fixed]):
            return False
        return bool(np.median(seen[len(seen) // 2 :, others].mean(axis=0)) <= _SELDOM)

    def face_all_ways(self, chosen: NDArray[np.bool_]) -> bool:
        """Whether patches face more than one horizontal direction and its opposite."""
        level = self.normals[chosen, :2]
        level = level / np.linalg.norm(level, axis=1, keepdims=True)
        across = np.abs(level @ np.linalg.eigh(level.T @ level)[1][:, 0]) > _FACING
        return bool(across.sum() >= _FEWEST_FACING and across.mean() >= _LEAST_FACING)

    def is_level_at(self, points: FloatArray) -> NDArray[np.bool_]:
        """Whether the flat patches nearest to points (N, 3) are level."""
        flat = np.flatnonzero(self.is_flat)
        return np.asarray(self._is_level[flat[cKDTree(self.centres[flat]).query(points)[1]]])


def _taken(patches: Patches, scans: Sequence[FloatArray]) -> NDArray[np.bool_]:
    """The voxels, with their neighbours, in which nearly all scans have points, but for those of level surfaces."""
    counts = np.zeros((_GRID,) * 3, dtype=np.uint8)
    for points in scans:
        near = points[np.abs(points).max(axis=1) < _REACH_M]
        occupied = np.zeros_like(counts, dtype=bool)
        occupied[tuple(((near + _REACH_M) / _VOXEL_M).astype(np.intp).T)] = True
        counts += occupied
    index = np.argwhere(counts >= _ALWAYS * len(scans))
    index = index[~patches.is_level_at((index + 0.5).astype(np.float64) * _VOXEL_M - _REACH_M)]
    taken = np.zeros_like(counts, dtype=bool)
    taken[tuple(index.T)] = True
    return np.asarray(binary_dilation(taken, np.ones((3, 3, 3), dtype=bool)))
