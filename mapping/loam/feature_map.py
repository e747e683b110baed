"""Map of feature points, searched by Open3D, and the lines and planes that features correspond to."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state.stateful import Shape, Stateful
from lidarslam.mapping.loam.neighbour_kernels import write_principal_axes
from lidarslam.mapping.surfels.voxel_hash import point_keys

# Neighbours that a line or plane is fitted to, and the largest distance of the farthest of them.
_NEIGHBOURS, _FARTHEST_M = 5, 1.0
# Least ratio of the two largest variances of a line's neighbours; largest distance of a plane's neighbours from it.
_LINE_RATIO, _PLANE_M = 3.0, 0.2
# Least ratio of the second to the largest variance of a plane's neighbours: points of one ring span no plane.
_PLANE_RATIO = 0.0225


class FeatureMap(Stateful):
    """Points within a radius of the sensor, at most one a voxel.

    The first point of a voxel stays. A mean with every new scan's, as the voxel grids of PCL and Open3D form it, halves
    the weight of earlier scans each time: the map then follows the sensor, and the error grows.
    """

    points: Annotated[FloatArray, Shape(None, 3)]  # (N, 3) in the world, in the order of their voxels
    _spacing_m: float

    def __init__(self, radius_m: float) -> None:
        self.points = np.empty((0, 3))
        self._spacing_m = 1.0  # of the voxels; any while there are no points
        self._radius_m = radius_m
        self._keys = np.empty(0, dtype=np.int64)  # (N,) of the voxels
        self._search: o3d.core.nns.NearestNeighborSearch | None = None  # over the points, once it is asked for

    def __len__(self) -> int:
        return len(self.points)

    def insert(self, points: FloatArray, sensor: FloatArray, spacing_m: float) -> None:
        """Insert points (N, 3) of the world, and drop those beyond the radius from the sensor's position (3,)."""
        if spacing_m != self._spacing_m:
            points = np.concatenate([self.points, points])
            self.points, self._keys, self._spacing_m = np.empty((0, 3)), np.empty(0, dtype=np.int64), spacing_m
        keys, first = np.unique(point_keys(points, spacing_m), return_index=True)
        is_new = ~np.isin(keys, self._keys, assume_unique=True)
        places = np.searchsorted(self._keys, keys[is_new])
        self._keys = np.insert(self._keys, places, keys[is_new])
        self.points = np.insert(self.points, places, points[first[is_new]], axis=0)
        away = self.points - sensor
        near = np.flatnonzero(np.einsum("ij,ij->i", away, away) < self._radius_m**2)
        self._keys, self.points, self._search = self._keys[near], self.points[near], None

    def neighbourhoods(self, points: FloatArray, axis: int) -> "Neighbourhoods":
        """The nearest neighbours of points (M, 3) of the world that have enough of them nearby."""
        nearby, neighbours = np.empty(0, dtype=np.intp), np.empty((0, _NEIGHBOURS), dtype=np.int32)
        if len(points) and len(self) >= _NEIGHBOURS:
            found, squared = self._index().knn_search(o3d.core.Tensor.from_numpy(points), _NEIGHBOURS)
            nearby = np.flatnonzero(squared.numpy()[:, -1] < _FARTHEST_M**2)
            neighbours = found.numpy()[nearby]
        means, variances, axes = (np.empty((len(nearby), 3)) for _ in range(3))
        farthest_m = np.empty(len(nearby))
        write_principal_axes(self.points, neighbours, axis, means, variances, axes, farthest_m)
        return Neighbourhoods(nearby, means, variances, axes, farthest_m)

    def _index(self) -> o3d.core.nns.NearestNeighborSearch:
        if self._search is None:
            self._search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(self.points), o3d.core.int32)
            self._search.knn_index()
        return self._search

    def _after_restore(self) -> None:
        if not self._spacing_m > 0.0:
            raise ValueError(f"voxels of {self._spacing_m:g} m")
        self._keys = point_keys(self.points, self._spacing_m)
        self._search = None
        if (np.diff(self._keys) <= 0).any():
            raise ValueError("the points are not in the order of their voxels")


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """The five nearest neighbours in a map of K points."""

    index: NDArray[np.intp]  # (K,) of the point
    means: FloatArray  # (K, 3) of the neighbours, in the world
    variances: FloatArray  # (K, 3) along their principal axes, ascending
    axes: FloatArray  # (K, 3) unit, one of the principal axes
    farthest_m: FloatArray  # (K,) largest distance of a neighbour from the plane across that axis


@dataclass(frozen=True, eq=False)
class Correspondences:
    """M residuals of features: two with each line, across it, and one with each plane."""

    index: NDArray[np.intp]  # (M,) of the feature
    points: FloatArray  # (M, 3) on the line or plane, in the world
    normals: FloatArray  # (M, 3) unit, across the line or plane
    tilt: FloatArray  # (M,) standard deviation of the normal, radians


def match_lines(points: FloatArray, edges: FeatureMap) -> Correspondences:
    """Match edge points (N, 3) of the world to lines: neighbours spread along one direction."""
    near = edges.neighbourhoods(points, axis=2)
    fit = np.flatnonzero(near.variances[:, 2] > _LINE_RATIO * near.variances[:, 1])
    along, index, means = near.axes[fit], near.index[fit], near.means[fit]
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.stack([across, np.cross(along, across)], axis=1).reshape(-1, 3)
    # Two residuals are spent on the fit.
    tilt = _tilt(near.variances[fit, 1], near.variances[fit, 2], _NEIGHBOURS - 2)
    return Correspondences(index.repeat(2), means.repeat(2, axis=0), normals, tilt.repeat(2))


def match_planes(points: FloatArray, planes: FeatureMap) -> Correspondences:
    """Match planar points (N, 3) of the world to planes: neighbours that are all close to one, and not on a line."""
    near = planes.neighbourhoods(points, axis=0)
    spread = near.variances[:, 1] > _PLANE_RATIO * near.variances[:, 2]
    fit = np.flatnonzero(spread & (near.farthest_m < _PLANE_M))
    # Three residuals are spent on the fit; the shorter extent decides.
    tilt = _tilt(near.variances[fit, 0], near.variances[fit, 1], _NEIGHBOURS - 3)
    return Correspondences(near.index[fit], near.means[fit], near.axes[fit], tilt)


def _tilt(across: FloatArray, along: FloatArray, free: int) -> FloatArray:
    """Standard deviation (M,) of directions fitted to points with variances (M,) across and along them."""
    return np.asarray(np.sqrt(np.maximum(across, 0.0) / (free * along)), dtype=np.float64)
